"""The figures of a report, each as data of one analysis, and its tables of errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import (
    ambiguity,
    detection_rate,
    efficiency,
    error_statistics,
    failure_composition,
    flip_rate,
    marker_ranking,
    per_marker,
    precision_reached,
)
from sweep.analysis.ambiguities import ThresholdChoice
from sweep.analysis.binning import Bins
from sweep.analysis.poses import SIGNED
from sweep.analysis.precision import Reached
from sweep.analysis.requirements import BOARDS
from sweep.analysis.summaries import error_headings
from sweep.experiment.experiment import target_word
from sweep.experiment.parameters import Stage
from sweep.measure.flags import BoundStatus, outcomes, present_values
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.report.charts import Panel, Series, draw_dots, draw_lines, rows_height
from sweep.report.figure import (
    Curve,
    Figure,
    Grouped,
    along_axis,
    denominators,
    dots_of,
    grouped,
    interval_sentence,
    map_panel,
    sentences,
)
from sweep.report.formatting import number
from sweep.report.report_data import (
    AREA,
    BOTH,
    CONFIGURATION,
    IDS,
    MAX_LINES,
    Analysis,
    Grouping,
    ReportData,
    axis_label,
    by_configuration,
    configurations,
    course_of,
    first_detector,
    group_labels,
    is_numeric,
)
from sweep.report.table import Columns, Table, cells, each_cell, table_of
from sweep.report.tradeoff_figure import trade_panels, trade_table_and_text

# --------------------------------------------------------------------------------------------------
# Columns and curves that several figures share.

LOOKED_FOR: Columns = {"looked for": ("looked_for", 1.0)}
RATES: Columns = LOOKED_FOR | {"detected, %": ("detection_rate", 100.0)}
FLIPPED: Columns = {"flipped, %": ("flip_rate", 100.0)}
ERRORS: Columns = {
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "rotation RMSE without flips, deg": ("rotation_rmse_unflipped_deg", 1.0),
    "range median, %": ("range_median_percent", 1.0),
    "range p95, %": ("range_p95_percent", 1.0),
    "range RMSE without flips, %": ("range_rmse_unflipped_percent", 1.0),
    "range bias, %": ("range_bias_percent", 1.0),
}
SIGNED_GROUPS = ("range", "camera_frame", "yaw_pitch_roll")
"""Kinds of errors, as `sweep.analysis.error_statistics` takes them."""

IN_MM, IN_DEG = ("x", "y", "z"), ("yaw", "pitch", "roll")
SIGNED_COLUMNS: Columns = {"solved": ("solved", 1.0)} | {
    f"{name} {words}, {unit}": (f"{name}_{statistic}_{stored}", scale)
    for names, unit, stored, scale in ((IN_MM, "mm", "m", 1000.0), (IN_DEG, "deg", "deg", 1.0))
    for name in names for words, statistic in (("bias", "bias"), ("SD", "sd"))
}
"""Bias and standard deviation along the camera's axes and about the angles."""

DETECTED = Curve("detection_rate", "Detected", "%", 100.0, share=True)
SOLVED = Curve("solved_rate", "Solved", "%", 100.0, share=True)
FLIPS = Curve("flip_rate", "Flipped", "% of the solved", 100.0, share=True)
ROTATION_P95 = Curve("rotation_p95_deg", "Rotation error, p95", "deg")
ERROR_CURVES = (
    Curve("rotation_median_deg", "Rotation error, median", "deg"), ROTATION_P95,
    Curve("range_median_percent", "Range error, median", "%"),
    Curve("range_p95_percent", "Range error, p95", "%"),
)
RANGE_BIAS = Curve("range_bias_percent", "Range bias", "%", level=0.0)
SIGNED_CURVES = (
    RANGE_BIAS, *(Curve(f"{name}_bias_m", f"{name} bias", "mm", 1000.0, level=0.0)
                  for name in IN_MM),
    Curve("yaw_bias_deg", "Yaw bias", "deg", level=0.0),
)
BOUND_CURVES = tuple(
    Curve(f"{quantity}_over_bound", f"{quantity.capitalize()} RMSE over the bound", level=1.0)
    for quantity in ("rotation", "range"))
INFINITE_ERRORS = (
    "In median and p95 a pose that is not solved counts as an infinite error (drawn at the edge); "
    "an interval that reaches the edge ends beyond all draws.")

SHORT_NAMES = {AREA: "area", "side_px": "size", "distance_m": "distance", "size_m": "marker size"}
"""Names of the measures of size in titles and sentences."""

MIN_BINNED_SIZES = 20
"""From this many sizes on, the detection rate is drawn against bins of the area."""


def _along(
    data: ReportData, name: str, title: str, text: str, analysis: Analysis, along: str,
    curves: Sequence[Curve], caption: str, columns: Columns, *, stages: Sequence[Stage] = BOTH,
    angles: bool = True, counted: str = "looked_for", covers: Sequence[str] = (),
) -> Figure:
    """Return the figure of an analysis along an axis."""
    found = along_axis(data, analysis, along, stages, angles=angles)
    return Figure(name, title, found.caption(text, curves, counted), found.table(caption, columns),
                  found.panels(curves), covers)


def _short(name: str) -> str:
    return SHORT_NAMES.get(name, name)


def _size_axes(data: ReportData) -> list[str]:
    return [name for name in (data.size_axis, data.angle_axis) if name]


def _detection(data: ReportData) -> Figure | None:
    if data.size is None:
        return None
    axis = data.size_axis
    along = AREA if axis is None or data.length(axis) >= MIN_BINNED_SIZES else axis
    word = target_word(data.pipeline)
    detected = f"the {word} is detected" + (", by at least one marker" * (word != "marker"))
    by = f", by {data.angle}" if data.angle else ""
    return _along(
        data, "detection", f"Detection rate by {_short(along)}",
        f"Share of the poses looked for in which {detected}, against its {_short(along)}{by}.",
        detection_rate, along, [DETECTED], "Detection rate", RATES | {"draws": ("draws", 1)},
        stages=(Stage.detection,), covers=_size_axes(data))


def _errors(data: ReportData) -> Figure | None:
    if data.size is None:
        return None
    by = f", by {data.angle}" if data.angle else ""
    return _along(
        data, "errors", f"Errors of the pose by {_short(data.size)}",
        f"Error of the estimated pose against the {target_word(data.pipeline)}'s "
        f"{_short(data.size)}{by}: median and 95 % quantile (p95) of the rotation error and of "
        f"the range error (depth, relative to the true depth). {INFINITE_ERRORS}",
        error_statistics, data.size, ERROR_CURVES, "Errors", LOOKED_FOR | ERRORS,
        covers=_size_axes(data))


def signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    """Return bias and spread of the range, of x, y and z in the camera's frame, and of angles."""
    return error_statistics(results, per, bins, SIGNED_GROUPS)


def signed_axis(data: ReportData) -> str | None:
    """Return the axis along which bias is shown: of sizes, other numbers, or angles."""
    along = course_of(data, data.per)[0]
    return along if along not in (None, data.angle_axis) else data.size or data.angle_axis


def _bias(data: ReportData) -> Figure | None:
    along = signed_axis(data)
    if along is None:
        return None
    return _along(
        data, "bias", f"Bias by {_short(along)}",
        "Mean error of the solved poses that are not flipped, estimated minus true, against the "
        f"{_short(along)}: the range in percent of the true depth; x (right), y (down) and z "
        f"(forward) of the {target_word(data.pipeline)}'s position in the camera's frame; yaw. "
        "The table also has the standard deviations, and pitch and roll.",
        signed_error_statistics, along, SIGNED_CURVES, "Bias and standard deviation",
        SIGNED_COLUMNS, angles=False, counted="solved")


MIN_DRAWN = 3
"""From this many values on, an axis of numbers has a figure along it beside its configurations."""


def _configurations(data: ReportData) -> Figure | None:
    if not data.setting_axes:
        return None
    known = configurations(data)
    found = Grouped(data, known.settings, known.summary.assign_coords(
        {CONFIGURATION: known.names}), (), known.notes)
    curves = [SOLVED, ERROR_CURVES[0], ERROR_CURVES[2],
              *([FLIPS] if known.summary["solved"].sum() > 0 else [])]
    axes = {axis.name: axis for axis in data.pipeline.axes}
    covers = [name for name in data.setting_axes
              if len(known.settings.axes[name]) == data.length(name)
              and (not is_numeric(axes[name]) or data.length(name) < MIN_DRAWN)]
    return Figure(
        "configurations", f"Configurations compared: {', '.join(known.settings.grouping.dims)}",
        found.caption(
            "Share of the poses looked for that are solved, and the median errors, of each "
            "configuration on the same images; a pose that is not solved counts as an infinite "
            "error (right edge, \u221e).", curves),
        found.table("Configurations", LOOKED_FOR | ERRORS | FLIPPED), found.panels(curves), covers)


def _trade(data: ReportData) -> Figure | None:
    if data.trade is None:
        return None
    table, text = trade_table_and_text(data.trade)
    return Figure("trade", "Cost and accuracy", text, table, trade_panels(data.trade))


MAP_COLUMNS, MAP_ROWS = 24, 20


def _maps(data: ReportData) -> Figure | None:
    if data.size_axis is None or data.angle_axis is None:
        return None
    groups = data.along(data.angle_axis, MAP_ROWS) + data.along(data.size_axis, MAP_COLUMNS)
    errors = grouped(data, error_statistics, groups)
    detected = grouped(data, detection_rate, groups, (Stage.detection,))
    flips = grouped(data, flip_rate, groups)
    seen = int(flips.summary["solved"].sum()) > 0
    return Figure(
        "maps", f"Detection, rotation error and flips over {_short(data.size_axis)} and "
                f"{data.angle}",
        errors.caption(
            "Detection rate; 95 % quantile of the rotation error, in which a pose that is not "
            "solved counts as an infinite error (\u221e); and the share of the solved poses that "
            "are nearer to the mirror of the truth than to the truth, which hardly differ at a "
            f"{data.angle} near 0."),
        errors.table("Detection rate, rotation error and flips", RATES | {
            "rotation p95, deg": ("rotation_p95_deg", 1.0), "solved": ("solved", 1.0)} | FLIPPED),
        [*detected.maps(DETECTED), *errors.maps(ROTATION_P95), *(flips.maps(FLIPS) * seen)])


# Outcomes: solved, or the flag that says why not.

MAX_BARS = 24


def _outcomes(data: ReportData) -> Figure:
    names = [name for name in (data.size_axis, *data.scene_axes, data.size)
             if name is not None and name != IDS]
    axis = names[0] if names else None
    found = grouped(data, failure_composition, data.along(axis, MAX_BARS) if axis else None)
    summary = found.summary
    if axis and axis in summary.indexes and np.issubdtype(summary[axis].dtype, np.number):
        summary = summary.isel({axis: np.argsort(summary[axis].values, kind="stable")})
    counts = summary["count"].sum([name for name in summary["count"].dims if name != "outcome"])
    all_outcomes = [str(name) for name in summary["outcome"].values.tolist()]
    happened = [name for name in all_outcomes if counts.sel(outcome=name) > 0
                and np.isfinite(summary["share"].sel(outcome=name)).any()]
    parts = {f"{name}{end}": summary[f"share{end}"].sel(outcome=name, drop=True)
             for name in happened for end in ("", "_low", "_high")}
    total = summary["count"].where(summary["share"].notnull(), 0).sum("outcome")
    found = Grouped(data, found.settings, xr.Dataset(
        parts | {"looked_for": total.astype(int)}), found.dims, found.notes)
    excluded = ", ".join(f"{int(counts.sel(outcome=name)):,} {name}"
                         for name in outcomes(counted=False)
                         if name in all_outcomes and counts.sel(outcome=name) > 0)
    return Figure(
        "failures", "Outcomes of the poses",
        found.caption(
            "Shares of the poses looked for" + (f", by {_short(axis)}" if axis else "")
            + ": solved, or the flag that says why not."
            + (f" Not counted in the shares: {excluded}." if excluded else "")),
        found.table("Shares in percent", LOOKED_FOR | {
            f"{name.replace('_', ' ')}, %": (name, 100.0) for name in happened}),
        found.bars("Outcome", {name: name for name in happened}))


# The place in the frame.

ACROSS, DOWN = "frame_u_percent", "frame_v_percent"
FRAME_COLUMNS, FRAME_ROWS = 8, 6
MIN_RANGE_PERCENT = 10.0
"""From this range of places on, in percent of the frame's width, there is a figure."""

TRUE = "true_tvec_m"


def _frame(data: ReportData) -> Figure | None:
    """Return the figure of the detection rate over the frame of a single camera without a lens."""
    fixed = data.pipeline.fixed
    if (TRUE not in data.results or fixed.get("distortion")
            or any(name not in fixed for name in VIEW_PARAMETERS)):
        return None
    fx, fy, cx, cy = map(float, intrinsics(*(fixed[name] for name in VIEW_PARAMETERS)))
    x, y, z = (data.results[TRUE].isel(xyz=k, drop=True) for k in range(3))
    ahead = z.where(z > 0)
    place = {ACROSS: 100 * (fx * x / ahead + cx + 0.5) / fixed["width_px"],
             DOWN: 100 * (fy * y / ahead + cy + 0.5) / fixed["height_px"]}
    ranges = data.once("ranges in the frame", lambda: xr.Dataset(
        {name: share.max() - share.min() for name, share in place.items()}))
    if not max(float(each) for each in ranges.values()) >= MIN_RANGE_PERCENT:
        return None

    def over_frame(results: xr.Dataset, per: Sequence[str], bins: Bins) -> xr.Dataset:
        return detection_rate(results.assign(place), per, bins)

    found = grouped(data, over_frame, Grouping(bins=tuple(
        (name, (*np.linspace(0, 100, count + 1)[:-1].tolist(), float(np.nextafter(100, 101))))
        for name, count in ((DOWN, FRAME_ROWS), (ACROSS, FRAME_COLUMNS)))), (Stage.detection,))
    return Figure(
        "frame", "Detection by place in the frame",
        found.caption(
            f"Detection rate by the place of the {target_word(data.pipeline)}'s centre in the "
            "frame, in percent of its width and height from the top left corner; a dash: no pose "
            "was looked for there."),
        found.table("Detection rate by place", RATES), found.maps(DETECTED, upwards=False))


# Marker IDs.

WEAKEST = 24
"""Marker IDs that have a row of their own in the chart."""


def _ranking(data: ReportData) -> Figure | None:
    if data.length(IDS) < 2:
        return None
    first, whose = first_detector(data)
    summary = data.once("marker_ranking", lambda: marker_ranking(data.results.isel(first)))
    dims = [name for name in ("dictionary", IDS) if name in summary["detection_rate"].dims]
    ranked = summary.stack(marker=dims, create_index=False)
    ranked = ranked.isel(marker=np.flatnonzero(ranked["looked_for"].values > 0))
    ranked = ranked.isel(marker=np.lexsort(
        (ranked[IDS].values, ranked["detection_rate"].values, ~ranked["weak"].values)))
    labels = [[str(value) for value in ranked[dim].values.tolist()] for dim in dims]
    names = [" ".join(parts) for parts in zip(*labels, strict=True)][:WEAKEST]
    weakest = ranked.isel(marker=slice(0, WEAKEST))
    dots, weak = dots_of(weakest, "detection_rate", 100), weakest["weak"].values.astype(bool)
    expected = 100 * weakest["expected_rate"].values.astype(np.float64)
    columns = [cells(ranked, *each) for each in (
        ("looked_for",), ("detection_rate", 100), ("expected_rate", 100), ("p_adjusted",),
        ("weak",))]
    return Figure(
        "ranking", "Marker IDs, the weakest first" + (f": {whose}" if whose else ""),
        sentences(
            f"Detection rate of each ID{' of each dictionary' if len(dims) > 1 else ''}; the small "
            "upright line is the rate expected from its scenes if all IDs were alike. "
            f"{int(ranked['weak'].sum()):,} of {ranked.sizes['marker']:,} IDs are weak "
            "(diamonds): below the expected rate, with an adjusted p-value under 0.05.",
            interval_sentence(data, summary), denominators(summary), data.pooled(*dims)),
        Table.of(
            "IDs by detection rate, with 95 % intervals",
            [*(axis_label(summary, dim) for dim in dims), "looked for", "detected, %",
             "expected, %", "p, adjusted", "weak"],
            [list(row) for row in zip(*labels, *columns, strict=True)], stub=len(dims)),
        [Panel("Weakest IDs", "Rows of the weakest IDs with their detection rates in percent.",
               lambda axes: draw_dots(axes, names, dots, "detected, %", share=True, marked=weak,
                                      ticks=expected), height=rows_height(len(names)))],
        (IDS,))


# The accuracy bound.

SIZE_COLUMNS = 12


def error_over_bound(results: xr.Dataset, per: Sequence[str], bins: Bins) -> xr.Dataset:
    """Return RMSE over bound, the inverse of efficiency, with the ends of its intervals."""
    # Computed first: of a store without errors the efficiency is 0, and the ratio infinite.
    summary = efficiency(results, per, bins).compute()
    with np.errstate(divide="ignore"):
        ratios: dict[str, Any] = {
            f"{quantity}_over_bound{end}": 1 / summary[f"{quantity}_efficiency{other}"]
            for quantity in ("rotation", "range")
            for end, other in (("", ""), ("_low", "_high"), ("_high", "_low"))}
    return xr.Dataset(ratios, summary.coords)


def _bound(data: ReportData) -> Figure | None:
    if "bound" not in data.results or not bool(data.once("has bound", lambda: xr.Dataset(
            {"any": data.results["bound"].isin(present_values(BoundStatus)).any()}))["any"]):
        return None
    along = data.size_axis or data.angle_axis
    found = grouped(data, error_over_bound, data.along(along, SIZE_COLUMNS) if along else None)
    return Figure(
        "bound", "Errors relative to the accuracy bound",
        found.caption(
            "RMSE divided by the Cram\u00e9r-Rao bound, over the solved poses that are not "
            "flipped and have a bound: 1 (dashed) is the best that an unbiased estimator can "
            "reach.", BOUND_CURVES),
        found.table("RMSE over the bound", {
            "rotation": ("rotation_over_bound", 1.0), "range": ("range_over_bound", 1.0)}),
        found.panels(BOUND_CURVES))


# Thresholds on the ambiguity: what they keep of the poses, and of the flips.

USUAL = 0.2
"""The threshold that many programs use."""

FRONTAL_DEG = 5.0
"""Viewing angle up to which a pose hardly differs from its mirror."""

CONDITIONS = 8
"""The most sizes, or angles, that are told apart."""

ANSWERS = {
    ThresholdChoice.not_run: "no pose",
    ThresholdChoice.found: "yes",
    ThresholdChoice.not_needed: "not needed",
    ThresholdChoice.too_few_draws: "too few draws to tell",
    ThresholdChoice.none: "no threshold does",
    ThresholdChoice.nothing_drawn: "nothing was drawn",
}
"""What the choice says, in the table."""


def _ambiguity(data: ReportData) -> Figure | None:
    """Return the figure if any pose has another solution, any is a flip, not all are frontal."""
    if not all(name in data.results for name in (
            "reprojection_error_px", "alternative_reprojection_error_px")):
        return None
    if "viewing_angle_deg" in data.results and not data.once(
            "largest angle", data.results[["viewing_angle_deg"]].max
    )["viewing_angle_deg"] > FRONTAL_DEG:
        return None
    pooled = _by_configuration(data, Grouping())
    curved = np.flatnonzero((pooled["without_alternative"] < pooled["solved"]).values
                            & (pooled["flipped"] > 0).values)
    if not curved.size:
        return None
    along = data.size or data.angle_axis
    conditions = data.along(along, CONDITIONS) if along else Grouping()
    table = _by_configuration(data, conditions)
    wanted, names = 100 * float(table.attrs["flip_rate"]), pooled[CONFIGURATION].values.tolist()
    none = np.full(pooled.sizes["threshold"], np.nan)
    lines = [
        Series(names[k], 100 * one["kept_rate"].values, 100 * one["flips_kept_rate"].values, none,
               none)
        for k in curved[:MAX_LINES].tolist() for one in [pooled.isel({CONFIGURATION: k})]]
    panels = [Panel(
        "Flips kept against poses kept",
        "Lines of the share of flips that is kept against that of poses, over the threshold.",
        lambda axes: draw_lines(
            axes, lines, ("poses kept, % of the solved", "flips kept, % of the flips"),
            share=True, linear=True), wide=True)]
    panels += [
        map_panel(title, names, group_labels(table, along), scale * part.transpose(
            CONFIGURATION, along).values, (data.label(along), ""), share=scale != 1)
        for name, title, scale in (
            ("kept_flip_rate", f"Flips of the poses that {USUAL:g} keeps, %", 100),
            ("right_rejected_rate", f"Right poses that {USUAL:g} rejects, %", 100),
            ("chosen_threshold", f"Threshold for {wanted:g} % flips", 1))
        for part in [table[name].sel(threshold=USUAL) if "threshold" in table[name].dims
                     else table[name]] if part.notnull().any()] if along else []
    return Figure(
        "ambiguity", "A threshold on the ambiguity: flips and poses that it keeps",
        sentences(
            "A pose is kept if its reprojection error is at most the threshold times that of the "
            "other planar solution; poses without another solution are always kept. Each point "
            f"is a threshold. A threshold for {wanted:g} % flips is the largest that is shown to "
            "keep them at that share of the kept poses at most (the 95 % bound of all thresholds "
            "tried together); the table says why there is none.", *conditions.notes,
            data.pooled(*conditions.dims)),
        _threshold_table(data, table, along, wanted), panels)


def _by_configuration(data: ReportData, grouping: Grouping) -> xr.Dataset:
    """Return `ambiguity` by all configurations (configuration, ...), which it never pools."""
    table = data.analysed(ambiguity, grouping)
    single = [str(name) for name in table.dims
              if name not in (*grouping.dims, *data.setting_axes, "threshold")]
    table = table.isel(dict.fromkeys(single, 0), drop=True)
    return by_configuration(data.pipeline, table, data.setting_axes)[1].assign_attrs(table.attrs)


def _threshold_table(
    data: ReportData, table: xr.Dataset, along: str | None, wanted: float
) -> Table:
    at_usual = table[["kept_rate", "kept_flipped", "rejected_right_rate"]]
    parts = {f"{name}{end}": table[f"{name}{end}"].sel(threshold=USUAL, drop=True)
             for name in at_usual for end in ("", "_low", "_high") if f"{name}{end}" in table}
    words = xr.apply_ufunc(np.vectorize(
        lambda flag: ANSWERS[ThresholdChoice(int(flag))], otypes=[object]), table["choice"])
    return table_of(
        table.assign(parts).assign(choice=words),
        f"Thresholds on the ambiguity, with 95 % intervals; wanted: {wanted:g} % flips",
        [CONFIGURATION, *([along] if along else [])], {
            "solved": ("solved", 1.0), "flips": ("flipped", 1.0),
            f"kept at {USUAL:g}, %": ("kept_rate", 100.0),
            f"flips kept at {USUAL:g}": ("kept_flipped", 1.0),
            f"right of the rejected at {USUAL:g}, %": ("rejected_right_rate", 100.0),
            f"{wanted:g} % by a threshold?": ("choice", 1.0),
            "threshold": ("chosen_threshold", 1.0), "kept there, %": ("chosen_kept_rate", 100.0),
            "flips there, %": ("chosen_flip_rate", 100.0),
            "right poses rejected there, %": ("chosen_right_rejected_rate", 100.0),
        }, data.results)


# --------------------------------------------------------------------------------------------------
# The figures of a store, in the order in which they stand.

FIGURES: tuple[Callable[[ReportData], Figure | None], ...] = (
    _detection, _errors, _bias, _configurations, _trade, _maps, _ambiguity, _outcomes, _frame,
    _ranking, _bound,
)
"""Makers of figures, None for a store that a figure does not fit; add one here."""


def figures_of(data: ReportData) -> list[Figure]:
    """Return the figures of a store, such that one shows each axis and drawn parameter."""
    made = [figure for make in FIGURES if (figure := make(data)) is not None]
    covered = {name for figure in made for name in figure.covers}
    return made + [
        _effect(data, name)
        for name in (*data.scene_axes, *data.setting_axes, *data.drawn_parameters)
        if name not in covered]


def _effect(data: ReportData, name: str) -> Figure:
    """Return the figure of rates and errors along an axis or a drawn parameter."""
    axis = data.pipeline.axis(name)
    meaning = data.pipeline.parameters[name].declaration.meaning if axis is None else axis.meaning
    return _along(
        data, f"effect-{name}", f"The effect of {name}",
        "Detection rate, median and 95 % quantile (p95) of rotation and range error, and signed "
        f"mean of the range error (bias), by {name} ({meaning}). {INFINITE_ERRORS}",
        error_statistics, name, [DETECTED, *ERROR_CURVES, RANGE_BIAS], f"By {name}",
        RATES | ERRORS, angles=False)


# --------------------------------------------------------------------------------------------------
# Tables of errors, of boards' markers, and of the precision that was reached.

MAX_TABLE_ROWS, MAX_SIZE_ROWS = 40, 12
"""The most rows of a table of all detector settings, and of one by size."""

GROUPS = ("camera_frame", "camera_in_marker", "yaw_pitch_roll", "angles")
QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}
"""Quantity in the names of errors -> its name in words, and its unit in those names."""


def board_tables(data: ReportData) -> list[Table]:
    """Return the rates of boards' single markers, by board and detector setting."""
    if "marker_detection" not in data.results:
        return []
    board = data.pipeline.axis_of(BOARDS)
    boards = [board.name] if board is not None and len(board) > 1 else []
    settings = [axis.name for axis in data.pipeline.axes_of(Stage.detection) if len(axis) > 1]
    if math.prod(data.length(name) for name in (*boards, *settings)) > MAX_TABLE_ROWS:
        settings = []
    dims = [*boards, *settings]
    rates = data.once(("markers of boards", *dims),
                      lambda: detection_rate(per_marker(data.results), dims))
    return [table_of(
        rates, "Markers of boards, each counted by itself, with 95 % intervals", dims, RATES,
        sources=data.results)]


def size_errors_table(data: ReportData, best: int) -> list[Table]:
    """Return detection, bias and spread of a configuration at each size; none without poses."""
    axis = signed_axis(data)
    found = grouped(data, signed_error_statistics,
                    data.along(axis, MAX_SIZE_ROWS) if axis else None)
    table = found.summary.isel({CONFIGURATION: best})
    if not np.nan_to_num(table["solved"].values).sum():
        return []
    whose = f" with {configurations(data).names[best]}" if found.several else ""
    return [table_of(
        table, f"Errors{f' by {axis}' if axis else ''}{whose}, with 95 % intervals: range p95 "
        "(not solved: infinite), bias and standard deviation of the solved poses without flips",
        found.dims, RATES | {"range p95, %": ("range_p95_percent", 1.0)} | SIGNED_COLUMNS,
        data.results)]


def signed_errors_table(data: ReportData) -> Table:
    """Return bias and spread in all frames, with rows for each configuration."""
    found = grouped(data, _signed_in_all_frames)
    names = found.names if found.several else [""]
    rows = []
    for quantity in (each for group in GROUPS for each in SIGNED[group]):
        columns = [cells(found.summary, quantity.named(name)) for name in ("bias", "sd")]
        rows += [[f"{quantity.words}, {quantity.unit}", *([name] if name else []), *values]
                 for name, *values in zip(names, *columns, strict=True)]
    stub = ["error", *([CONFIGURATION] if found.several else [])]
    return Table.of("Bias and spread of the solved poses without flips, with 95 % intervals",
                    [*stub, "bias", "standard deviation"], rows, stub=len(stub))


def _signed_in_all_frames(results: xr.Dataset, per: Sequence[str], bins: Bins) -> xr.Dataset:
    return error_statistics(results, per, bins, GROUPS)


def errors_table(errors: xr.Dataset, name: str) -> Table:
    """Return the statistics of a configuration's errors over the whole grid."""
    quantities = {
        f"{words}, {'%' if unit == 'percent' else unit}": f"{quantity}_{{}}_{unit}"
        for quantity, (words, unit) in QUANTITIES.items()
    }
    rows = [
        [heading, *(
            cells(errors, each.format(statistic))[0] if each.format(statistic) in errors else ""
            for each in quantities.values())]
        for heading, statistic in error_headings().items()
    ]
    whose = f", with {name}" if name else ""
    return Table.of(f"Errors over the whole grid{whose}, with 95 % intervals",
                    ["statistic", *quantities], rows)


def precision_tables(data: ReportData) -> list[Table]:
    """Return what a run to a wanted precision reached, by quantity and configuration."""
    rule = data.pipeline.stopping
    if rule is None or not rule.precision:
        return []
    return [precision_table(data.once(
        "precision_reached", lambda: precision_reached(data.results)))]


def precision_table(table: xr.Dataset) -> Table:
    """Return a row for each quantity and configuration of `sweep.analysis.precision_reached`."""
    configuration = table.attrs["configuration_dims"]
    first = table["run"].isel(dict.fromkeys(configuration, 0)).values
    rows = []
    for k, name in enumerate(table["quantity"].values):
        one = table.isel(quantity=k)
        for at, part in each_cell(one, configuration):
            half = part["half_width"].where(part["reached"].isin(
                (Reached.reached, Reached.not_reached)))
            rows.append([
                str(name), " · ".join(map(str, at.values())) or "all",
                number(float(one["wanted"])), number(float(half.max())),
                *(f"{int((part['reached'] == flag).sum()):,}" for flag in Reached)])
    return Table.of(
        f"Precision of {first.size:,} conditions, which took {int(first.min()):,} to "
        f"{int(first.max()):,} poses each: conditions by what was reached; of rates the "
        "half-width of the interval, of others relative to the value (bias: to the RMSE)",
        ["quantity", "configuration", "wanted", "widest",
         *(each.name.replace("_", " ") for each in Reached)], rows, stub=2)
