"""Blocks in waves: each wave is computed on the committed results of those before."""

from __future__ import annotations

import itertools
import json
import math
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sweep.experiment.grid import TRIAL
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule, digest_of
from sweep.sampling.rules import Decider, Decision, Waves, make_rule
from sweep.store.blocks import Receipt, RunStore, committed, receipts

#: A block's number, and the inputs that determine its needed scenes: all are without a decision.
Work = tuple[int, Decision | None]


class _Known(NamedTuple):
    """The kept part of a committed block's receipt; ``content`` is a digest of what rules read."""

    basis: int | None
    content: int
    needed: int
    scenes: int


class InWaves:
    """The blocks of each wave, which are computed before those of the next.

    A block is computed again if it was committed on another basis: under another rule, or on
    results that were computed again since.

    Parameters
    ----------
    store
        The store of a pipeline whose sampling stops; its committed blocks are read.
    """

    def __init__(self, store: RunStore) -> None:
        rule, sampling = store.pipeline.stopping, make_rule(store.pipeline)
        assert rule is not None and sampling is not None  # noqa: PT018, S101  (a section says so)
        self._rule = rule
        self._waves = Waves.of(store.pipeline, sampling, store.blocks)
        self._read = sorted({"detection", *sampling.variables})
        self._known: dict[int, _Known] = {}
        self._settled_shares = np.zeros(len(self._waves.groups))
        #: Numbers of the blocks that are committed on the basis that they have now.
        self.current: set[int] = set()
        for number, receipt in receipts(store, committed(store)):
            self.committed(number, receipt)
        self._next = self._next_wave()

    @property
    def settled_share(self) -> float:
        """The share of the conditions that need no more trials, or have them all."""
        return float(self._settled_shares.mean())

    def __iter__(self) -> Iterator[list[Work]]:
        """Yield what each wave has to compute; go on when that is committed."""
        while self._next:
            yield self._next
            self._next = self._next_wave()

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block."""
        content = json.dumps([number, *(receipt.checksums.get(name, 0) for name in self._read)])
        self._known[number] = _Known(
            receipt.basis, zlib.crc32(content.encode()), receipt.scenes_needed, receipt.scenes)

    def _next_wave(self) -> list[Work]:
        return [*itertools.chain(*map(self._of_group, range(len(self._waves.groups))))]

    def _of_group(self, group: int) -> Iterator[Work]:
        """Yield the work of the first wave of a group in which there is some.

        These are the blocks that are not committed on what follows from the wave before. Once
        nothing was needed in a wave, all that is left is one wave.
        """
        last, settled = len(self._waves.ends) - 1, False
        bases: tuple[int, ...] = ()  # for each wave from 1 on what it follows from
        digest = zlib.crc32(digest_of(self._rule).encode())
        for wave in itertools.count():
            numbers = [*self._waves.numbers(group, wave, last if settled else wave)]
            basis = bases[-1] if bases else None
            decision = Decision(self._rule, wave, bases, settled) if bases else None
            pending = [number for number in numbers
                       if number not in self._known or self._known[number].basis != basis]
            self.current.update(set(numbers).difference(pending))
            if pending:
                yield from ((number, decision) for number in pending)
                return
            found = [self._known[number] for number in numbers]
            needed, scenes = sum(each.needed for each in found), sum(each.scenes for each in found)
            ends = settled or wave == last
            self._settled_shares[group] = 1.0 if ends else 1.0 - needed / scenes
            if ends:
                return
            digest = zlib.crc32(json.dumps([digest, *(each.content for each in found)]).encode())
            bases = (*bases, digest)
            settled = wave > 0 and needed == 0


# --------------------------------------------------------------------------------------------------
# Conditions of a run in waves, and those that are not settled at its end.

def condition_count(pipeline: Pipeline) -> int:
    """Return the number of conditions."""
    return math.prod(len(axis) for axis, kept in zip(
        pipeline.experiment.scene_axes, _conditions(pipeline), strict=True) if kept)


def unsettled_count(store: RunStore, rule: StoppingRule) -> int:
    """Return how many conditions of a complete store would need more than ``max_trials``."""
    decider = Decider.of(store, rule)
    decision = Decision(rule, len(rule.ends), tuple(range(len(rule.ends))))
    pooled = tuple(k for k, kept in enumerate(_conditions(store.pipeline)) if not kept)
    return sum(int(decider.of_group(group, decision).any(axis=pooled).sum())
               for group in range(len(decider.waves.groups)))


def _conditions(pipeline: Pipeline) -> list[bool]:
    """Return which of the scene axes make conditions; cells along the others are pooled."""
    per = getattr(pipeline.stopping, "per", None)
    return [axis.name != TRIAL and (per is None or axis.name in per)
            for axis in pipeline.experiment.scene_axes]
