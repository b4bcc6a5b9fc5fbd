"""The figures of the page "What reality adds"."""  # noqa: INP001  (not a package)

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sweep.measure.flags import EstimateStatus
from sweep.report.figure import COLOURS, INK, STYLE

WIDTH = 9.0
"""Inches; a point is 1.4 px where the figure is 900 px wide."""
DOTS_PER_INCH = 150

LINES: Mapping[str, dict[str, Any]] = {
    "photographs": {"color": INK, "lw": 2.0},
    "without new effects": {"color": COLOURS[4], "lw": 1.6, "ls": (0, (4, 2))},
    "fitted": {"color": COLOURS[1], "lw": 1.6},
}
"""What is compared, in the order of the legend."""

ROTATION_DEG = (0.05, 90.0)
MOST_PERCENT = 8.0
"""Range errors beyond it are drawn at the edge."""

MOST_RESIDUAL = 0.1
"""Residual, as a share of the contrast, of the ends of the colour scale."""


def errors(results: xr.Dataset, refinement: str) -> tuple[NDArray[np.float64], ...]:
    """Return the rotation errors in degrees and the depth errors in %, each sorted, of solved."""
    some = results.sel(cornerRefinementMethod=refinement)
    solved = some["estimate"] == EstimateStatus.solved
    depth = some["translation_error_m"].sel(xyz="z") / some["true_tvec_m"].sel(xyz="z")
    arrays = (some["rotation_error_deg"].where(solved), (100 * depth).where(solved))
    flat = (array.values.ravel() for array in arrays)
    return tuple(np.sort(values[np.isfinite(values)]) for values in flat)


def draw_errors(
    path: Path, sets: Mapping[str, Mapping[str, xr.Dataset]], refinements: Sequence[str]
) -> None:
    """Draw the distributions of errors: a pair of rows of each set, a column of each refinement."""
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=(WIDTH, 3.3 * len(sets)))
        panels = figure.subplots(2 * len(sets), len(refinements), squeeze=False, sharey=True)
        for row, (name, results) in enumerate(sets.items()):
            for column, refinement in enumerate(refinements):
                turn, shift = panels[2 * row][column], panels[2 * row + 1][column]
                _draw_turns(turn, results, refinement)
                _draw_ranges(shift, results, refinement)
                turn.set_title(f"{name}\n{refinement}" if column == 0 else f"\n{refinement}")
            for axes in (panels[2 * row][0], panels[2 * row + 1][0]):
                axes.set_ylabel("share of solved poses")
        handles, labels = panels[0][0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3)
        figure.savefig(path, dpi=DOTS_PER_INCH)


def _draw_turns(axes: Axes, results: Mapping[str, xr.Dataset], refinement: str) -> None:
    for source, style in LINES.items():
        values = np.clip(errors(results[source], refinement)[0], *ROTATION_DEG)
        axes.step(values, np.arange(1, len(values) + 1) / len(values), where="post", label=source,
                  **style)
    axes.set(xscale="log", xlim=ROTATION_DEG, ylim=(0, 1), xlabel="rotation error, °")
    axes.set_xticks([0.1, 1, 10], ["0.1", "1", "10"])
    axes.minorticks_off()
    axes.grid(visible=True)


def _draw_ranges(axes: Axes, results: Mapping[str, xr.Dataset], refinement: str) -> None:
    for source, style in LINES.items():
        values = np.clip(errors(results[source], refinement)[1], -MOST_PERCENT, MOST_PERCENT)
        axes.step(values, np.arange(1, len(values) + 1) / len(values), where="post", **style)
    axes.axvline(0, color="#7a7a7a", lw=0.7)
    axes.set(xlim=(-4, MOST_PERCENT), ylim=(0, 1), xlabel="depth error, %")
    axes.grid(visible=True)


def draw_residuals(path: Path, sets: Mapping[str, Mapping[str, NDArray[np.float64]]]) -> None:
    """Draw mean images in the marker's plane: the photographs', and what simulations lack.

    Parameters
    ----------
    path
        The figure's file.
    sets
        Name of a set -> source of `LINES` -> (n, n) mean; of photographs the mean level, of others
        the mean residual, both as shares of the contrast.
    """
    with mpl.rc_context(fname=STYLE):
        figure = Figure(figsize=(WIDTH, 3.0 * len(sets)))
        panels = figure.subplots(len(sets), 3, squeeze=False)
        for row, (name, images) in zip(panels, sets.items(), strict=True):
            for axes, source in zip(row, LINES, strict=True):
                if source == "photographs":
                    shown = axes.imshow(images[source], cmap="gray", vmin=-0.1, vmax=1.1)
                    axes.set_title(f"{name}\nmean of the markers")
                else:
                    shown = axes.imshow(
                        images[source], cmap="RdBu_r", vmin=-MOST_RESIDUAL, vmax=MOST_RESIDUAL)
                    rms = float(np.sqrt(np.nanmean(images[source] ** 2)))
                    axes.set_title(f"{source}:\nRMS of what is left {100 * rms:.1f} %")
                axes.set_xticks([])
                axes.set_yticks([])
                for spine in axes.spines.values():
                    spine.set_visible(False)
            figure.colorbar(shown, ax=list(row), shrink=0.8, label="share of the contrast")
        figure.savefig(path, dpi=DOTS_PER_INCH)
