"""Which blocks can be computed now: all, or those whose earlier waves are committed."""

from __future__ import annotations

import json
import math
import zlib
from collections import deque
from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule, digest_of
from sweep.sampling.rules import Decider, Decision, Waves, condition_axes, make_rule
from sweep.store.blocks import RunStore, committed, receipts
from sweep.store.receipt import Receipt

SETTLED_AT_ONCE = 64
"""Blocks of which nothing is needed that one task writes."""


@dataclass(frozen=True, slots=True)
class Work:
    """What one task does: blocks by their numbers, and what their needed scenes follow from.

    Without a decision, all scenes are computed.
    """

    numbers: tuple[int, ...]
    decision: Decision | None = None


class Waiting(Protocol):
    """The blocks that wait to be computed."""

    def next(self) -> Work | None:
        """Return what can be computed now; None if nothing can, before more is committed."""

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note that a block is committed."""


def waiting_blocks(store: RunStore, numbers: Iterable[int]) -> AnyOrder | InWaves:
    """Return some blocks of a store in the order in which they can be computed."""
    if store.pipeline.stopping is None:
        return AnyOrder(numbers)
    return InWaves(store, set(numbers))


class AnyOrder:
    """Blocks that do not depend on each other, in the order of their numbers."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._numbers = iter(numbers)

    def next(self) -> Work | None:
        """Return the next block."""
        number = next(self._numbers, None)
        return None if number is None else Work((number,))

    def committed(self, number: int, receipt: Receipt) -> None:
        """Nothing follows from it."""


class _Known(NamedTuple):
    """What is kept of a committed block's receipt; ``content`` is a digest of what rules read."""

    basis: int | None
    content: int
    needed: int
    scenes: int


@dataclass(slots=True)
class _Group:
    """How far a group is.

    Attributes
    ----------
    wave
        The wave that is computed.
    bases
        For each wave from 1 to ``wave`` what it follows from.
    settled
        Whether nothing was needed in the wave before.
    pending
        Blocks of the wave (if it is settled, of all that is left) that are not committed yet.
    """

    wave: int = 0
    bases: tuple[int, ...] = ()
    settled: bool = False
    pending: set[int] = field(default_factory=set)


class InWaves:
    """Blocks in waves: those of a group's next wave wait for all of the one before.

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
        self._first = zlib.crc32(digest_of(self._rule).encode())
        self._only = only
        self._known: dict[int, _Known] = {}
        self._ready: deque[Work] = deque()
        self._groups: dict[int, _Group] = {}
        self._settled_shares: dict[int, float] = {}
        self.current: set[int] = set()
        """Numbers of the blocks that were committed on the basis that they have now."""
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
        """Return what can be computed now."""
        while not self._ready:
            group = next(self._fresh, None)
            if group is None:
                return None
            self._begin(group)
        return self._ready.popleft()

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block; the last one of a wave makes the next wave ready."""
        self._note(number, receipt)
        group = self._waves.group(number)
        self._groups[group].pending.discard(number)
        if not self._groups[group].pending:
            self._advance(group)

    def _note(self, number: int, receipt: Receipt) -> None:
        content = json.dumps([number, *(receipt.checksums.get(name, 0) for name in self._read)])
        self._known[number] = _Known(
            receipt.basis, zlib.crc32(content.encode()), receipt.scenes_needed, receipt.scenes)

    def _begin(self, group: int) -> None:
        self._groups[group] = _Group()
        self._advance(group)

    def _advance(self, group: int) -> None:
        """Make the first wave ready of which blocks are not committed as they are to be."""
        state, last = self._groups[group], len(self._waves.ends) - 1
        while True:
            stop = last if state.settled else state.wave
            basis = state.bases[-1] if state.bases else None
            numbers = list(self._waves.numbers(group, state.wave, stop))
            waiting = [number for number in numbers
                       if number not in self._known or self._known[number].basis != basis]
            self.current.update(set(numbers).difference(waiting))
            if waiting:
                state.pending = set(waiting)
                self._ready.extend(self._works(state, [
                    number for number in waiting
                    if self._only is None or number in self._only or number in self._known]))
                return
            found = [self._known.pop(number) for number in numbers]
            needed, scenes = sum(each.needed for each in found), sum(each.scenes for each in found)
            self._settled_shares[group] = 1.0 if stop == last else 1.0 - needed / scenes
            if stop == last:
                del self._groups[group]
                return
            text = json.dumps([state.bases[-1] if state.bases else self._first,
                               *(each.content for each in found)])
            state.bases = (*state.bases, zlib.crc32(text.encode()))
            state.settled = state.wave > 0 and needed == 0
            state.wave += 1

    def _works(self, state: _Group, numbers: list[int]) -> list[Work]:
        size = SETTLED_AT_ONCE if state.settled else 1
        decision = Decision(
            self._rule, state.wave, state.bases, state.settled) if state.bases else None
        return [Work(tuple(numbers[at : at + size]), decision)
                for at in range(0, len(numbers), size)]


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
