"""What other renderers cost, and what they change, as a table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from sweep.tradeoff.pareto import digits

IMAGES = {"ms an image": "render_ms", "x exact": "render_ratio", "grey RMS": "grey_rms",
          "grey max": "grey_max"}
CHANGES = {
    "found or not, %": ("detection_disagreement", 100), "corner RMS px": ("corner_shift_rms_px", 1),
    "range bias %": ("range_bias_percent", 1), "rotation RMS deg": ("rotation_shift_deg", 1),
}
"""Headings, the variables below them, and what these are multiplied by."""


def renderer_lines(renderers: xr.Dataset, *, markdown: bool) -> list[str]:
    """Return the lines of a table of renderers (rows) as ``cost/renderers`` holds them.

    The images' own cost and difference from exact ones, then for each treatment how often it
    finds what it does not find in the exact image or the other way round, and by how much corners,
    range and rotation change, paired on the scenes that both solve.
    """
    rows = [["renderer", *IMAGES, "treatment", *CHANGES], *_rows(renderers)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    if markdown:
        lines = ["| " + " | ".join(row) + " |" for row in rows]
        return [lines[0], "|" + " --- |" * len(widths), *lines[1:]]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _rows(renderers: xr.Dataset) -> Iterator[list[str]]:
    pose = renderers["range_bias_percent"]
    settings = [str(dim) for dim in pose.dims if dim != "renderer"]
    for name in renderers["renderer"].values.tolist():
        one = renderers.sel(renderer=name)
        images = [digits(float(one[variable])) for variable in IMAGES.values()]
        if name == renderers.attrs["reference"]:
            yield [name, *images, "", *[""] * len(CHANGES)]
            continue
        for index in np.ndindex(*(one.sizes[dim] for dim in settings)):
            chosen = dict(zip(settings, index, strict=True))
            treated = one.isel(chosen)
            label = " · ".join(str(treated[dim].item()) for dim in settings)
            changes = [
                digits(float(treated[variable]) * factor) for variable, factor in CHANGES.values()
            ]
            first = not any(index)
            yield [name if first else "", *(images if first else [""] * len(images)), label,
                   *changes]
