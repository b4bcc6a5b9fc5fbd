"""The error models of a store as a table."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
import xarray as xr

from sweep.analysis.error_model_bins import PREDICTORS
from sweep.analysis.error_model_sums import QUANTITIES
from sweep.analysis.error_model_values import model_errors
from sweep.analysis.error_models import Use, error_models
from sweep.report.error_model_file import RULE_M, configuration_names, stacked
from sweep.report.formatting import interval_text, number
from sweep.report.report_data import ReportData
from sweep.report.table import Table

CAPTION = (
    "Standard deviation (95 % interval) and bias of the error of poses without flips, in the sight "
    "frame: z along the line of sight"
)
MAX_DISTANCES, MAX_SIDES = 4, 3
ANGLES_DEG = (0.0, 30.0, 60.0)
"""The table has the knots nearest to these."""


def error_model_tables(data: ReportData) -> tuple[Table, ...]:
    """Return the table of a store's error models if they were made, as `--error-model` does."""
    models = data.known(error_models.__name__)
    return () if models is None else (error_model_table(models),)


def error_model_table(models: xr.Dataset) -> Table:
    """Return a table with a row for some distances and viewing angles of each configuration."""
    names, flat = configuration_names(models), stacked(models)
    rows = []
    for k, name in enumerate(names):
        model = flat.isel(model=k)
        label = [name] if len(names) > 1 else []
        rows += [[*label, *row] for at in _points(model) if (row := _row(model, at))]
    several = ["configuration"] if len(names) > 1 else []
    sided = ["side, px"] if models.sizes["side_px"] > 1 else []
    headings = [
        *several, "distance, m", *sided, "viewing angle, deg",
        "held-out check", "x, mm", "y, mm", "z, mm",
        "rotation x, deg", "rotation y, deg", "rotation z, deg",
        "bias of z, mm", "0.02 d² / sigma z",
    ]
    return Table(CAPTION, headings, rows, stub=len(several) + 2 + len(sided))


def exponent_lines(models: xr.Dataset) -> list[str]:
    """Return, for each configuration, with which power of the distance sigma of z goes."""
    flat = stacked(models)
    lines = []
    for k, name in enumerate(configuration_names(models)):
        z = flat.isel(model=k).sel(quantity="z")
        power, low, high = (float(z[f"exponent{end}"]) for end in ("", "_low", "_high"))
        if not np.isfinite(power):
            continue
        fits = int(z["knots"].sel(predictor="distance_m")) <= 2 and (
            int(z["knots"].sel(predictor="side_px")) <= 2)
        of = "distance" if models.sizes["distance_m"] > 1 else "side"
        lines.append(
            f"{name}: sigma of z goes with the {of} to the power {number(power)} "
            f"({interval_text(low, high)})"
            + ("" if fits else "; a power law does not describe it, the knots do"))
    return lines


def _points(model: xr.Dataset) -> list[dict[str, int]]:
    """Return indices of the knots that the table has."""
    angles = model["viewing_angle_deg"].values
    some = [
        _spread(model.sizes["distance_m"], MAX_DISTANCES),
        _spread(model.sizes["side_px"], MAX_SIDES),
        sorted({int(np.abs(angles - each).argmin()) for each in ANGLES_DEG}),
    ]
    return [dict(zip(PREDICTORS, index, strict=True)) for index in itertools.product(*some)]


def _spread(count: int, most: int) -> list[int]:
    return sorted({round(float(each)) for each in np.linspace(0, count - 1, min(count, most))})


def _row(model: xr.Dataset, at: dict[str, int]) -> list[str]:
    """Return the texts of a knot, none if the store has no poses there."""
    point = model.isel(at)
    distance, angle = (float(point[name]) for name in ("distance_m", "viewing_angle_deg"))
    side = float(point["side_px"]) if model.attrs["focal_size_varies"] else None
    use = model_errors(model, distance, angle, side)["use"].values[0]
    if (use == Use.no_poses).all():
        return []
    texts = []
    for k, name in enumerate(QUANTITIES):
        scale = 1e3 if k < 3 else float(np.degrees(1.0))
        sigma, low, high = (
            scale * float(point[f"sigma{end}"].sel(quantity=name)) for end in ("", "_low", "_high"))
        texts.append(f"{number(sigma)} ({interval_text(low, high)})")
    sided = [number(float(point["side_px"]))] if model.sizes["side_px"] > 1 else []
    bias = 1e3 * float(point["bias"].sel(quantity="z"))
    ratio = RULE_M * distance**2 / float(point["sigma"].sel(quantity="z"))
    return [number(distance), *sided, number(angle), _use(use), *texts, number(bias), number(ratio)]


def _use(use: Iterable[int]) -> str:
    """Return whether the models of a cell hold, and of which errors they do not."""
    by_flag: dict[int, list[str]] = {}
    for flag, name in zip(use, QUANTITIES, strict=True):
        by_flag.setdefault(int(flag), []).append(name.replace("_", " "))
    if len(by_flag) == 1:
        return Use(next(iter(by_flag))).name.replace("_", " ")
    return "; ".join(f"{', '.join(names)} {Use(flag).name.replace('_', ' ')}"
                     for flag, names in by_flag.items() if flag != Use.holds)


def plain_table(table: Table) -> str:
    """Return a table as aligned text, below its caption."""
    rows = [list(table.headings), *map(list, table.rows)]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.headings))]
    lines = [
        "  ".join(text.ljust(width) if k < table.stub else text.rjust(width)
                  for k, (text, width) in enumerate(zip(row, widths, strict=True))).rstrip()
        for row in rows
    ]
    return "\n".join([table.caption, "", *lines])
