"""Poses and flips that a threshold on the ambiguity of planar poses keeps.

The ratio of a pose is its reprojection error over that of the other planar solution: the
"ambiguity" that users compare with a fixed number such as 0.2.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from operator import attrgetter

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from sweep.analysis import dataset, estimator
from sweep.analysis.dataset import Poses
from sweep.analysis.estimator import Bins, Count, Rate, Statistic
from sweep.analysis.intervals import TAIL, clopper_pearson
from sweep.analysis.summaries import FLIPPED, SOLVED
from sweep.errors import ArgumentError
from sweep.experiment.schema import cf_attributes
from sweep.measure.flags import Flag, flag
from sweep.typing import Floats, Masks

#: Thresholds that are tried by default; the infinite one keeps all poses.
THRESHOLDS = (
    0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, np.inf)

MAX_THRESHOLDS = 200

RATIO_INPUTS = (
    *dataset.ESTIMATE_INPUTS, "reprojection_error_px", "alternative_reprojection_error_px")


class ThresholdChoice(Flag):
    """Whether a threshold keeps the wanted flip rate."""

    not_run = flag(0, "No pose was solved.", counted=False)
    found = flag(1, "A threshold keeps the wanted flip rate.", present=True)
    not_needed = flag(2, "All poses together have the wanted flip rate.", present=True)
    too_few_draws = flag(3, "The draws show neither that a threshold keeps it nor that none does.")
    none = flag(4, "No threshold keeps it: at each the flip rate is shown to be higher.")
    nothing_drawn = flag(5, "No cell has two draws: nothing can be shown.")


def ambiguity_ratio(reprojection_px: ArrayLike, alternative_px: ArrayLike) -> Floats:
    """Return the ratio (...) of reprojection errors, the pose's over the other solution's.

    0 if there is no other solution (NaN), so that every threshold keeps the pose; 1 if both are 0,
    since nothing tells them apart; infinite if only the other's is 0. Above 1 the solver did not
    return the solution with the smaller error.

    Parameters
    ----------
    reprojection_px, alternative_px
        RMS reprojection errors (...) in pixels.

    Examples
    --------
    >>> ambiguity_ratio([0.1, 0.1, 0.0, 0.1], [0.4, np.nan, 0.0, 0.0]).tolist()
    [0.25, 0.0, 1.0, inf]
    """
    error = np.asarray(reprojection_px, dtype=np.float64)
    other = np.asarray(alternative_px, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = error / other
    ratio = np.where((error == 0) & (other == 0), 1.0, ratio)
    return np.where(np.isnan(other), 0.0, ratio)


class AmbiguousPoses(Poses):
    """Poses of a block with the ratios of their reprojection errors."""

    @cached_property
    def ratio(self) -> Floats:
        """Ratios (groups, cells, draws, settings), as `ambiguity_ratio` defines them."""
        return ambiguity_ratio(
            self["reprojection_error_px"], self["alternative_reprojection_error_px"])


@dataset.describes
def ambiguity(
    results: xr.Dataset, per: Sequence[str] = (), bins: Bins | None = None, *,
    thresholds: Iterable[float] = THRESHOLDS, flip_rate: float = 0.01, min_kept: float = 0.05,
) -> xr.Dataset:
    """Return the poses that thresholds on the ratio of reprojection errors keep, and which to take.

    A threshold keeps the solved poses with ``reprojection_error_px /
    alternative_reprojection_error_px`` of at most itself. A pose without another solution is
    always kept, one with two solutions of error 0 has the ratio 1 (`ambiguity_ratio`).

    Parameters
    ----------
    results, bins
        As in `sweep.analysis.detection_rate`.
    per
        Dimensions that are kept beside the detector's and the estimator's: configurations
        are never pooled.
    thresholds
        What to try, numbers of at least 0; infinity, which keeps all, is always among them.
    flip_rate
        The wanted share of flips among the kept poses, above 0 and below 1.
    min_kept
        Smallest share of the solved poses, 0 to 1, that a threshold must keep to be of use.

    Returns
    -------
    xr.Dataset
        Dimensions (*per, *configuration, *bins). Intervals are in
        ``x_low`` and ``x_high``.

        - ``solved``, ``flipped``, ``without_alternative``: solved poses, those of them that are
          nearer to the mirror of the truth, and those without another solution.
        - Along ``threshold``, increasing: ``kept`` and ``kept_flipped`` poses; ``kept_rate``, of
          the solved; ``kept_flip_rate``, flips of the kept; ``flips_kept_rate``, kept of the
          flips; ``right_rejected_rate``, rejected of the poses that are not flipped;
          ``rejected_right_rate``, not flipped of the rejected.
        - ``choice``: whether any threshold keeps the wanted flip rate (`ThresholdChoice`), and
          ``chosen_threshold``, the largest that is shown to; NaN if none is, infinite if none is
          needed. At it: ``chosen_kept_rate``, ``chosen_flip_rate``,
          ``chosen_right_rejected_rate``, and ``chosen_flip_rate_bound``, which the flip rate
          exceeds with a probability of 2.5 % at most, the choice included.

    Raises
    ------
    ArgumentError, DatasetError
        As in `sweep.analysis.detection_rate`; also for thresholds and rates that cannot be.

    Notes
    -----
    Each interval has 95 % for itself, over the random draws, conditional on the grid: Clopper and
    Pearson's (`sweep.analysis.intervals.clopper_pearson`), NaN if no cell has two draws. A
    threshold that was chosen because few flips were seen below it would look better than it is:
    it is therefore chosen by the upper ends of all thresholds together (Bonferroni: a tail of
    2.5 % over their number), so that a choice whose true flip rate is above the wanted one has a
    probability of 2.5 % at most, whatever the dependence between thresholds. Fewer ``thresholds``
    need fewer draws. ``none`` is said if at every threshold of use the lower end of the interval
    lies above the wanted rate; that all of them do by chance is no likelier than that one does.

    Flips mean nothing for frontal markers, whose mirrored pose is the pose itself.

    Examples
    --------
    >>> table = ambiguity(results, thresholds=[0.2, 0.5], flip_rate=0.4)
    >>> table["solver"].values.tolist(), table["kept"].values.tolist()
    (['ippe', 'iterative'], [[8, 13, 13], [13, 13, 13]])
    >>> [ThresholdChoice(choice).name for choice in table["choice"].values]
    ['not_needed', 'too_few_draws']
    """
    tried = np.array([*thresholds], dtype=np.float64)
    if not (0 < tried.size <= MAX_THRESHOLDS and (tried >= 0).all()):
        raise ArgumentError("thresholds", thresholds, "expected numbers of at least 0, "
                            f"{MAX_THRESHOLDS} at most, such as 0.2, 0.4")
    if not 0.0 < flip_rate < 1.0:
        raise ArgumentError(
            "flip_rate", flip_rate, "expected a number above 0 and below 1, such as 0.01")
    if not 0.0 <= min_kept <= 1.0:
        raise ArgumentError("min_kept", min_kept, "expected a number from 0 to 1, such as 0.05")
    kept = dataset.kept_dimensions(
        results, (*dataset.as_names(per), *dataset.configuration_axes(results)))
    counts: list[Statistic[AmbiguousPoses]] = [
        Count(*SOLVED, lambda poses: poses.solved),
        Count(*FLIPPED, lambda poses: poses.flipped),
        Count("without_alternative", "solved poses without another solution", lambda poses:
              poses.solved & np.isnan(poses["alternative_reprojection_error_px"]))]
    levels = np.unique([*tried, np.inf])
    table, *at_levels = estimator.aggregates(
        results, dataset.pose_arrays(results, RATIO_INPUTS), kept, [counts, *map(_rates, levels)],
        AmbiguousPoses, bins)
    table = table.assign(dataset.stacked(at_levels, "threshold")).assign_coords(
        threshold=("threshold", levels, cf_attributes(
            "largest ratio of both reprojection errors that is kept", "1")))
    tail = TAIL * estimator.TAIL_SHARE if dataset.is_sampling_stopped(results) else TAIL
    return _with_choice(table, flip_rate, min_kept, tail)


def _rates(threshold: float) -> list[Rate[AmbiguousPoses]]:
    """Return the rates at a threshold."""
    def kept(poses: AmbiguousPoses) -> Masks:
        return np.asarray(poses.solved & (poses.ratio <= threshold))

    def rejected(poses: AmbiguousPoses) -> Masks:
        return np.asarray(poses.solved & ~kept(poses))

    counts = (("kept", "poses that the threshold keeps"),
              ("kept_flipped", "flips that the threshold keeps"))
    return [
        Rate(name, meaning, hits, of, exact=True, counts=counts if of is kept else ())
        for name, meaning, hits, of in (
            ("kept_rate", "kept of the solved poses", kept, attrgetter("solved")),
            ("kept_flip_rate", "flips of the kept poses", attrgetter("flipped"), kept),
            ("flips_kept_rate", "kept of the flips", kept, attrgetter("flipped")),
            ("right_rejected_rate", "rejected of the poses that are not flipped", rejected,
             attrgetter("unflipped")),
            ("rejected_right_rate", "not flipped of the rejected poses", attrgetter("unflipped"),
             rejected))]


#: Variables at the chosen threshold: name there -> description.
CHOSEN = {
    "threshold": ("threshold", "largest threshold that is shown to keep the wanted flip rate"),
    "kept_rate": ("kept_rate", "kept of the solved poses, at the chosen threshold"),
    "flip_rate": ("kept_flip_rate", "flips of the kept poses, at the chosen threshold"),
    "flip_rate_bound": ("bound", "upper bound of the flip rate at the chosen threshold"),
    "right_rejected_rate": (
        "right_rejected_rate", "rejected of the poses not flipped, at the chosen threshold"),
}


def _with_choice(
    table: xr.Dataset, flip_rate: float, min_kept: float, tail: float
) -> xr.Dataset:
    """Return the table with the chosen threshold of each group."""
    _, most = estimator.scaled_to_draws(*(
        table[name].values for name in ("kept_flipped", "kept", "draws")))
    level = 1.0 - 2.0 * tail / table.sizes["threshold"]
    bound = table["kept"].copy(data=clopper_pearson(most, table["draws"], level)[1])
    useful = (table["kept_rate"] >= min_kept) | np.isinf(table["threshold"])
    low = table["kept_flip_rate_low"]
    meets = useful & low.notnull() & (bound <= flip_rate)
    of_all = {"threshold": -1}
    choice = table["solved"].copy(data=np.select(
        [table["kept"].isel(of_all) == 0, low.isel(of_all).isnull(), meets.isel(of_all),
         meets.any("threshold"), ((low > flip_rate) | ~useful).all("threshold")],
        [ThresholdChoice.not_run, ThresholdChoice.nothing_drawn, ThresholdChoice.not_needed,
         ThresholdChoice.found, ThresholdChoice.none],
        ThresholdChoice.too_few_draws).astype(np.uint8))
    # The largest threshold that meets.
    at = (meets * np.arange(table.sizes["threshold"])).argmax("threshold")
    columns = table.assign(bound=bound).isel(threshold=at).reset_coords("threshold").where(
        meets.any("threshold"))
    chosen = {f"chosen_{name}": columns[source].assign_attrs(cf_attributes(meaning, "1"))
              for name, (source, meaning) in CHOSEN.items()}
    chosen["choice"] = choice.assign_attrs(
        cf_attributes("whether a threshold keeps the wanted flip rate", flags=ThresholdChoice))
    return table.assign(chosen).assign_attrs(flip_rate=flip_rate, min_kept=min_kept)
