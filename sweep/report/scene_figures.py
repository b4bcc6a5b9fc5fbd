"""Figures and tables of detection, errors, flips and outcomes by size, tilt."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from sweep.analysis import (
    detection_rate,
    error_statistics,
    failure_composition,
    flip_rate,
    per_marker,
)
from sweep.analysis.binning import Bins
from sweep.analysis.poses import SIGNED
from sweep.analysis.requirements import BOARDS, SIZES_BESIDE, usual_conditions
from sweep.analysis.summaries import error_headings
from sweep.measure.flags import outcomes
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.plan.experiment import target_word
from sweep.plan.parameters import Stage
from sweep.report.charts import FLOOR_NOTE, HEIGHT, Panel, below_floor, draw_stack
from sweep.report.figure import (
    DETECTED,
    ERROR_CURVES,
    ERRORS,
    IN_MM,
    INFINITE_ERRORS,
    LOOKED_FOR,
    RANGE_BIAS,
    RATES,
    SIGNED_COLUMNS,
    SIGNED_CURVES,
    SIGNED_GROUPS,
    WIDE_FROM,
    Columns,
    FigureKind,
    RenderedFigure,
    curves_of,
    denominators,
    interval_sentence,
    map_panel,
    sentences,
)
from sweep.report.formatting import number
from sweep.report.report_data import (
    ANGLES,
    AREA,
    BOTH,
    CONFIGURATION,
    IDS,
    Analysis,
    Grouping,
    ReportData,
    by_configuration,
    configurations,
    equal_bins,
    group_labels,
    is_numeric,
    settings_of,
    shown_lines,
    shown_note,
)
from sweep.report.table import Table, cells, table_of

# --------------------------------------------------------------------------------------------------
# The question that a report answers: requirements, and the conditions that they are judged at.

@dataclass(frozen=True)
class Course:
    """How requirements are followed over the grid.

    Attributes
    ----------
    along
        The axis along which a limit is looked for; None if there is none.
    angle
        The axis of angles up to each of which there is a limit of its own, or None.
    at_all
        Axes at all of whose values the requirements must hold.
    """

    along: str | None
    angle: str | None
    at_all: tuple[str, ...]


def course_of(data: ReportData, per: tuple[str, ...] | None = None) -> Course:
    """Return how requirements are followed over conditions: by default the usual ones."""
    axes = {axis.name: axis for axis in data.pipeline.axes}
    per = usual_conditions(data.results) if per is None else per
    conditions = tuple(name for name in per if name not in data.setting_axes)
    ordered = [name for name in conditions
               if name in data.scene_axes and is_numeric(axes[name])]
    ordered.sort(key=lambda name: (
        name != data.size_axis, name not in SIZES_BESIDE, name in ANGLES))
    along = ordered[0] if ordered else None
    angle = next((name for name in ordered[1:] if name in ANGLES), None)
    return Course(along, angle, tuple(
        name for name in conditions if name not in (along, angle)))


# --------------------------------------------------------------------------------------------------
# What a report says of boards: what counts as detected, and how many of their markers are.

MAX_ROWS = 40
"""The most rows of a table of all detector settings; of more it pools these."""


def detected_words(data: ReportData) -> str:
    """Return what is detected, as a clause: of a board any marker is enough."""
    word = target_word(data.pipeline)
    return f"the {word} is detected" + (", by at least one marker" if word != "marker" else "")


def board_tables(data: ReportData) -> list[Table]:
    """Return the rates of boards' single markers, by board and detector setting."""
    if "marker_detection" not in data.results:
        return []
    board = data.pipeline.axis_of(BOARDS)
    boards = [board.name] if board is not None and len(board) > 1 else []
    settings = [axis.name for axis in data.pipeline.axes_of(Stage.detection) if len(axis) > 1]
    if math.prod(data.length(name) for name in (*boards, *settings)) > MAX_ROWS:
        settings = []
    dims = [*boards, *settings]
    rates = data.once(("markers of boards", *dims),
                      lambda: detection_rate(per_marker(data.results), dims))
    return [table_of(
        rates, "Markers of boards, each counted by itself, with 95 % intervals", dims, RATES,
        sources=data.results)]


# --------------------------------------------------------------------------------------------------
# Figures of detection, errors and flips by the marker's size and tilt, or viewing angle.

MIN_BINNED_SIZES = 20
"""From this many sizes on, the detection rate is drawn against bins of the area."""

MAP_COLUMNS, MAP_ROWS = 24, 20
MAX_MAPPED = 3
"""Configurations that have maps of their own."""

SHORT_NAMES = {AREA: "area", "side_px": "size", "distance_m": "distance", "size_m": "marker size"}
LONG_NAMES = {AREA: "area in the image", "side_px": "side in the image",
              "distance_m": "distance", "size_m": "size"}
"""Names of the measures of size, in titles and in sentences."""


def long_name(name: str) -> str:
    """Return the name of an axis as it stands in sentences."""
    return LONG_NAMES.get(name, name)


def _short_name(name: str) -> str:
    return SHORT_NAMES.get(name, name)


def _by_angle(data: ReportData) -> str:
    return f", by {data.angle}" if data.angle else ""


def _size_axes(data: ReportData) -> list[str]:
    return [name for name in (data.size_axis, data.angle_axis) if name]


# Detection against size.

def _detection(data: ReportData) -> RenderedFigure:
    axis = data.size_axis
    areas = axis is None or data.length(axis) >= MIN_BINNED_SIZES
    along = AREA if areas else str(axis)
    curves = curves_of(data, detection_rate, along, (Stage.detection,))
    return RenderedFigure(
        "detection", f"Detection rate by {_short_name(along)}",
        sentences(
            f"Share of the poses looked for in which {detected_words(data)}, against its "
            f"{long_name(along)}{_by_angle(data)}.",
            interval_sentence(
                data, curves.summary, "detection_rate", marks="Bands and bars"
            ).replace("intervals over", "intervals (Wilson's) over"),
            curves.remarks(),
        ),
        curves.table("Detection rate, with 95 % intervals", RATES | {"draws": ("draws", 1)}),
        curves.panels([DETECTED]),
    )


# Errors against size.

def _errors(data: ReportData) -> RenderedFigure:
    along = str(data.size)
    curves = curves_of(data, error_statistics, along)
    return RenderedFigure(
        "errors", f"Errors of the pose by {_short_name(along)}",
        sentences(
            f"Error of the estimated pose against the {target_word(data.pipeline)}'s "
            f"{long_name(along)}{_by_angle(data)}: median and 95 % quantile (p95) of "
            "the rotation error and of the range error (depth, relative to the true depth).",
            FLOOR_NOTE if any(below_floor(curves.summary[each.variable].values)
                              for each in ERROR_CURVES) else "",
            interval_sentence(data, curves.summary, "rotation_median_deg", "range_p95_percent",
                              marks="Bars and bands"), INFINITE_ERRORS, curves.remarks(),
        ),
        curves.table("Errors, with 95 % intervals", LOOKED_FOR | ERRORS),
        curves.panels(ERROR_CURVES),
    )


# Rates and errors along an axis or a drawn parameter that no other figure shows.

def effect_of(name: str) -> FigureKind:
    """Return the kind of figure that shows the effect of one axis, or of a drawn parameter."""
    return FigureKind(f"effect-{name}",
                      lambda data: data.length(name) > 1 or name in data.drawn_parameters,
                      lambda data: _effect(data, name), lambda _: (name,))


def _effect(data: ReportData, name: str) -> RenderedFigure:
    axis = data.pipeline.axis(name)
    meaning = data.pipeline.parameters[name].declaration.meaning if axis is None else axis.meaning
    curves = curves_of(data, error_statistics, name, angles=False)
    return RenderedFigure(
        f"effect-{name}", f"The effect of {name}",
        sentences(
            "Detection rate, median and 95 % quantile (p95) of rotation and range error, and "
            f"signed mean of the range error (bias), by {name} ({meaning}).",
            interval_sentence(data, curves.summary, "detection_rate", marks="Bars and bands"),
            INFINITE_ERRORS, curves.remarks(),
        ),
        curves.table(f"By {name}, with 95 % intervals", RATES | ERRORS),
        curves.panels([DETECTED, *ERROR_CURVES, RANGE_BIAS]),
    )


# Bias along the axes.

def signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    """Return bias and spread of the range, of x, y and z in the camera's frame, and of angles."""
    return error_statistics(results, per, bins, SIGNED_GROUPS)


def signed_axis(data: ReportData) -> str | None:
    """Return the axis along which bias is shown: of sizes, other numbers, or angles."""
    along = course_of(data, data.per).along
    return along if along not in (None, data.angle_axis) else data.size or data.angle_axis


def _signed(data: ReportData) -> RenderedFigure:
    along = str(signed_axis(data))
    curves = curves_of(data, signed_error_statistics, along, angles=False)
    return RenderedFigure(
        "bias", f"Bias by {_short_name(along)}",
        sentences(
            f"Mean error of the solved poses that are not flipped, estimated minus true, against "
            f"the {long_name(along)}: the range in percent of the true depth; x (right), y (down) "
            f"and z (forward) of the {target_word(data.pipeline)}'s position in the camera's "
            "frame; yaw. The table also has the standard deviations, and pitch and roll.",
            interval_sentence(
                data, curves.summary, "z_bias_m", "yaw_bias_deg", marks="Bars and bands"
            ),
            curves.remarks("solved", "solved poses"),
        ),
        curves.table("Bias and standard deviation, with 95 % intervals", SIGNED_COLUMNS),
        curves.panels(SIGNED_CURVES),
    )


# Maps over size and angle.

def _over(data: ReportData) -> str:
    return f"{_short_name(str(data.size_axis))} and {data.angle}"


def _has_map(data: ReportData) -> bool:
    return data.size_axis is not None and data.angle_axis is not None


class _Maps:
    """An analysis over size and angle, by configuration."""

    def __init__(
        self, data: ReportData, analysis: Analysis, stages: Sequence[Stage] = BOTH
    ) -> None:
        self.data = data
        self.along, self.angle = str(data.size_axis), str(data.angle_axis)
        settings = settings_of(data, stages)
        grouping: Grouping = settings.grouping + data.along(self.angle, MAP_ROWS) + data.along(
            self.along, MAP_COLUMNS)
        self.names, self.summary = by_configuration(
            data.pipeline, data.analysed(analysis, grouping), settings.grouping.dims)
        self.several = len(self.names) > 1
        self.shown = shown_lines(data, settings, MAX_MAPPED)
        self.notes = (shown_note(self.shown, len(self.names)), *grouping.notes,
                      data.pooled(self.along, self.angle))

    def panels(self, name: str, title: str, *, share: bool = False) -> list[Panel]:
        """Return a map of a variable for each configuration that is shown."""
        rows, columns = (group_labels(self.summary, name) for name in (self.angle, self.along))
        values = self.summary[name].transpose(CONFIGURATION, self.angle, self.along).values
        labels = (self.data.label(self.along), self.data.label(self.angle))
        return [
            map_panel(f"{title}, {self.names[k]}" if self.several else title, rows, columns,
                      values[k], labels, share=share, upwards=True, most_columns=WIDE_FROM,
                      height=max(2.6, 1.3 + 0.22 * len(rows)))
            for k in self.shown
        ]

    def table(self, caption: str, columns: Columns) -> Table:
        """Return the table of all configurations."""
        several = self.several
        return table_of(
            self.summary if several else self.summary.isel({CONFIGURATION: 0}), caption,
            [*([CONFIGURATION] if several else []), self.angle, self.along], columns,
            self.data.results)


def _maps(data: ReportData) -> RenderedFigure:
    maps = _Maps(data, error_statistics)
    detected = maps if not maps.several else _Maps(data, detection_rate, (Stage.detection,))
    return RenderedFigure(
        "maps", f"Detection and rotation error over {_over(data)}",
        sentences(
            "Detection rate in percent, and 95 % quantile of the rotation error in degrees; "
            "a pose that is not solved counts as an infinite error (\u221e).",
            denominators(maps.summary), *maps.notes,
        ),
        maps.table("Detection rate and rotation error, with 95 % intervals",
                   RATES | {"rotation p95, deg": ("rotation_p95_deg", 1.0)}),
        [*detected.panels("detection_rate", "Detected, %", share=True),
         *maps.panels("rotation_p95_deg", "Rotation error, p95, deg")],
    )


def _has_flips(data: ReportData) -> bool:
    return _has_map(data) and bool(data.analysed(flip_rate)["solved"] > 0)


def _flips(data: ReportData) -> RenderedFigure:
    maps = _Maps(data, flip_rate)
    return RenderedFigure(
        "flips", f"Flips to the mirrored pose over {_over(data)}",
        sentences(
            "Share of the solved poses that are nearer to the mirror of the truth than to the "
            f"truth, in percent. At a {data.angle} near 0 the mirror hardly differs from the "
            "truth.",
            denominators(maps.summary, "solved", "solved poses"), *maps.notes,
        ),
        maps.table("Flip rate, with 95 % intervals",
                   {"solved": ("solved", 1.0), "flipped, %": ("flip_rate", 100.0)}),
        maps.panels("flip_rate", "Flipped, % of the solved", share=True),
    )


DETECTION = FigureKind("detection", lambda data: data.size is not None, _detection, _size_axes)
ERRORS_BY_SIZE = FigureKind("errors", lambda data: data.size is not None, _errors, _size_axes)
BIAS = FigureKind("bias", lambda data: signed_axis(data) is not None, _signed)
MAPS = FigureKind("maps", _has_map, _maps)
FLIPS = FigureKind("flips", _has_flips, _flips)


# --------------------------------------------------------------------------------------------------
# The figure of the poses' outcomes: solved, or the flag that says why not.

MAX_BARS = 24
MAX_STACKS = 4
"""Configurations that have bars of their own."""

VIEW = "viewing_angle_deg"
VIEW_BIN_DEG = 10.0
MIN_VIEW_RANGE_DEG = 5.0
"""From this range on, outcomes are shown by the viewing angle."""


def _axis(data: ReportData) -> str | None:
    """Return the axis of the scene along which the outcomes change most; None without axes."""
    if data.size_axis is not None:
        return data.size_axis
    names = [name for name in data.scene_axes if name != IDS]
    if data.size is not None:
        names.append(data.size)
    if not names:
        return None
    settings = settings_of(data)

    def influence(name: str) -> float:
        summary = data.analysed(
            failure_composition, settings.grouping + data.along(name, MAX_BARS))
        share = summary["share"].fillna(0).transpose(name, "outcome", ...).values
        return float(np.abs(share - share.mean(axis=0)).mean())

    return max(names, key=influence)


class _Outcomes:
    """The outcomes of each configuration, along an axis or bins of the viewing angle."""

    def __init__(self, data: ReportData, axis: str | None, groups: Grouping, label: str) -> None:
        settings = settings_of(data)
        self.names, summary = by_configuration(
            data.pipeline, data.analysed(failure_composition, settings.grouping + groups),
            settings.grouping.dims)
        self.several = len(self.names) > 1
        if axis and axis in summary.indexes and np.issubdtype(summary[axis].dtype, np.number):
            summary = summary.isel({axis: np.argsort(summary[axis].values, kind="stable")})
        self.label, self.axis = label, axis or "all"
        self.summary = summary if axis else summary.expand_dims("all", axis=1)
        self.bars = group_labels(summary, axis) if axis else ["all"]
        self.shown = shown_lines(data, settings, MAX_STACKS)
        self.counts = summary["count"].sum([name for name in summary["count"].dims
                                            if name != "outcome"])
        self.notes = (shown_note(self.shown, len(self.names)), *settings.grouping.notes,
                      *groups.notes, data.pooled(*groups.dims))

    @property
    def happened(self) -> list[str]:
        """The outcomes that poses looked for have."""
        return [str(name) for name in self.summary["outcome"].values.tolist()
                if self.counts.sel(outcome=name) > 0
                and np.isfinite(self.summary["share"].sel(outcome=name)).any()]

    def panels(self, title: str) -> list[Panel]:
        """Return bars for each configuration that is shown."""
        return [self._panel(k, title) for k in self.shown]

    def _panel(self, k: int, title: str) -> Panel:
        share = self.summary["share"].isel({CONFIGURATION: k})
        parts = {name: share.sel(outcome=name).values.astype(np.float64)
                 for name in self.happened}
        whose = f", {self.names[k]}" if self.several else ""
        return Panel(
            title + whose,
            f"Stacked bars of the shares of {', '.join(parts) or 'nothing'}{whose}.",
            lambda axes: draw_stack(axes, self.bars, parts, self.label),
            wide=len(self.bars) > WIDE_FROM and not self.several,
        )

    def table(self) -> Table:
        """Return the shares of all configurations."""
        stacked = self.summary.stack(row=[CONFIGURATION, self.axis], create_index=False)
        columns = [cells(stacked.sel(outcome=name), "share", 100) for name in self.happened]
        total = stacked["count"].where(stacked["share"].notnull(), 0).sum("outcome").values
        stubs = [[*([name] if self.several else []), bar]
                 for name in self.names for bar in self.bars]
        rows = [[*stub, f"{int(total[k]):,}", *(column[k] for column in columns)]
                for k, stub in enumerate(stubs)]
        headings = [*([CONFIGURATION] if self.several else []), self.label, "looked for",
                    *(f"{name.replace('_', ' ')}, %" for name in self.happened)]
        return Table.of("Shares in percent, with 95 % intervals", headings, rows,
                     stub=1 + self.several)


def _view_bins(data: ReportData) -> Grouping:
    """Return bins of the viewing angle; none if it hardly varies, or is an axis shown already."""
    if VIEW not in data.results:
        return Grouping()
    ends = data.once("viewing angles", lambda: xr.Dataset(
        {"low": data.results[VIEW].min(), "high": data.results[VIEW].max()}))
    low, high = float(ends["low"]), float(ends["high"])
    if not high - low >= MIN_VIEW_RANGE_DEG:
        return Grouping()
    return equal_bins(VIEW, low, high, VIEW_BIN_DEG)


def _render(data: ReportData) -> RenderedFigure:
    axis = _axis(data)
    along = _Outcomes(data, axis, data.along(axis, MAX_BARS) if axis else Grouping(),
                      data.label(axis) if axis else "all poses")
    panels = along.panels("Outcome")
    view = _view_bins(data)
    if view.dims:
        panels += _Outcomes(data, VIEW, view, "viewing angle, deg").panels(
            "Outcome by viewing angle")
    excluded = ", ".join(
        f"{int(along.counts.sel(outcome=outcome)):,} {outcome}"
        for outcome in outcomes(counted=False)
        if outcome in along.summary["outcome"].values
        and along.counts.sel(outcome=outcome) > 0
    )
    return RenderedFigure(
        "failures", "Outcomes of the poses",
        sentences(
            "Shares of the poses looked for" + (f", by {long_name(axis)}" if axis else "")
            + (" and by viewing angle (normal to line of sight)" if view.dims else "")
            + ": solved, or the flag that says why not.",
            f"Not counted in the shares: {excluded}." if excluded else "",
            interval_sentence(data, along.summary, "share", marks="In the table there"),
            *along.notes,
        ),
        along.table(), panels,
    )


FAILURES = FigureKind("failures", lambda _: True, _render)


# --------------------------------------------------------------------------------------------------
# The figure of the detection rate over the frame: where in the image the marker is.

ACROSS, DOWN = "frame_u_percent", "frame_v_percent"
COLUMNS, ROWS = 8, 6
MAX_MAPPED_FRAMES = 3
MIN_RANGE_PERCENT = 10.0
"""From this range of places on, in percent of the frame's width, there is a figure."""

TRUE = "true_tvec_m"


def _in_frame(results: xr.Dataset, view: Sequence[float]) -> xr.Dataset:
    """Return where the marker's centre is, in percent of the frame from its top left corner."""
    fx, fy, cx, cy, width, height = view
    x, y, z = (results[TRUE].isel(xyz=k, drop=True) for k in range(3))
    ahead = z.where(z > 0)
    return xr.Dataset({
        ACROSS: 100 * (fx * x / ahead + cx + 0.5) / width,
        DOWN: 100 * (fy * y / ahead + cy + 0.5) / height,
    })


def _view(data: ReportData) -> tuple[float, ...] | None:
    """Return fx, fy, cx, cy, width and height of a store with a single camera without a lens."""
    fixed = data.pipeline.fixed
    if any(name not in fixed for name in VIEW_PARAMETERS) or fixed.get("distortion"):
        return None
    numbers = intrinsics(*(fixed[name] for name in VIEW_PARAMETERS))
    return (*(float(number) for number in numbers), fixed["width_px"], fixed["height_px"])


def _applies(data: ReportData) -> bool:
    view = _view(data)
    if view is None or TRUE not in data.results:
        return False
    shares = _in_frame(data.results, view)
    ranges = data.once("ranges in the frame", lambda: xr.Dataset(
        {name: shares[name].max() - shares[name].min() for name in (ACROSS, DOWN)}))
    return max(float(ranges[name]) for name in (ACROSS, DOWN)) >= MIN_RANGE_PERCENT


def _render_frame_figure(data: ReportData) -> RenderedFigure:
    view = _view(data)
    if view is None:
        raise KeyError("camera")
    settings = settings_of(data, (Stage.detection,))
    edges = {name: np.linspace(0, 100, count + 1) for name, count in (
        (DOWN, ROWS), (ACROSS, COLUMNS))}
    for each in edges.values():
        each[-1] = np.nextafter(100, 101)
    bins = Grouping(bins=tuple((name, tuple(each.tolist())) for name, each in edges.items()))

    def over_frame(results: xr.Dataset, per: Sequence[str], bins: Bins) -> xr.Dataset:
        return detection_rate(results.assign(_in_frame(results, view).data_vars), per, bins)

    names, summary = by_configuration(
        data.pipeline, data.analysed(over_frame, settings.grouping + bins), settings.grouping.dims)
    shown = shown_lines(data, settings, MAX_MAPPED_FRAMES)
    several = len(names) > 1
    columns, rows = group_labels(summary, ACROSS), group_labels(summary, DOWN)
    rates = summary["detection_rate"].transpose(CONFIGURATION, DOWN, ACROSS).values
    labels = ("from the left, % of the width", "from the top, % of the height")
    dims = [*([CONFIGURATION] if several else []), DOWN, ACROSS]
    return RenderedFigure(
        "frame", "Detection by place in the frame",
        sentences(
            f"Detection rate by the place of the {target_word(data.pipeline)}'s centre in the "
            "frame; a dash: no pose was looked for there.", denominators(summary),
            shown_note(shown, len(names)), data.pooled(),
        ),
        table_of(summary if several else summary.isel({CONFIGURATION: 0}),
                 "Detection rate by place, with 95 % intervals", dims, RATES),
        [map_panel(f"Detected, %, {names[k]}" if several else "Detected, %", rows, columns,
                   rates[k], labels, share=True, most_columns=COLUMNS, height=HEIGHT)
         for k in shown],
    )


FRAME = FigureKind("frame", _applies, _render_frame_figure)


# --------------------------------------------------------------------------------------------------
# Tables of errors: of one configuration by statistic and by size, of all with their signs.

MAX_SIZE_ROWS = 12


def size_errors_table(data: ReportData, best: int) -> list[Table]:
    """Return detection, bias and spread of a configuration at each size; none without solved poses.

    In x, y, z and yaw: bias ± standard deviation of the solved poses without flips.
    """
    known = configurations(data)
    axis = signed_axis(data)
    groups = data.along(axis, MAX_SIZE_ROWS) if axis else Grouping()
    _, table = by_configuration(
        data.pipeline, data.analysed(signed_error_statistics, known.settings.grouping + groups),
        known.settings.grouping.dims)
    table = table.isel({CONFIGURATION: best})
    if not np.nan_to_num(table["solved"].values).sum():
        return []
    labels = group_labels(table, axis) if axis else ["all"]
    parts = [table.isel({axis: k}) if axis else table for k in range(len(labels))]
    rows = [[label, *_row(part)] for label, part in zip(labels, parts, strict=True)]
    stub = data.label(axis) if axis else "poses"
    whose = f", with {known.names[best]}" if known.several else ""
    pooled = data.pooled(*groups.dims).rstrip(".")
    return [Table.of(
        f"Errors by {stub.split(',')[0]}{whose}: range p95 (not solved: infinite), and bias ± "
        "standard deviation of the solved poses without flips"
        + (f". {pooled}" if pooled else ""),
        [stub, "detected, %", "range p95, %", *(f"{name}, mm" for name in IN_MM),
         "yaw, deg"], rows)]


def _row(part: xr.Dataset) -> list[str]:
    def signed(name: str, unit: str, scale: float) -> str:
        bias, spread = (scale * float(part[f"{name}_{what}_{unit}"]) for what in ("bias", "sd"))
        return number(bias) if np.isnan(spread) else f"{_beside(bias, spread)} ± {number(spread)}"

    return [
        number(100 * float(part["detection_rate"])), number(float(part["range_p95_percent"])),
        *(signed(name, "m", 1000.0) for name in IN_MM),
        signed("yaw", "deg", 1.0),
    ]


def _beside(value: float, spread: float) -> str:
    """Return a value with no more decimals than its spread has: 0.00042 beside 0.00742."""
    _, point, decimals = number(spread).partition(".")
    if not point or not decimals.isdigit():
        return number(value)
    text = f"{value:.{len(decimals)}f}"
    return text.replace("-", "\u2212") if float(text) else text.removeprefix("-")


GROUPS = ("camera_frame", "camera_in_marker", "yaw_pitch_roll", "angles")
CAPTION = "Bias and spread of the solved poses without flips, with 95 % intervals"


def signed_errors_table(data: ReportData) -> Table:
    """Return the table, with rows for each configuration."""
    grouping = configurations(data).settings.grouping
    labels, summary = by_configuration(
        data.pipeline, data.analysed(_signed_error_statistics, grouping), grouping.dims)
    names = labels if grouping.dims else []
    rows = []
    for quantity in (each for group in GROUPS for each in SIGNED[group]):
        columns = [cells(summary, quantity.named(statistic)) for statistic in ("bias", "sd")]
        label = f"{quantity.words}, {quantity.unit}"
        rows += [[label, *([name] if names else []), *values]
                 for name, *values in zip(names or [""], *columns, strict=True)]
    stub = ["error", *([CONFIGURATION] if names else [])]
    return Table.of(CAPTION, [*stub, "bias", "standard deviation"], rows, stub=len(stub))


def _signed_error_statistics(
    results: xr.Dataset, per: Sequence[str], bins: Bins
) -> xr.Dataset:
    return error_statistics(results, per, bins, GROUPS)


QUANTITIES = {"rotation": ("rotation", "deg"), "range": ("range (depth)", "percent"),
              "position": ("position", "m")}
"""Quantity in the names of errors -> its name in words, and its unit in those names."""


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
