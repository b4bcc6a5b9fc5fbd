"""The figures of a report, each a table of one analysis by configuration, and tables of errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import xarray as xr

from sweep import analysis
from sweep.analysis.estimator import Bins
from sweep.analysis.requirements import BOARDS, Reached
from sweep.analysis.summaries import ThresholdChoice
from sweep.experiment.parameters import Stage
from sweep.measure.flags import BoundStatus, outcomes, present_values
from sweep.report import report_data
from sweep.report.figure import MAX_DOTS, MAX_LINES, Figure, caption_of, sentences
from sweep.report.findings import trade_figure
from sweep.report.report_data import AREA, CARDS, CONFIGURATION, IDS, Groups, ReportData, grouped
from sweep.report.table import Column, Table, table_of

# --------------------------------------------------------------------------------------------------
# Columns that several figures share.

DETECTED, SOLVED, ROTATION_MEDIAN, _, _, RANGE_BIAS, _ = CARDS
LOOKED_FOR = Column("looked for", "looked_for")
SOLVED_COUNT = Column("n solved", "solved")
FLIPS = Column("flips, % of the solved", "flip_rate", 100)
ROTATION_P95 = Column("rotation p95, deg", "rotation_p95_deg")
RANGE_MEDIAN = Column("range median, %", "range_median_percent")
RANGE_P95 = Column("range p95, %", "range_p95_percent")
RATES = (LOOKED_FOR, DETECTED)
ERROR_CURVES = (ROTATION_MEDIAN, ROTATION_P95, RANGE_MEDIAN, RANGE_P95)
ERRORS = (
    SOLVED, ROTATION_MEDIAN, ROTATION_P95,
    Column("rotation RMSE without flips, deg", "rotation_rmse_unflipped_deg"),
    RANGE_MEDIAN, RANGE_P95, Column("range RMSE without flips, %", "range_rmse_unflipped_percent"),
    RANGE_BIAS, Column("position median, mm", "position_median_m", 1000.0),
    Column("position p95, mm", "position_p95_m", 1000.0), FLIPS)
#: Kinds of errors, as `sweep.analysis.error_statistics` takes them.
SIGNED_GROUPS = ("range", "camera_frame", "yaw_pitch_roll")

#: Bias and standard deviation along the camera's axes and about the angles.
SIGNED_COLUMNS = (SOLVED_COUNT, RANGE_BIAS, *(
    Column(f"{name} {words}, {unit}", f"{name}_{statistic}_{stored}", scale,
           0.0 if words == "bias" else None)
    for names, unit, stored, scale in (("xyz", "mm", "m", 1000.0),
                                       (("yaw", "pitch", "roll"), "deg", "deg", 1.0))
    for name in names for words, statistic in (("bias", "bias"), ("SD", "sd"))))

EFFICIENCIES = tuple(
    Column(f"{quantity} efficiency", f"{quantity}_efficiency", level=1.0)
    for quantity in ("rotation", "range"))

#: Angles that are lines of one configuration, and panels of several.
MAX_ANGLES, MAX_ANGLE_PANELS = 6, 2


# --------------------------------------------------------------------------------------------------
# A figure, or a table alone, of an analysis by configuration and groups of poses.


def figure(
    data: ReportData, summary: xr.Dataset, groups: Groups, name: str, title: str, text: str,
    columns: Sequence[Column], curves: Sequence[Column], *, by: str = "",
    covers: Sequence[str] = (),
) -> Figure:
    """Return a figure of `grouped`, the last of whose groups are along x.

    Its caption also names pooled axes, and values that are not drawn.
    """
    dims, count = list(groups), summary.sizes[CONFIGURATION]
    if not by and (count > 1 or len(dims) > 1):
        by = CONFIGURATION if count > 1 else data.label(dims[0])
    return Figure(
        name, title, sentences(
            text,
            caption_of("first_lines", drawn=MAX_LINES, count=count)
            if dims and count > MAX_LINES else "",
            report_data.notes_of(data, groups),
            data.pooled(*dims, *report_data.configurations(data).axes)),
        configuration_table(data, summary, dims, title, columns), curves,
        data.label(dims[-1]) if dims else "", by, covers=covers)


def configuration_table(
    data: ReportData, summary: xr.Dataset, dims: Sequence[str], caption: str,
    columns: Sequence[Column], counted: str = "looked_for",
) -> Table:
    """Return the table of an analysis (configuration, *dims), with 95 % intervals."""
    if summary.sizes[CONFIGURATION] > 1 or not dims:
        dims = [CONFIGURATION, *dims]
    else:
        summary = summary.isel({CONFIGURATION: 0})
    return table_of(summary, f"{caption}, with 95 % intervals", dims, columns, data.results,
                    counted=counted)


# --------------------------------------------------------------------------------------------------
# The figures.


def _along(data: ReportData, name: str) -> Figure:
    """Return the figure of rates and errors along an axis, the area, or a drawn parameter.

    Along the size each angle is apart: a line of one configuration, a panel of several.
    """
    axis = data.pipeline.axis(name)
    meaning = axis.meaning if axis is not None else (
        "in the image" if name == AREA else data.pipeline.parameters[name].meaning)
    groups = data.along(name)
    if data.angle_axis and name == data.size:
        several = data.setting_axes or data.pipeline.experiment.target_axes
        most = MAX_ANGLE_PANELS if several else MAX_ANGLES
        groups = {**data.along(data.angle_axis, most), **groups}
    return figure(
        data, grouped(data, analysis.error_statistics, groups), groups, f"by-{name}",
        f"Rates and errors by {data.words(name)}",
        caption_of("along", target=data.pipeline.target_word, axis=name, meaning=meaning),
        (*RATES, *ERRORS), [DETECTED, *ERROR_CURVES, FLIPS, RANGE_BIAS], covers=tuple(groups))


#: From this many values on, an axis of numbers has a figure along it beside its configurations.
MIN_DRAWN = 3


def _configurations(data: ReportData) -> Figure | None:
    known = report_data.configurations(data)
    if not known.several:
        return None
    covers = [
        axis.name for axis in data.pipeline.axes
        if len(known.axes.get(axis.name, ())) == len(axis)
        and (not axis.is_numeric or len(axis) < MIN_DRAWN)]
    return figure(
        data, known.summary, {}, "configurations",
        f"Configurations compared: {', '.join(known.axes)}",
        caption_of("configurations"), (LOOKED_FOR, *ERRORS),
        (SOLVED, ROTATION_MEDIAN, RANGE_MEDIAN, FLIPS), covers=covers)


def _trade(data: ReportData) -> Figure | None:
    if data.trade is None:
        return None
    budget = data.trade.attrs.get("budget_ms")
    return trade_figure(data.trade, lines=report_data.trade_lines(data, data.trade, budget))


def _outcomes(data: ReportData) -> Figure:
    names = [name for name in (data.size_axis, *data.scene_axes, data.size)
             if name is not None and name != IDS
             and data.pipeline.axis(name) not in data.pipeline.experiment.target_axes]
    groups = data.along(names[0]) if names else {}
    summary = grouped(data, analysis.failure_composition, groups)
    counts = summary["count"].sum(
        [name for name in summary["count"].dims if name != "outcome"]).to_series()
    excluded = counts[list(outcomes(counted=False))]
    left_out = ", ".join(f"{count:,} {name}" for name, count in excluded.items() if count)
    total = summary["count"].where(summary["share"].notnull(), 0).sum("outcome").astype(int)
    happened = summary.sel(outcome=[
        name for name, count in counts.items() if count and name not in excluded])
    share = Column("share, %", "share", 100)
    return figure(
        data, happened.assign(looked_for=total),
        {"outcome": None, **groups}, "failures", "Outcomes of the poses",
        caption_of("outcomes", by=data.words(names[0]) if names else "", left_out=left_out),
        (LOOKED_FOR, share), [share], by="outcome")


def marker_ranking(results: xr.Dataset, per: Sequence[str], **_: Bins) -> xr.Dataset:
    """Return the ranking of marker IDs, which are kept apart anyway."""
    return analysis.marker_ranking(results, [name for name in per if name != IDS])


def _ranking(data: ReportData) -> Figure | None:
    """Return the detection rates of marker IDs, the weak ones first."""
    if data.results.sizes.get(IDS, 1) < 2:
        return None
    table = configuration_table(
        data, grouped(data, marker_ranking, {IDS: None}, [Stage.detection]), [IDS],
        "IDs by detection rate", (
            *RATES, Column("expected, %", "expected_rate", 100),
            Column("p, adjusted", "p_adjusted"), Column("weak", "weak")))
    rates, weak = (table.frame[name].tolist() for name in (DETECTED.heading, "weak"))
    order = sorted(range(len(weak)), key=lambda k: (not weak[k], rates[k]))
    return Figure(
        "ranking", "Marker IDs, the weakest first", sentences(
            caption_of("ranking", shown=min(MAX_DOTS, len(weak)), weak=sum(weak), count=len(weak)),
            data.pooled(IDS, *report_data.configurations(data).axes)),
        dataclasses.replace(table, frame=table.frame.iloc[order]), [DETECTED], by="weak",
        covers=[IDS])


def _bound(data: ReportData) -> Figure | None:
    if "bound" not in data.results or not data.once("has bound", lambda: bool(
            data.results["bound"].isin(present_values(BoundStatus)).any())):
        return None
    along = data.size_axis or data.angle_axis
    groups = data.along(along) if along else {}
    return figure(
        data, grouped(data, analysis.efficiency, groups), groups, "bound",
        "Efficiency: the accuracy bound over the errors", caption_of("bound"),
        EFFICIENCIES, EFFICIENCIES)


# --------------------------------------------------------------------------------------------------
# The figures of a store, in the order in which they stand.

#: Makers of figures, None for a store that a figure does not fit; add one here.
FIGURES: tuple[Callable[[ReportData], Figure | None], ...] = (
    lambda data: None if data.size is None else _along(data, data.size), _configurations, _trade,
    _outcomes, _ranking, _bound,
)


def figures_of(data: ReportData) -> list[Figure]:
    """Return the figures of a store, such that one shows each axis and drawn parameter."""
    made = [figure for make in FIGURES if (figure := make(data)) is not None]
    covered = {name for figure in made for name in figure.covers}
    drawn = [name for name in data.pipeline.distributions if name in data.results.variables]
    return made + [_along(data, name) for name in (*data.scene_axes, *data.setting_axes, *drawn)
                   if name not in covered]


# --------------------------------------------------------------------------------------------------
# Tables of signed errors, of boards' markers, of thresholds, and of the precision that was reached.

#: The threshold on the ambiguity that many programs use, and what it keeps.
USUAL = 0.2
KEPT_AT_USUAL = (
    Column("solved", "solved"), Column("flips", "flipped"),
    Column(f"kept at {USUAL:g}, %", "kept_rate", 100),
    Column(f"flips kept at {USUAL:g}", "kept_flipped"),
    Column(f"right of the rejected at {USUAL:g}, %", "rejected_right_rate", 100),
    Column("threshold found?", "choice"), Column("threshold", "chosen_threshold"),
    Column("kept there, %", "chosen_kept_rate", 100),
    Column("flips there, %", "chosen_flip_rate", 100),
    Column("right poses rejected there, %", "chosen_right_rejected_rate", 100))

#: The most sizes, or angles, that a table of thresholds tells apart.
MAX_SIZES = 8


def tables_of(data: ReportData) -> list[Table]:
    """Return the tables below a report's figures."""
    rule, boards = data.pipeline.stopping, "marker_detection" in data.results
    return [
        *([board_table(data)] if boards else []),
        configuration_table(
            data, grouped(data, signed_error_statistics), (),
            "Bias and spread of the solved poses without flips", SIGNED_COLUMNS, "solved"),
        *threshold_tables(data),
        *([precision_table(data.once(
            "precision_reached", lambda: analysis.precision_reached(data.results)))]
          if rule is not None and rule.precision else [])]


def board_table(data: ReportData) -> Table:
    """Return the rates of boards' single markers, by board and detector setting."""
    axes = [data.pipeline.axis_of(BOARDS), *data.pipeline.axes_of(Stage.detection)]
    dims = [axis.name for axis in axes if axis is not None and len(axis) > 1]
    rates = data.once(("markers of boards", *dims), lambda: analysis.detection_rate(
        analysis.per_marker(data.results), dims))
    return table_of(
        rates, "Markers of boards, each counted by itself, with 95 % intervals", dims, RATES,
        data.results)


def signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    """Return bias and spread of the range, of x, y and z in the camera's frame, and of angles."""
    return analysis.error_statistics(results, per, bins, SIGNED_GROUPS)


def threshold_tables(data: ReportData) -> list[Table]:
    """Return what thresholds on the ambiguity keep, where poses have a mirror and some are flips.

    At each size: the poses that the usual threshold keeps, and the largest that is shown to keep
    few flips.
    """
    if "alternative_reprojection_error_px" not in data.results:
        return []
    along = data.size or data.angle_axis
    groups = data.along(along, MAX_SIZES) if along else {}
    table = grouped(data, analysis.ambiguity, groups)
    if not ((table["without_alternative"] < table["solved"]) & (table["flipped"] > 0)).any():
        return []
    words = [ThresholdChoice(flag).name.replace("_", " ") for flag in np.ravel(table["choice"])]
    choice = table["choice"].copy(data=np.reshape(np.array(words, object), table["choice"].shape))
    wanted = 100 * float(table.attrs["flip_rate"])
    return [table_of(
        table.sel(threshold=USUAL, drop=True).assign(choice=choice),
        f"Thresholds on the ambiguity, with 95 % intervals; wanted: {wanted:g} % flips",
        [CONFIGURATION, *groups], KEPT_AT_USUAL, data.results)]


def precision_table(table: xr.Dataset) -> Table:
    """Return a row for each quantity and configuration of `sweep.analysis.precision_reached`."""
    kept = ["quantity", *table.attrs["configuration_dims"]]
    reached, run = table["reached"], table["run"].isel(dict.fromkeys(kept[1:], 0)).values
    pooled = [dim for dim in reached.dims if dim not in kept]
    known = reached.isin((Reached.reached, Reached.not_reached))
    counts = {each.name: (reached == each).sum(pooled) for each in Reached}
    return table_of(
        table[["wanted"]].assign(
            counts | {"widest": table["half_width"].where(known).max(pooled)}),
        f"Precision of {run.size:,} conditions, which took {int(run.min()):,} to "
        f"{int(run.max()):,} poses each: conditions by what was reached; of rates the "
        "half-width of the interval, of others relative to the value (bias: to the RMSE)",
        kept, [Column(name.replace("_", " "), name) for name in ("wanted", "widest", *counts)])
