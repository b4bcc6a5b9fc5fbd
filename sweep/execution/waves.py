"""Blocks in waves: each wave is computed on the committed results of those before."""

from __future__ import annotations

import itertools
import json
import math
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import StoppingRule, digest_of
from sweep.sampling.rules import Decider, Decision, Waves, make_rule
from sweep.store.blocks import Receipt, RunStore, committed, receipts

#: A block's number, and the inputs that determine its needed scenes: all are without a decision.
Work = tuple[int, Decision | None]


class Known(NamedTuple):
    """The kept part of a committed block's receipt; ``content`` is a digest of what rules read."""

    basis: int | None
    content: int
    needed: int
    scenes: int
    detected: int


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
        self._known: dict[int, Known] = {}
        self._settled_shares = np.zeros(len(self._waves.groups))
        #: The blocks, by their numbers, that are committed on the basis that they have now.
        self.current: dict[int, Known] = {}
        #: Conditions of the grid.
        self.conditions = condition_count(store.pipeline, rule)
        for number, receipt in receipts(store, committed(store)):
            self.committed(number, receipt)
        self._next = self._next_wave()

    @property
    def settled(self) -> int:
        """How many of the conditions need no more trials, or have them all."""
        return int(self._settled_shares.mean() * self.conditions)

    def __iter__(self) -> Iterator[list[Work]]:
        """Yield what each wave has to compute; go on when that is committed. The last is empty."""
        yield self._next
        while self._next:
            self._next = self._next_wave()
            yield self._next

    def committed(self, number: int, receipt: Receipt) -> None:
        """Note a committed block."""
        content = json.dumps([number, *(receipt.checksums.get(name, 0) for name in self._read)])
        self._known[number] = Known(
            receipt.basis, zlib.crc32(content.encode()), receipt.scenes_needed, receipt.scenes,
            receipt.detection.get("detected", 0))

    def _next_wave(self) -> list[Work]:
        return [*itertools.chain(*map(self._of_group, range(len(self._waves.groups))))]

    def _of_group(self, group: int) -> Iterator[Work]:
        """Yield the work of the first wave of a group in which there is some.

        These are the blocks that are not committed on what follows from the wave before. Once
        nothing was needed in a wave, all that is left is one wave.
        """
        last, settled = len(self._waves.ends) - 1, False
        # The digests that each wave from 1 on follows from; the next one grows from ``digest``.
        bases: tuple[int, ...] = ()
        digest = zlib.crc32(digest_of(self._rule).encode())
        for wave in itertools.count():
            decision = Decision(self._rule, wave, bases, settled) if bases else None
            basis = None if decision is None else decision.basis
            numbers = self._waves.numbers(group, wave, last if settled else wave)
            found = {number: self._known[number] for number in numbers
                     if number in self._known and self._known[number].basis == basis}
            self.current.update(found)
            if len(found) < len(numbers):
                yield from ((number, decision) for number in numbers if number not in found)
                return
            needed = sum(each.needed for each in found.values())
            ends = settled or wave == last
            self._settled_shares[group] = 1.0 if ends else 1.0 - needed / sum(
                each.scenes for each in found.values())
            if ends:
                return
            contents = [found[number].content for number in numbers]
            digest = zlib.crc32(json.dumps([digest, *contents]).encode())
            bases = (*bases, digest)
            settled = wave > 0 and needed == 0


# --------------------------------------------------------------------------------------------------
# Conditions of a run in waves, and those that are not settled at its end.

def condition_count(pipeline: Pipeline, rule: StoppingRule) -> int:
    """Return the number of conditions of a run in waves."""
    return math.prod(len(pipeline.axis(name) or ()) for name in rule.per)


def unsettled_count(store: RunStore, rule: StoppingRule) -> int:
    """Return how many conditions of a complete store would need more than ``max_trials``."""
    decider = Decider.of(store, rule)
    decision = Decision(rule, len(rule.ends), tuple(range(len(rule.ends))))
    pooled = tuple(k for k, axis in enumerate(store.pipeline.experiment.scene_axes)
                   if axis.name not in rule.per)
    return sum(int(decider.of_group(group, decision).any(axis=pooled).sum())
               for group in range(len(decider.waves.groups)))
