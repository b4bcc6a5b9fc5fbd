"""A table of other renderers: their cost, and the differences that they make."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from sweep.tradeoff.labels import configuration_label, digits

IMAGES = {"ms an image": "render_ms", "x exact": "render_ratio", "grey RMS": "grey_rms",
          "grey max": "grey_max"}
CHANGES = {
    "detection differs, %": ("detection_disagreement", 100),
    "corner RMS px": ("corner_shift_rms_px", 1),
    "range bias %": ("range_bias_percent", 1), "rotation RMS deg": ("rotation_shift_deg", 1),
}
"""Heading -> variable of the images; heading -> variable of a configuration, and its factor."""


def renderer_lines(renderers: xr.Dataset, *, markdown: bool) -> list[str]:
    """Return the lines of a table of the renderers in ``cost/renderers``.

    First the images: cost, and difference from the exact image. Then for each configuration the
    share of scenes in which the marker is detected in only one of the two images, and the change
    of corners, range and rotation, paired on the scenes that both solve.
    """
    rows = [["renderer", *IMAGES, "configuration", *CHANGES], *_rows(renderers)]
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
            configuration = one.isel(dict(zip(settings, index, strict=True)))
            label = configuration_label({dim: configuration[dim].item() for dim in settings})
            changes = [
                digits(float(configuration[variable]) * factor)
                for variable, factor in CHANGES.values()
            ]
            first = not any(index)
            yield [name if first else "", *(images if first else [""] * len(images)), label,
                   *changes]
