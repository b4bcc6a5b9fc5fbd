"""Which blocks can be computed now: all, or those whose earlier waves are committed."""

from __future__ import annotations

import json
import math
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule, digest_of
from sweep.sampling.rules import Decider, Decision, Waves, condition_axes, make_rule
from sweep.store.blocks import Receipt, RunStore, committed, receipts

#: Blocks of which nothing is needed that one task writes.
SETTLED_AT_ONCE = 64


@dataclass(frozen=True, slots=True)
class Work:
    """One task: blocks by their numbers, and the inputs that determine their needed scenes.

    Without a decision, all scenes are computed.
    """

    numbers: tuple[int, ...]
    decision: Decision | None = None


class AnyOrder:
    """Blocks that do not depend on each other, in the order of their numbers.

    ``done``: those that are committed before.
    """

    #: There are no conditions that could be settled.
    settled_share = None

    def __init__(self, numbers: Iterable[int], done: AbstractSet[int] = frozenset()) -> None:
        self._numbers = iter(numbers)
        self.current = done

    def next(self) -> Work | None:
        """Return the next block."""
        number = next(self._numbers, None)
        return None if number is None else Work((number,))

    def committed(self, number: int, receipt: Receipt) -> None:
        """Nothing follows from it."""


class _Known(NamedTuple):
    """The kept part of a committed block's receipt; ``content`` is a digest of what rules read."""

    basis: int | None
    content: int
    needed: int
    scenes: int


class InWaves:
    """Blocks in waves: a group's next wave waits for all blocks of the one before.

    A block is computed again if it was committed on another basis: under another rule, or on
    results that were computed again since.

    Parameters
    ----------
    store
        The store of a pipeline whose sampling stops; its committed blocks are read.
    only
        The blocks that may be computed, if they are not committed (default: all).
    """

    def __init__(self, store: RunStore, only: AbstractSet[int] | None = None) -> None:
        self._rule, sampling = _rule_of(store), make_rule(store.pipeline)
        assert sampling is not None  # noqa: S101  (there is a section that says so)
        self._waves = Waves.of(store.pipeline, sampling, store.blocks)
        self._read = sorted({"detection", *sampling.variables})
        self._only = only
        self._known: dict[int, _Known] = {}
        self._ready: deque[Work] = deque()
        # Of each group that was begun, the wave's blocks that are not committed yet, and what
        # goes on when all are.
        self._groups: dict[int, tuple[set[int], Iterator[list[Work]]]] = {}
        self._settled_shares: dict[int, float] = {}
        #: Numbers of the blocks that were committed on the basis that they have now.
        self.current: set[int] = set()
        for number, receipt in receipts(store, committed(store)):
            self._note(number, receipt)
        begun = {self._waves.group(number) for number in self._known}
        for group in sorted(begun):
            self._begin(group)
        self._fresh = (group for group in range(self._waves.groups) if group not in begun)

    @property
    def settled_share(self) -> float:
        """The share of the conditions that need no more trials, or have them all."""
        return sum(self._settled_shares.values()) / self._waves.groups

    def next(self) -> Work | None:
        """Return the blocks that can be computed now."""
        while not self._ready:
            group = next(self._fresh, None)
            if group is None:
                return None
            self._begin(group)
        return self._ready.popleft()

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block; the last one of a wave makes the next wave ready."""
        self._note(number, receipt)
        pending, works = self._groups[self._waves.group(number)]
        pending.discard(number)
        if not pending:
            self._ready.extend(next(works, ()))

    def _note(self, number: int, receipt: Receipt) -> None:
        content = json.dumps([number, *(receipt.checksums.get(name, 0) for name in self._read)])
        self._known[number] = _Known(
            receipt.basis, zlib.crc32(content.encode()), receipt.scenes_needed, receipt.scenes)

    def _begin(self, group: int) -> None:
        pending: set[int] = set()
        self._groups[group] = pending, (works := self._works(group, pending))
        self._ready.extend(next(works, ()))

    def _works(self, group: int, pending: set[int]) -> Iterator[list[Work]]:
        """Yield the work of each wave of a group; go on once nothing of it is ``pending``.

        In a wave, these are the blocks that are not committed on what follows from the wave
        before. Once nothing was needed in a wave, all that is left is one wave.
        """
        wave, last, settled = 0, len(self._waves.ends) - 1, False
        bases: tuple[int, ...] = ()  # for each wave from 1 on what it follows from
        digest = zlib.crc32(digest_of(self._rule).encode())
        while True:
            stop = last if settled else wave
            numbers = list(self._waves.numbers(group, wave, stop))
            basis = bases[-1] if bases else None
            pending.update(number for number in numbers if number not in self._known
                           or self._known[number].basis != basis)
            self.current.update(set(numbers) - pending)
            if pending:
                allowed = [number for number in numbers if number in pending and (
                    self._only is None or number in self._only or number in self._known)]
                decision = Decision(self._rule, wave, bases, settled) if bases else None
                size = SETTLED_AT_ONCE if settled else 1
                yield [Work(tuple(allowed[at : at + size]), decision)
                       for at in range(0, len(allowed), size)]
                continue
            found = [self._known.pop(number) for number in numbers]
            needed, scenes = sum(each.needed for each in found), sum(each.scenes for each in found)
            self._settled_shares[group] = 1.0 if stop == last else 1.0 - needed / scenes
            if stop == last:
                return
            digest = zlib.crc32(json.dumps([digest, *(each.content for each in found)]).encode())
            bases = (*bases, digest)
            settled = wave > 0 and needed == 0
            wave += 1


#: The blocks that wait to be computed.
Waiting = AnyOrder | InWaves


def waiting_blocks(
    store: RunStore, numbers: Iterable[int], done: AbstractSet[int] = frozenset()
) -> Waiting:
    """Return some blocks of a store in the order in which they can be computed.

    ``done``: the blocks that are committed.
    """
    if store.pipeline.stopping is None:
        return AnyOrder(numbers, done)
    return InWaves(store, set(numbers))


def _rule_of(store: RunStore) -> StoppingRule:
    if store.pipeline.stopping is None:
        raise TypeError(store.url)
    return store.pipeline.stopping


# --------------------------------------------------------------------------------------------------
# Conditions of a run in waves, and those that are not settled at its end.

def _conditions(pipeline: Pipeline) -> list[bool]:
    """Return which of the condition axes make conditions; cells along the others are pooled."""
    per = getattr(pipeline.stopping, "per", None)
    return [per is None or axis.name in per for axis in condition_axes(pipeline)]


def condition_count(pipeline: Pipeline) -> int:
    """Return the number of conditions."""
    return math.prod(len(axis) for axis, kept in zip(
        condition_axes(pipeline), _conditions(pipeline), strict=True) if kept)


def unsettled_count(store: RunStore) -> int:
    """Return how many conditions of a complete store would need more than ``max_trials``."""
    rule = _rule_of(store)
    decider = Decider.of(store, rule)
    waves, last = decider.waves, len(decider.waves.ends)
    pooled = tuple(k for k, kept in enumerate(_conditions(store.pipeline)) if not kept)
    count = 0
    for group in range(waves.groups):
        first = next(waves.numbers(group, last - 1))
        mask = decider.of_group(
            waves.span(store.blocks[first]), Decision(rule, last, tuple(range(last))))
        count += int(np.asarray(mask.any(axis=pooled)).sum())
    return count
