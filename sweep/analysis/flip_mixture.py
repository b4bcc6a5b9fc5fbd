"""Root mean square of errors of which rare flips make most: an interval that counts unseen ones.

With 2 % flips of 60 degrees among errors of half a degree the mean square is nearly that of the
flips alone, and a third of all samples of 50 has none of them: whatever is computed from such a
sample alone says nothing of the mean square. What bounds it is how many flips the sample may have
missed, and that no rotation error is larger than half a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sweep.analysis.counts import BlockRateState, Rate, RateState, scaled_to_draws
from sweep.analysis.intervals import LEVEL, clopper_pearson
from sweep.analysis.means import BlockMeanState, CentredState, MeanState, RootMeanSquare
from sweep.analysis.pose_view import Poses
from sweep.analysis.states import BlockState, CellDeviations, Spread, State
from sweep.analysis.statistic import (
    Output,
    Statistic,
    Variables,
    interval_variables,
    with_interval,
)
from sweep.typing import Floats, Integers, Masks


@dataclass(frozen=True)
class MixtureState(State):
    """The squares of the poses that are not flipped, of those that are, and how many are."""

    unflipped: MeanState
    flipped: MeanState
    flips: RateState


@dataclass(frozen=True)
class BlockMixtureState(BlockState[MixtureState]):
    """The same of a block."""

    unflipped: BlockMeanState
    flipped: BlockMeanState
    flips: BlockRateState

    def fold(self) -> MixtureState:
        """Return the state of all cells."""
        return MixtureState(self.unflipped.fold(), self.flipped.fold(), self.flips.fold())


@dataclass(frozen=True)
class CentredMixture(State):
    """What the second pass knows."""

    unflipped: CentredState
    flipped: CentredState
    flips: RateState


@dataclass(frozen=True)
class MixtureSpread(State):
    """Sums over cells, of both parts."""

    unflipped: Spread
    flipped: Spread


@dataclass(frozen=True)
class BlockMixtureSpread(BlockState[MixtureSpread]):
    """The same of a block."""

    unflipped: CellDeviations
    flipped: CellDeviations

    def fold(self) -> MixtureSpread:
        """Return the sums over the cells."""
        return MixtureSpread(self.unflipped.fold(), self.flipped.fold())


FLIPS: Rate[Poses] = Rate("", "", lambda poses: poses.flipped, lambda poses: poses.solved)
"""The share of flips among the solved."""


@dataclass(frozen=True)
class FlipMixture(Statistic[Poses, MixtureState, CentredMixture, MixtureSpread]):
    """The root mean square over solved poses, with an interval that holds if flips are rare.

    The mean square is (1 - p) u + p v: p the share of flips, u the mean square of the other poses,
    v that of the flips. The interval's ends are the least and the largest value over the ends of
    p (Clopper and Pearson, Biometrika 26, 1934), u and v (`RootMeanSquare`), each right with 97.5 %
    at either end. Where v has no upper end, or one beyond it, ``bound`` takes its place.

    With 1, 2 and 5 % flips of 60 degrees among errors of half a degree it covers 0.97 to 1.00 from
    50 draws on. Without a flip in 50 draws the upper end is 48 degrees, in 1,000 draws 11, in
    10^6 draws 0.6: there are samples without flips of populations with such a mean square.
    """

    name: str
    meaning: str
    units: str
    squares: Callable[[Poses], Floats]
    bound: float
    """The largest error that exists, in the unit of the errors."""
    flips: Rate[Poses] = FLIPS
    """The share of flips, p."""
    level: float = LEVEL

    def outputs(self) -> Sequence[Output]:
        """Return the root mean square and its interval."""
        return with_interval(self.name, self.meaning, self.units)

    def _of(self, used: Callable[[Poses], Masks]) -> RootMeanSquare[Poses]:
        return RootMeanSquare("rms", "", self.units, self.squares, used, self.level)

    @property
    def _unflipped(self) -> RootMeanSquare[Poses]:
        return self._of(lambda poses: poses.unflipped)

    @property
    def _flipped(self) -> RootMeanSquare[Poses]:
        return self._of(lambda poses: poses.flipped)

    def first_pass(self, poses: Poses) -> BlockMixtureState:
        """Take the moments of both parts, and count."""
        return BlockMixtureState(
            self._unflipped.first_pass(poses), self._flipped.first_pass(poses),
            self.flips.first_pass(poses))

    def prepare_second(self, first: MixtureState) -> CentredMixture:
        """Return the moments with their means."""
        return CentredMixture(
            self._unflipped.prepare_second(first.unflipped),
            self._flipped.prepare_second(first.flipped), first.flips)

    def second_pass(self, poses: Poses, known: CentredMixture) -> BlockMixtureSpread:
        """Take the moments of the draws' deviations within the cells, of both parts."""
        return BlockMixtureSpread(
            self._unflipped.second_pass(poses, known.unflipped),
            self._flipped.second_pass(poses, known.flipped))

    def finish(self, known: CentredMixture, second: MixtureSpread) -> Variables:
        """Return the root mean square and its interval."""
        unflipped = self._unflipped.finish(known.unflipped, second.unflipped)
        flipped = self._flipped.finish(known.flipped, second.flipped)
        (u, u_low, u_high), (v, v_low, v_high) = (
            [part[f"rms{end}"] ** 2 for end in ("", "_low", "_high")]
            for part in (unflipped, flipped))
        others, flips = known.unflipped.moments.count[:, 0], known.flipped.moments.count[:, 0]
        with np.errstate(invalid="ignore"):
            square = np.where(others > 0, u * others, 0.0) + np.where(flips > 0, v * flips, 0.0)
            square = square / (others + flips)
        largest = self.bound**2
        lows = _first_known(u_low, v_low), _first_known(v_low, u_low)
        highs = [np.fmin(high, largest) for high in (u_high, v_high)]
        shares = _shares(self.flips.draws_of(known.flips), known.flips, self.level)
        low = np.minimum(*((1 - share) * lows[0] + share * lows[1] for share in shares))
        high = np.maximum(*((1 - share) * highs[0] + share * highs[1] for share in shares))
        # What is computed is rounded: the value lies in its interval.
        interval = (square, np.fmin(low, square), np.fmax(high, square))
        drawn = known.flips.sample.drawn
        ends = [np.where(drawn | (k == 0), each, np.nan) for k, each in enumerate(interval)]
        return interval_variables(self.name, [np.sqrt(each) for each in ends])


def _first_known(*values: Floats) -> Floats:
    """Return the first that is not NaN of each, or 0."""
    first, second = values
    return np.nan_to_num(np.where(np.isnan(first), second, first), nan=0.0)


def _shares(draws: Integers, flips: RateState, level: float) -> tuple[Floats, Floats]:
    """Return the ends of the share of flips, counted in draws."""
    fewest, most = scaled_to_draws(flips.hits, flips.sample.n, draws)
    return clopper_pearson(fewest, draws, level)[0], clopper_pearson(most, draws, level)[1]
