"""Which blocks can be computed now: all of them, or those whose earlier waves are committed."""

from __future__ import annotations

import itertools
import json
import math
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Protocol

from sweep.plan.stopping import StoppingRule, digest_of
from sweep.sampling.deciding import Decision
from sweep.sampling.stopping import Stopping
from sweep.sampling.waves import Waves
from sweep.store.blocks import committed, receipts
from sweep.store.receipt import Receipt
from sweep.store.run_store import RunStore

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

    def put_back(self, work: Work) -> None:
        """Take back what `next` returned and nobody began."""

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note that a block is committed."""


class AnyOrder:
    """Blocks that do not depend on each other, in the order of their numbers."""

    def __init__(self, numbers: Iterable[int]) -> None:
        self._works: Iterator[Work] = (Work((number,)) for number in numbers)

    def next(self) -> Work | None:
        """Return the next block."""
        return next(self._works, None)

    def put_back(self, work: Work) -> None:
        """Return it next."""
        self._works = itertools.chain([work], self._works)

    def committed(self, number: int, receipt: Receipt) -> None:
        """Nothing follows from it."""


def in_any_order(numbers: Iterable[int] | Waiting) -> Waiting:
    """Return blocks that wait; numbers are of blocks that do not depend on each other."""
    return AnyOrder(numbers) if isinstance(numbers, Iterable) else numbers


@dataclass(slots=True)
class _Known:
    """What is kept of a committed block's receipt."""

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
    share
        Of the scenes of the wave before, those that were needed.
    pending
        Blocks of the wave (if it is settled, of all that is left) that are not committed yet.
    """

    wave: int = 0
    bases: tuple[int, ...] = ()
    settled: bool = False
    share: float = 1.0
    pending: set[int] = field(default_factory=set)


class InWaves:
    """Blocks in waves: those of a group's next wave wait for all of the one before.

    A block is computed again if it was committed on another basis: under another rule, or on
    results that were computed again since.

    Parameters
    ----------
    store
        The store; its committed blocks are read.
    rule, sampling
        What the pipeline's section says, and the rule that samples by it.
    only
        The blocks that may be computed; all by default.
    check
        Called before each work; it raises if this process may not write any more.
    """

    def __init__(
        self, store: RunStore, rule: StoppingRule, sampling: Stopping, *,
        only: AbstractSet[int] | None = None, check: Callable[[], None] = lambda: None,
    ) -> None:
        self._rule = rule
        self._waves = Waves.of(store.pipeline, sampling, store.blocks)
        self._names = sorted({"detection", *sampling.variables})
        self._first = zlib.crc32(digest_of(rule).encode())
        self._only, self._check = only, check
        self._known: dict[int, _Known] = {}
        self._ready: deque[Work] = deque()
        self._groups: dict[int, _Group] = {}
        self.current: set[int] = set()
        """Numbers of the blocks that were committed on the basis that they have now."""
        self.cells = math.prod(
            length for k, length in enumerate(store.blocks.lengths) if k != self._waves.trial
        )
        """Scenes of the grid, not counting trials: conditions, and the cells that each pools."""
        self._settled_in: dict[int, int] = {}
        for number, receipt in receipts(store, committed(store)):
            self._note(number, receipt)
        begun = {self._waves.group(number) for number in self._known}
        for group in sorted(begun):
            self._groups[group] = _Group()
            self._advance(group)
        self._fresh = (group for group in range(self._waves.groups) if group not in begun)

    @property
    def settled(self) -> int:
        """How many of ``cells`` need no more trials, or have them all."""
        return sum(self._settled_in.values())

    def next(self) -> Work | None:
        """Return what can be computed now: groups that are not begun first, so that all go on."""
        while not self._ready:
            group = next(self._fresh, None)
            if group is None:
                return None
            self._groups[group] = _Group()
            self._advance(group)
        self._check()
        return self._ready.popleft()

    def put_back(self, work: Work) -> None:
        """Return it next."""
        self._ready.appendleft(work)

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block; the last one of a wave makes the next wave ready."""
        self._note(number, receipt)
        group = self._waves.group(number)
        state = self._groups[group]
        state.pending.discard(number)
        if not state.pending:
            self._advance(group)

    def _note(self, number: int, receipt: Receipt) -> None:
        content = zlib.crc32(json.dumps(
            [number, *(receipt.digests.get(name, 0) for name in self._names)]
        ).encode())
        self._known[number] = _Known(
            receipt.basis, content, receipt.scenes_needed, receipt.scenes
        )

    def _advance(self, group: int) -> None:
        """Make the first wave ready of which blocks are not committed as they are to be."""
        state, waves = self._groups[group], self._waves
        last = len(waves.ends) - 1
        while True:
            stop = last if state.settled else state.wave
            basis = state.bases[-1] if state.bases else None
            numbers = list(waves.numbers(group, state.wave, stop))
            waiting = [
                number for number in numbers
                if number not in self._known or self._known[number].basis != basis
            ]
            self.current.update(set(numbers).difference(waiting))
            chosen = [
                number for number in waiting
                if self._only is None or number in self._only or number in self._known
            ]
            state.pending = set(waiting)
            self._ready.extend(self._works(state, chosen))
            if waiting:
                return
            found = [self._known.pop(number) for number in numbers]
            scenes, needed = sum(e.scenes for e in found), sum(e.needed for e in found)
            if stop == last:
                self._count_settled(group, scenes, scenes)
                del self._groups[group]
                return
            self._count_settled(group, scenes - needed, scenes)
            text = json.dumps([state.bases[-1] if state.bases else self._first,
                               *(each.content for each in found)])
            state.bases = (*state.bases, zlib.crc32(text.encode()))
            state.settled = state.wave > 0 and needed == 0
            state.share = needed / scenes
            state.wave += 1

    def _count_settled(self, group: int, settled: int, scenes: int) -> None:
        """Count the cells of a group that are settled, from their share of a wave's scenes."""
        cells = self.cells_of(group)
        self._settled_in[group] = cells * settled // scenes if scenes else cells

    def cells_of(self, group: int) -> int:
        """Return how many scenes a group has, not counting trials."""
        first = next(self._waves.numbers(group, 0))
        span = self._waves.span(self._waves.blocks[first])
        return len(span) // self._waves.blocks.lengths[self._waves.trial]

    def _works(self, state: _Group, numbers: list[int]) -> Iterator[Work]:
        if not state.bases:
            yield from (Work((number,)) for number in numbers)
            return
        decision = Decision(self._rule, state.wave, state.bases, state.settled)
        size = SETTLED_AT_ONCE
        if not state.settled:
            # As much work as in a block of which all is needed, if few scenes are.
            size = min(max(int(1 / max(state.share, 1e-9)), 1), SETTLED_AT_ONCE)
        for at in range(0, len(numbers), size):
            yield Work(tuple(numbers[at : at + size]), decision)
