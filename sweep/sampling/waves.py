"""How the blocks of a store make groups and waves."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

from sweep.plan.axes import TRIAL
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import Block, Blocks, scene_axes
from sweep.sampling.stopping import Stopping


@dataclass(frozen=True, slots=True)
class Waves:
    """The groups of a grid of blocks, and the waves of each.

    A group is all blocks that share their cut of the axes that are neither coupled nor ``trial``.

    Attributes
    ----------
    blocks
        The grid, cut along ``trial`` so that every end but the last is an end of blocks.
    trial
        Position of ``trial`` among the scene axes.
    coupled
        Positions of the coupled axes.
    ends
        Numbers of trials at which waves end.
    """

    blocks: Blocks
    trial: int
    coupled: tuple[int, ...]
    ends: tuple[int, ...]

    @staticmethod
    def of(pipeline: Pipeline, rule: Stopping, blocks: Blocks) -> Waves:
        """Return the groups and waves of a pipeline's blocks; ValueError if they do not fit."""
        names = [axis.name for axis in scene_axes(pipeline)]
        trial = names.index(TRIAL)
        if any(end % blocks.extents[trial] for end in rule.ends[:-1]):
            raise ValueError(f"blocks of {blocks.extents[trial]} trials, waves at {rule.ends}")
        coupled = tuple(k for k, name in enumerate(names) if name in rule.coupled)
        return Waves(blocks, trial, coupled, rule.ends)

    @property
    def free(self) -> tuple[int, ...]:
        """Positions of the axes that are neither coupled nor ``trial``."""
        return tuple(
            k for k in range(len(self.blocks.lengths)) if k not in self.coupled and k != self.trial
        )

    @property
    def groups(self) -> int:
        """The number of groups."""
        counts = self.blocks.counts
        return math.prod(counts[k] for k in self.free)

    def index(self, number: int) -> tuple[int, ...]:
        """Return a block's index along each scene axis."""
        index = []
        for count in reversed(self.blocks.counts):
            number, position = divmod(number, count)
            index.append(position)
        return tuple(reversed(index))

    def group(self, number: int) -> int:
        """Return the number of the group that a block belongs to."""
        index, counts, group = self.index(number), self.blocks.counts, 0
        for k in self.free:
            group = group * counts[k] + index[k]
        return group

    def wave(self, number: int) -> int:
        """Return the number of the wave that a block belongs to, from 0."""
        start = self.index(number)[self.trial] * self.blocks.extents[self.trial]
        return bisect_right(self.ends, start)

    def numbers(self, group: int, first: int, last: int | None = None) -> Iterator[int]:
        """Yield the numbers of a group's blocks in the waves ``first`` to ``last``.

        ``last`` is ``first`` if it is left out; earlier trials come first.
        """
        counts, extent = self.blocks.counts, self.blocks.extents[self.trial]
        at: dict[int, int] = {}
        for k in reversed(self.free):
            group, at[k] = divmod(group, counts[k])
        start = self.ends[first - 1] // extent if first else 0
        stop = -(-self.ends[first if last is None else last] // extent)
        for trial in range(start, stop):
            for along in product(*(range(counts[k]) for k in self.coupled)):
                index = {**at, self.trial: trial, **dict(zip(self.coupled, along, strict=True))}
                number = 0
                for k, count in enumerate(counts):
                    number = number * count + index[k]
                yield number

    def span(self, block: Block) -> Block:
        """Return the box of a block's group, of all its trials."""
        whole = {*self.coupled, self.trial}
        lengths = self.blocks.lengths
        return Block(
            tuple(0 if k in whole else start for k, start in enumerate(block.starts)),
            tuple(lengths[k] if k in whole else stop for k, stop in enumerate(block.stops)),
        )
