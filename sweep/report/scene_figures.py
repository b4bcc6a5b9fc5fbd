"""Figures of what the scene does: detection, errors, failures and flips, by size and by tilt."""

from __future__ import annotations

import numpy as np
import xarray as xr

from sweep.analysis import (
    detection_rate,
    error_statistics,
    failure_composition,
    flip_rate,
    marker_ranking,
)
from sweep.report.charts import (
    Series,
    draw_dots,
    draw_lines,
    draw_map,
    draw_stack,
    rows_height,
)
from sweep.report.figure import (
    FigureKind,
    RenderedFigure,
    ends_of,
    lower,
    of_how_many,
    on_intervals,
    sentences,
    series_of,
)
from sweep.report.report_data import (
    AREA,
    IDS,
    MANY_SIZES,
    TILT,
    Grouping,
    Subject,
    is_numeric,
    label_of,
    labels_of,
)
from sweep.report.table import Table, cells, table_of
from sweep.report.theme import Panel

ERRORS = {
    "solved, %": ("solved_rate", 100.0),
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "rotation RMSE without flips, deg": ("rotation_rmse_unflipped_deg", 1.0),
    "range median, %": ("range_median_percent", 1.0),
    "range p95, %": ("range_p95_percent", 1.0),
    "range RMSE without flips, %": ("range_rmse_unflipped_percent", 1.0),
}
RATES = {"looked for": ("looked_for", 1.0), "detected, %": ("detection_rate", 100.0)}
MISSES = (
    "In median and p95 a pose that was not solved counts as an infinite error (at the edge); "
    "an interval that reaches the edge has no end within the draws."
)
WEAKEST = 24
"""Marker IDs that are drawn one by one."""
MAP_COLUMNS, MAP_ROWS = 24, 20
STACKED_BARS = 24
WIDE_FROM = 8
"""Panels of more groups than this take the whole width."""


# Detection against size.

def _detection(subject: Subject) -> RenderedFigure:
    axis = subject.size_axis
    areas = axis is None or subject.length(axis) >= MANY_SIZES
    along = AREA if areas else str(axis)
    grouping = subject.by_tilt() + subject.along(along)
    found = subject.of(detection_rate, grouping)
    by = TILT if subject.tilted else None
    lines = series_of(found, along, "detection_rate", by, 100)
    label = subject.label(along)
    return RenderedFigure(
        "detection", f"How often the marker is found, by {_short_name(along)}",
        sentences(
            f"Share of the poses looked for in which the marker is detected, against its "
            f"{_long_name(along)}{_by_tilt(subject)}.",
            on_intervals(found, "detection_rate", marks="Bands and bars").replace(
                "intervals,", "intervals (Wilson's),"),
            of_how_many(found), *grouping.notes, subject.pooled(along, *grouping.dims),
        ),
        table_of(found, "Detection rate, with 95 % intervals", grouping.dims,
                 RATES | {"draws": ("draws", 1)}, subject.results),
        [Panel("Detected", f"Lines of the detection rate in percent against {label}.",
               lambda axes: draw_lines(axes, lines, (label, "detected, %"), share=True),
               wide=max((len(line.x) for line in lines), default=0) > WIDE_FROM)],
    )


# Errors against size.

def _errors(subject: Subject) -> RenderedFigure:
    along = str(subject.size)
    grouping = subject.by_tilt() + subject.along(along)
    found = subject.of(error_statistics, grouping)
    by = TILT if subject.tilted else None
    label = subject.label(along)

    def panel(name: str, title: str, unit: str) -> Panel:
        lines = series_of(found, along, name, by)
        return Panel(
            title, f"Lines of {lower(title)} in {unit} against {label}.",
            lambda axes: draw_lines(axes, lines, (label, f"{lower(title)}, {unit}")),
        )

    return RenderedFigure(
        "errors", f"How large the error is, by {_short_name(along)}",
        sentences(
            f"Error of the estimated pose against the marker's {_long_name(along)}"
            f"{_by_tilt(subject)}: median and 95 % quantile (p95) of the rotation error, median of "
            "the range error (depth, of the true depth), RMSE of range without flips.",
            "An error of 0 stands at the lower edge."
            if (found["rotation_median_deg"] == 0).any() else "",
            on_intervals(found, "rotation_median_deg", "range_rmse_unflipped_percent",
                         marks="Bars and bands"), MISSES,
            of_how_many(found), *grouping.notes, subject.pooled(along, *grouping.dims),
        ),
        table_of(found, "Errors, with 95 % intervals", grouping.dims,
                 {"looked for": ("looked_for", 1.0)} | ERRORS, subject.results),
        [panel("rotation_median_deg", "Rotation error, median", "deg"),
         panel("rotation_p95_deg", "Rotation error, p95", "deg"),
         panel("range_median_percent", "Range error, median", "%"),
         panel("range_rmse_unflipped_percent", "Range RMSE without flips", "%")],
    )


# Maps over size and tilt.

def _has_map(subject: Subject) -> bool:
    return subject.size_axis is not None and subject.tilted


def _map_grouping(subject: Subject) -> Grouping:
    return subject.along(TILT, MAP_ROWS) + subject.along(str(subject.size_axis), MAP_COLUMNS)


def _map_panel(
    subject: Subject, found: xr.Dataset, name: str, title: str, *, share: bool = False
) -> Panel:
    along = str(subject.size_axis)
    rows, columns = labels_of(found, TILT), labels_of(found, along)
    values = found[name].transpose(TILT, along).values.astype(np.float64)
    labels = (subject.label(along), subject.label(TILT))
    return Panel(
        title, f"Map of {lower(title)} over {labels[0]} and {labels[1]}.",
        lambda axes: draw_map(axes, rows, columns, values, labels, share=share),
        wide=len(columns) > WIDE_FROM, height=max(2.6, 1.3 + 0.22 * len(rows)),
    )


def _maps(subject: Subject) -> RenderedFigure:
    grouping = _map_grouping(subject)
    found = subject.of(error_statistics, grouping)
    return RenderedFigure(
        "maps", f"Detection and rotation error over {_short_name(str(subject.size_axis))} and tilt",
        sentences(
            "Detection rate in percent, and 95 % quantile of the rotation error in degrees, in "
            "which a pose that was not solved counts as infinite (\u221e).", of_how_many(found),
            *grouping.notes, subject.pooled(*grouping.dims),
        ),
        table_of(found, "Detection rate and rotation error, with 95 % intervals", grouping.dims,
                 RATES | {"rotation p95, deg": ("rotation_p95_deg", 1.0)}, subject.results),
        [_map_panel(subject, found, "detection_rate", "Detected, %", share=True),
         _map_panel(subject, found, "rotation_p95_deg", "Rotation error, p95, deg")],
    )


def _flips(subject: Subject) -> RenderedFigure:
    grouping = _map_grouping(subject)
    found = subject.of(flip_rate, grouping)
    return RenderedFigure(
        "flips", f"Flips to the mirrored pose over {_short_name(str(subject.size_axis))} and tilt",
        sentences(
            "Share of the solved poses that are nearer to the mirror of the truth than to the "
            "truth, in percent. At a tilt near 0 the mirror is hardly another pose.",
            of_how_many(found, "solved", "solved poses"), *grouping.notes,
            subject.pooled(*grouping.dims),
        ),
        table_of(found, "Flip rate, with 95 % intervals", grouping.dims,
                 {"solved": ("solved", 1.0), "flipped, %": ("flip_rate", 100.0)}, subject.results),
        [_map_panel(subject, found, "flip_rate", "Flipped, % of the solved", share=True)],
    )


# Failures.

def _failure_axis(subject: Subject) -> str | None:
    """Return the axis along which what becomes of poses changes most; None without any."""
    if subject.size_axis is not None:
        return subject.size_axis
    names = [name for name in (*subject.scene_axes, *subject.treatments) if name != IDS]
    if subject.size is not None:
        names.append(subject.size)
    if not names:
        return None

    def influence(name: str) -> float:
        found = subject.of(failure_composition, subject.along(name, STACKED_BARS))
        share = found["share"].fillna(0).transpose(name, "outcome").values
        return float(np.abs(share - share.mean(axis=0)).sum(axis=1).mean())

    return max(names, key=influence)


def _failures(subject: Subject) -> RenderedFigure:
    axis = _failure_axis(subject)
    grouping = subject.along(axis, STACKED_BARS) if axis else Grouping()
    found = subject.of(failure_composition, grouping)
    names = labels_of(found, axis) if axis else ["all"]
    dims = ([axis] if axis else [])
    if axis and axis in found.indexes and np.issubdtype(found[axis].dtype, np.number):
        order = np.argsort(found[axis].values, kind="stable")
        found, names = found.isel({axis: order}), [names[k] for k in order]
    counted = found["count"].sum(dims)
    parts = {
        str(outcome): np.atleast_1d(
            found["share"].sel(outcome=outcome).values.astype(np.float64))
        for outcome in found["outcome"].values.tolist()
        if counted.sel(outcome=outcome) > 0
        and np.isfinite(found["share"].sel(outcome=outcome)).any()
    }
    aside = ", ".join(
        f"{int(counted.sel(outcome=outcome)):,} {outcome}"
        for outcome in ("not_visible", "not_modelled", "not_run")
        if counted.sel(outcome=outcome) > 0
    )
    label = subject.label(axis) if axis else "all poses"
    columns = {
        outcome: cells(found.sel(outcome=outcome), "share", 100) for outcome in parts
    }
    total = found["count"].where(found["share"].notnull(), 0).sum("outcome")
    looked_for = [f"{int(value):,}" for value in np.atleast_1d(total.values)]
    rows = [
        [name, looked_for[k], *(column[k] for column in columns.values())]
        for k, name in enumerate(names)
    ]
    return RenderedFigure(
        "failures", "What became of the poses",
        sentences(
            "Shares of the poses looked for" + (f", by {_long_name(axis)}" if axis else "")
            + ": solved, or the flag that says why not.",
            f"Left out of the shares: {aside}." if aside else "",
            on_intervals(found, "share", marks="In the table there"),
            *grouping.notes, subject.pooled(*grouping.dims),
        ),
        Table("Shares in percent, with 95 % intervals",
              [label, "looked for", *(f"{name.replace('_', ' ')}, %" for name in parts)], rows),
        [Panel("Outcome", f"Stacked bars of the shares of {', '.join(parts) or 'nothing'}.",
               lambda axes: draw_stack(axes, names, parts, label),
               wide=len(names) > WIDE_FROM)],
    )


# Marker IDs.

def _ranking(subject: Subject) -> RenderedFigure:
    found = subject.once("marker_ranking", lambda: marker_ranking(subject.results))
    dims = [name for name in ("dictionary", IDS) if name in found["detection_rate"].dims]
    flat = found.stack(marker=dims, create_index=False)
    flat = flat.isel(marker=np.flatnonzero(flat["looked_for"].values > 0))
    order = np.lexsort((flat[IDS].values, flat["detection_rate"].values, ~flat["weak"].values))
    flat = flat.isel(marker=order)
    names = [
        " ".join(str(flat[dim].values[k]) for dim in dims) for k in range(flat.sizes["marker"])
    ]
    few = flat.isel(marker=slice(0, WEAKEST))
    value, low, high = ends_of(few, "detection_rate", 100)
    expected = 100 * few["expected_rate"].values.astype(np.float64)
    weak = few["weak"].values.astype(bool)
    count = int(flat["weak"].sum())
    panels = [Panel(
        "Weakest IDs", "Rows of the weakest IDs with their detection rates in percent.",
        lambda axes: draw_dots(
            axes, names[:WEAKEST], Series("", value, value, low, high), "detected, %", share=True,
            marked=weak, ticks=expected),
        height=rows_height(len(names[:WEAKEST])),
    )]
    if len(names) > WEAKEST:
        every = np.sort(100 * flat["detection_rate"].values.astype(np.float64))
        rank = np.arange(1, len(every) + 1, dtype=np.float64)
        line = Series("", rank, every, every * np.nan, every * np.nan)
        panels.append(Panel(
            "All IDs", "Line of the detection rates of all IDs, in increasing order.",
            lambda axes: draw_lines(axes, [line], ("rank", "detected, %"), share=True)))
    return RenderedFigure(
        "ranking", "Marker IDs, the weakest first",
        sentences(
            f"Detection rate of each ID{' of each dictionary' if len(dims) > 1 else ''}; the small "
            "upright line is what its scenes would give if all IDs were alike.",
            f"{count:,} of {len(names):,} IDs are weak (diamonds): below that, "
            "with an adjusted p-value under 0.05." if count else
            f"None of {len(names):,} IDs is weak (adjusted p-value under 0.05).",
            on_intervals(found, "detection_rate"), of_how_many(found),
            subject.pooled(*dims),
        ),
        Table(
            "IDs by detection rate, with 95 % intervals",
            [*(label_of(found, dim) for dim in dims), "looked for", "detected, %", "expected, %",
             "p, adjusted", "weak"],
            [list(row) for row in zip(
                *([str(value) for value in flat[dim].values.tolist()] for dim in dims),
                cells(flat, "looked_for"), cells(flat, "detection_rate", 100),
                cells(flat, "expected_rate", 100), cells(flat, "p_adjusted"),
                cells(flat, "weak"), strict=True)],
            stub=len(dims),
        ),
        panels,
    )


# The effect of any one axis.

def effect_of(name: str) -> FigureKind:
    """Return the kind of figure that shows the effect of one axis, of the scene or a treatment."""
    return FigureKind(f"effect-{name}", lambda subject: subject.length(name) > 1,
                      lambda subject: _effect(subject, name), lambda _: (name,))


def _effect(subject: Subject, name: str) -> RenderedFigure:
    axis = subject.pipeline.axis(name)
    numeric = axis is not None and is_numeric(axis)
    grouping = subject.along(name, 40 if numeric else WEAKEST)
    found = subject.of(error_statistics, grouping)
    label = subject.label(name)

    def panel(variable: str, title: str, unit: str, scale: float = 1.0) -> Panel:
        share = scale != 1
        if numeric:
            lines = series_of(found, name, variable, None, scale)
            return Panel(title, f"Line of {lower(title)} in {unit} against {label}.",
                         lambda axes: draw_lines(axes, lines, (label, f"{lower(title)}, {unit}"),
                                                 share=share))
        names = labels_of(found, name)
        value, low, high = ends_of(found, variable, scale)
        return Panel(title, f"Rows of {lower(title)} in {unit} for each {name}.",
                     lambda axes: draw_dots(axes, names, Series("", value, value, low, high),
                                            f"{lower(title)}, {unit}", share=share),
                     height=rows_height(len(names)))

    return RenderedFigure(
        f"effect-{name}", f"The effect of {name}",
        sentences(
            f"Detection rate, and median and 95 % quantile of the rotation error, by {name}"
            + (f" ({axis.meaning})." if axis is not None else "."),
            on_intervals(found, "detection_rate", marks="Bars and bands"), MISSES,
            of_how_many(found),
            *grouping.notes, subject.pooled(*grouping.dims),
        ),
        table_of(found, f"By {name}, with 95 % intervals", grouping.dims, RATES | ERRORS,
                 subject.results),
        [panel("detection_rate", "Detected", "%", 100),
         panel("rotation_median_deg", "Rotation error, median", "deg"),
         panel("rotation_p95_deg", "Rotation error, p95", "deg"),
         panel("range_median_percent", "Range error, median", "%")],
    )


def _short_name(name: str) -> str:
    return {AREA: "area", "side_px": "size", "distance_m": "distance"}.get(name, name)


def _long_name(name: str) -> str:
    return {AREA: "area in the image", "side_px": "side in the image",
            "distance_m": "distance"}.get(name, name)


def _by_tilt(subject: Subject) -> str:
    return ", by tilt" if subject.tilted else ""


def _size_axes(subject: Subject) -> list[str]:
    return [name for name in (subject.size_axis, TILT if subject.tilted else None) if name]


DETECTION = FigureKind("detection", lambda s: s.size is not None, _detection, _size_axes)
ERRORS_BY_SIZE = FigureKind("errors", lambda s: s.size is not None, _errors, _size_axes)
MAPS = FigureKind("maps", _has_map, _maps)
FAILURES = FigureKind("failures", lambda _: True, _failures)
FLIPS = FigureKind(
    "flips", lambda s: _has_map(s) and bool(s.of(flip_rate)["solved"] > 0), _flips)
RANKING = FigureKind("ranking", lambda s: s.length(IDS) > 1, _ranking, lambda _: (IDS,))
