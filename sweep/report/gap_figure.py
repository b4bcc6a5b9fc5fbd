"""The figure of photographs and their simulation: distributions of errors side by side."""

from __future__ import annotations

import itertools
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from sweep.analysis.binning import Bins
from sweep.analysis.paired_units import PairedUnits, Units, paired_units
from sweep.analysis.simulation_gaps import SOURCES
from sweep.report.formatting import coordinate
from sweep.report.scales import plain_ticks
from sweep.report.svg import Panel, write_panels
from sweep.report.theme import COLOURS, DASHES
from sweep.typing import Floats

MAX_CONFIGURATIONS = 6
"""Configurations that are drawn, two panels each."""

FIRST_SHARE, LAST_SHARE = 0.02, 0.98
"""Shares of the errors between which the axis lies."""


def gap_panels(
    photographs: xr.Dataset, simulated: xr.Dataset, bins: Bins | None = None
) -> list[Panel]:
    """Return the panels of photographs and a simulation, as `sweep.analysis.simulation_gap`.

    For each configuration the distribution functions of the rotation error and of the depth error
    of all solved poses; of a simulation that is compared in bins, those within the bins.
    """
    pair = paired_units(photographs, simulated, bins)
    inside = [np.logical_or.reduce(masks) for masks in zip(*pair.bins(), strict=True)]
    sides = [side.within(mask) for side, mask in zip((pair.first, pair.second), inside,
                                                      strict=True)]
    panels = []
    for k, name in enumerate(_names(pair)[:MAX_CONFIGURATIONS]):
        for error, words, absolute in (
            ("rotation_deg", "rotation error [degree]", True),
            ("range_percent", "depth error [% of the true depth]", False),
        ):
            values = [_solved(side, error, k) for side in sides]
            panels.append(Panel(
                name or "All markers",
                f"Share of the solved poses with at most this {words}: photographs and simulation.",
                partial(draw_distributions, values=values, label=words, logarithmic=absolute)))
    return panels


def _names(pair: PairedUnits) -> list[str]:
    values = (
        [f"{name} {coordinate(each)}" for each in pair.coordinates[name].values.tolist()]
        for name in pair.configurations
    )
    return [", ".join(each) for each in itertools.product(*values)]


def _solved(side: Units, error: str, configuration: int) -> Floats:
    """Return the errors of the solved poses of a configuration, ascending."""
    values = getattr(side, error)[configuration][side.solved[configuration]]
    return np.asarray(np.sort(values[np.isfinite(values)]))


def draw_distributions(
    axes: Axes, values: list[Floats], label: str, *, logarithmic: bool
) -> None:
    """Draw the distribution functions of ascending values of both sources."""
    for k, (source, ascending) in enumerate(zip(SOURCES, values, strict=True)):
        shares = 100.0 * np.arange(1, len(ascending) + 1) / max(len(ascending), 1)
        axes.plot(ascending, shares, color=COLOURS[k], linestyle=DASHES[k], label=source,
                  drawstyle="steps-post")
    known = [each for each in values if len(each)]
    if known:
        ends = [np.quantile(each, [FIRST_SHARE, LAST_SHARE]) for each in known]
        low, high = min(end[0] for end in ends), max(end[1] for end in ends)
        logarithmic = logarithmic and low > 0
        axes.set_xscale("log" if logarithmic else "linear")
        if low < high:
            axes.set_xlim(low, high)
    axes.set_ylim(0.0, 100.0)
    plain_ticks(axes.xaxis, logarithmic=logarithmic and bool(known))
    plain_ticks(axes.yaxis, logarithmic=False, share=True)
    axes.set_xlabel(label)
    axes.set_ylabel("share of solved poses [%]")
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.02), ncols=2, borderaxespad=0)


def figure_bytes(panels: list[Panel], suffix: str) -> bytes:
    """Return panels as a file of ".svg" or ".png"."""
    with tempfile.TemporaryDirectory() as folder:
        stem = Path(folder) / "gap"
        write_panels(panels, stem)
        return stem.with_suffix(suffix).read_bytes()
