"""The statistics of `sweep.analysis.error_statistics`, a record each.

A new record here is all that a new statistic needs: the table of `error_statistics`, the attributes
of its variables and the report's table of errors follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sweep.analysis.counts import Count
from sweep.analysis.flip_mixture import FlipMixture
from sweep.analysis.means import Mean, MeanLength, RootMeanSquare, StandardDeviation
from sweep.analysis.pose_view import DETECTION_INPUTS, ERROR_INPUTS, ESTIMATE_INPUTS, Poses
from sweep.analysis.quantiles import Quantiles
from sweep.analysis.quantities import QUANTITIES, Quantity
from sweep.analysis.rates import DETECTION_RATE, FLIP_RATE, LOOKED_FOR, SOLVED, SOLVED_RATE
from sweep.analysis.statistic import Statistic

AnyPoseStatistic = Statistic[Poses, Any, Any, Any]


@dataclass(frozen=True)
class PoseStatistic:
    """A statistic of poses.

    Attributes
    ----------
    statistic
        What to compute.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.pose_view.pose_arrays`.
    """

    statistic: AnyPoseStatistic
    inputs: tuple[str, ...]


@dataclass(frozen=True)
class ErrorStatistic:
    """A statistic of each kind of error.

    Attributes
    ----------
    headings
        The statistic's part of its variables' names (``rmse`` of ``rotation_rmse_deg``), with
        what a table calls it; one, or more that are computed together.
    make
        Returns the statistic of a kind of error; its variables have the names
        ``quantity.named("rmse")``.
    inputs
        Names of the arrays that it reads, as in `sweep.analysis.pose_view.pose_arrays`, beside
        those that the kind of error reads.
    of_signed
        Whether it is computed of the errors along axes and about angles, `SIGNED`, too.
    """

    headings: Mapping[str, str]
    make: Callable[[Quantity], AnyPoseStatistic]
    inputs: tuple[str, ...] = field(default=ERROR_INPUTS)
    of_signed: bool = False


def _bias(quantity: Quantity) -> AnyPoseStatistic:
    """Return the mean error: signed if the error is, else the mean vector's length."""
    mean, of = (Mean, "mean") if quantity.signed else (MeanLength, "length of the mean")
    return mean(quantity.named("bias"), f"{of} {quantity.words}, solved and not flipped",
                quantity.units, quantity.vector, lambda poses: poses.unflipped)


def _root_mean_square(quantity: Quantity) -> AnyPoseStatistic:
    """Return the RMSE of the solved: of a rotation flips make most, and it is bounded."""
    labels = quantity.named("rmse"), f"RMS {quantity.words}, solved", quantity.units
    if quantity.bound is not None:
        return FlipMixture(*labels, quantity.squares, quantity.bound)
    return RootMeanSquare(*labels, quantity.squares, lambda poses: poses.solved)


POSE_STATISTICS: tuple[PoseStatistic, ...] = (
    PoseStatistic(Count(*LOOKED_FOR, lambda poses: poses.looked_for), DETECTION_INPUTS),
    PoseStatistic(Count(*SOLVED, lambda poses: poses.solved), ESTIMATE_INPUTS),
    *(PoseStatistic(record.rate, record.inputs)
      for record in (DETECTION_RATE, SOLVED_RATE, FLIP_RATE)),
)
"""What is known of the poses as such."""

QUANTILES = ErrorStatistic(
    {"median": "median (not solved: infinite)", "p95": "95 % quantile (p95)",
     "p99": "99 % quantile (p99)"},
    lambda quantity: Quantiles(
        quantity.named("{}"), f"absolute {quantity.words}", quantity.units, quantity.norm,
        lambda poses: poses.solved, lambda poses: poses.looked_for,
        # Why an end is missing is the same for all kinds of error.
        with_reason=quantity is QUANTITIES[0]))
"""Quantiles of absolute errors, which take a second pass over the poses."""

ERROR_STATISTICS: tuple[ErrorStatistic, ...] = (
    QUANTILES,
    ErrorStatistic(
        {"rmse": "RMSE of the solved"}, _root_mean_square),
    ErrorStatistic(
        {"rmse_unflipped": "RMSE without flips"},
        lambda quantity: RootMeanSquare(
            quantity.named("rmse_unflipped"), f"RMS {quantity.words}, solved and not flipped",
            quantity.units, quantity.squares, lambda poses: poses.unflipped)),
    ErrorStatistic({"bias": "bias without flips"}, _bias, of_signed=True),
    ErrorStatistic(
        {"sd": "standard deviation without flips"},
        lambda quantity: StandardDeviation(
            quantity.named("sd"),
            f"standard deviation of the {quantity.words}, solved and not flipped",
            quantity.units, quantity.vector, lambda poses: poses.unflipped),
        of_signed=True),
)
"""What is computed of each kind of error; of those of `SIGNED` only what says so."""


def quantiles_of(quantity: Quantity) -> PoseStatistic:
    """Return the quantiles of a kind of error, also of one with a sign: of the absolute values."""
    return PoseStatistic(QUANTILES.make(quantity), (*QUANTILES.inputs, *quantity.inputs))


def registered(quantities: Sequence[Quantity] = QUANTITIES) -> list[PoseStatistic]:
    """Return all statistics, those of some kinds of error among them."""
    return [*POSE_STATISTICS, *(
        PoseStatistic(record.make(quantity), (*record.inputs, *quantity.inputs))
        for quantity in quantities for record in ERROR_STATISTICS
        if quantity in QUANTITIES or record.of_signed)]


def error_headings() -> dict[str, str]:
    """Return the names of the statistics of errors by what a table calls them.

    Examples
    --------
    >>> error_headings()["bias without flips"]
    'bias'
    """
    return {heading: name for record in ERROR_STATISTICS
            for name, heading in record.headings.items()}


def guide_table() -> str:
    """Return the guide's table of the variables, in Markdown.

    Examples
    --------
    >>> print(guide_table().splitlines()[2])
    | `looked_for` | poses that were run, visible and modelled |
    """
    rows = [(record.statistic.outputs()[0].name, record.statistic.outputs()[0].meaning)
            for record in POSE_STATISTICS]
    rows += [(f"*_{name}_*", f"error: {heading}") for heading, name in error_headings().items()]
    return "\n".join(["| variable | meaning |", "| --- | --- |",
                      *(f"| `{name}` | {meaning} |" for name, meaning in rows)])
