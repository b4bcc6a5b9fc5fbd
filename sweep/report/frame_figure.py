"""The figure of the detection rate over the frame: where in the image the marker is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from sweep.analysis import detection_rate
from sweep.analysis.binning import Bins
from sweep.model.camera import VIEW_PARAMETERS, intrinsics
from sweep.plan.boards import target_word
from sweep.plan.parameters import Stage
from sweep.report.charts import draw_map
from sweep.report.configurations import settings_of, shown_lines, shown_note
from sweep.report.error_columns import RATES
from sweep.report.figure import FigureKind, RenderedFigure, denominators, sentences
from sweep.report.grouping import CONFIGURATION, Grouping, by_configuration, group_labels
from sweep.report.report_data import ReportData
from sweep.report.svg import Panel
from sweep.report.table import table_of

ACROSS, DOWN = "frame_u_percent", "frame_v_percent"
COLUMNS, ROWS = 8, 6
MAX_MAPPED = 3
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


def _render(data: ReportData) -> RenderedFigure:
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
    shown = shown_lines(data, settings, MAX_MAPPED)
    several = len(names) > 1
    columns, rows = group_labels(summary, ACROSS), group_labels(summary, DOWN)[::-1]
    labels = ("from the left, % of the width", "from the top, % of the height")

    def panel(k: int) -> Panel:
        values = summary["detection_rate"].isel({CONFIGURATION: k}).transpose(DOWN, ACROSS).values
        whose = f", {names[k]}" if several else ""
        return Panel(
            f"Detected, %{whose}", f"Map of the detection rate over the frame{whose}.",
            lambda axes: draw_map(axes, rows, columns, values.astype(np.float64)[::-1], labels,
                                  share=True))

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
        [panel(k) for k in shown],
    )


FRAME = FigureKind("frame", _applies, _render)
