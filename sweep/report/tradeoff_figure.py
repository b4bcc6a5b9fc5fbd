"""Cost and accuracy of every configuration: the table and its figure, and the renderers' table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis.dataset import each_cell
from sweep.report.figure import Figure
from sweep.report.table import Column, Table
from sweep.tradeoff.pareto import CRITERIA, UNITS, conditions_of, configuration_label, mark_front

#: Statistics in the names of the variables of rotation and range.
STATISTICS = ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99")

CRITERION = "rotation_p95_deg"
#: Used if the first is infinite or NaN for every configuration of some condition.
OTHER_CRITERION = "rotation_median_deg"

MS, MS_VARIABLE = "ms a frame", "cost_ms"


def heading_of(name: str) -> str:
    """Return a variable's name in words, its unit behind a comma: ``range RMSE, %``."""
    words, _, unit = name.rpartition("_")
    words = words.replace("_", " ").replace("rmse", "RMSE")
    return f"{words}, {'%' if unit == 'percent' else unit}"


def trade_columns(trade: xr.Dataset, criterion: str) -> tuple[xr.Dataset, list[Column]]:
    """Return a trade with its front and covariances as columns, and the columns of its table.

    Columns without any value are left out, but for the cost and the criterion.
    """
    columns = [
        Column(MS, MS_VARIABLE), Column("x baseline", "cost_ratio"),
        Column("detected, %", "detection_rate", 100), Column("flips, %", "flip_rate", 100),
        Column(heading_of(criterion), criterion)]
    for quantity, unit in UNITS.items():
        names = (f"{quantity}_{statistic}_{unit}" for statistic in STATISTICS)
        columns += [Column(heading_of(name), name) for name in names if name != criterion]
        columns.append(Column(f"{quantity} efficiency", f"{quantity}_efficiency"))
    columns.append(Column("NEES", "nees_mean"))
    marked = mark_front(trade, criterion)
    for level in marked["level"].values.tolist() if "covariance_coverage" in marked else ():
        name = f"covered_{level:g}"
        marked[name] = marked["covariance_coverage"].sel(level=level, drop=True)
        columns.append(Column(f"in {100 * level:g} % ellipsoid, %", name, 100))
    if "covariance_trusted" in marked:
        marked["trusted"] = marked["covariance_trusted"].astype(object).where(
            marked["nees_count"] > 0, None)
        columns.append(Column("covariance trusted", "trusted"))
    return marked, [each for each in columns if each.variable in (MS_VARIABLE, criterion) or (
        each.variable in marked and bool(marked[each.variable].notnull().any()))]


def tradeoff_table(trade: xr.Dataset, criterion: str) -> Table:
    """Return a row for each condition and configuration, the cheapest first.

    Times are in ms a frame, rotations in degrees, ranges in percent; values have their 95 %
    intervals. Columns whose variables ``trade`` lacks are left out.

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms`` or the criterion.
    """
    marked, columns = trade_columns(trade, criterion)
    rows: list[list[Any]] = []
    for label, at, part in conditions_of(marked):
        ordered = part.isel(treatment=np.argsort(part["cost_ms"].to_numpy(), kind="stable"))
        cells = zip(*(each.cells(ordered) for each in columns), strict=True)
        rows += [[*([label] if at else []), str(name), bool(front), *values]
                 for name, front, values in zip(
                     ordered["treatment"].values, ordered["on_front"].values, cells, strict=True)]
    several = ["condition"] if trade["cost_ms"].ndim > 1 else []
    return Table.of(
        "Cost and accuracy, the cheapest first, with 95 % intervals",
        [*several, "configuration", "on the front", *(each.heading for each in columns)], rows,
        stub=len(several) + 2)


def trade_figure(
    trade: xr.Dataset, criterion: str = "", lines: Sequence[str] = ()
) -> Figure:
    """Return cost, ms a frame, against an error, a panel for each condition.

    Parameters
    ----------
    trade
        As measured by `sweep.tradeoff`.
    criterion
        An error of ``trade`` (default: the one asked for when it was measured).
    lines
        The recommendation.
    """
    criterion = criterion or trade_criterion(trade)
    heading = heading_of(criterion)
    return Figure(
        "trade", "Cost and accuracy", (
            f"Cost of detection and estimation, ms a frame, against {heading}, of each "
            f"configuration on the same {trade.attrs.get('poses', 0):,} images, with 95 % "
            "intervals. Joined are those on the Pareto front: no other configuration is both "
            f"cheaper and better. {' '.join(f'{line}.' for line in lines)}").strip(),
        tradeoff_table(trade, criterion), [Column(heading, criterion)], MS, "on the front",
        labels="configuration")


def trade_criterion(trade: xr.Dataset) -> str:
    """Return the error that ranks configurations: that asked for, if it is finite everywhere."""
    asked = str(trade.attrs.get("criterion", CRITERION))
    names = [name for name in (asked, CRITERION, OTHER_CRITERION)
             if name in CRITERIA and name in trade]
    return next(
        (name for name in names
         if np.isfinite(trade[name].values).any(axis=trade[name].dims.index("treatment")).all()),
        names[0])


WINDOWS = {
    "auto": "searched: the marker's surroundings",
    "full": "searched: the whole frame",
    "mixed": "searched: the whole frame or the marker's surroundings, as each setting needs",
}


def headlines(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return the title, the facts of the measurement, and what the table's words mean."""
    attrs = trade.attrs
    return [
        str(attrs.get("title", "")),
        (f"{attrs.get('poses')} poses; {WINDOWS.get(str(attrs.get('window')), '')}; baseline: "
         f"{attrs.get('baseline')}; ms a frame: detection and estimation"),
        (f"on the front: no other configuration is both cheaper and better in {criterion}; RMSE "
         "and bias: of the solved poses; median, p95, p99: a pose that is not solved counts as an "
         "infinite error"),
    ]


IMAGES = (Column("ms an image", "render_ms"), Column("x exact", "render_ratio"),
          Column("grey RMS", "grey_rms"), Column("grey max", "grey_max"))
#: Columns of the images, and of a configuration.
CHANGES = (
    Column("detection differs, %", "detection_disagreement", 100),
    Column("corner RMS px", "corner_shift_rms_px"), Column("range bias %", "range_bias_percent"),
    Column("rotation RMS deg", "rotation_shift_deg"))


def renderer_table(renderers: xr.Dataset) -> Table:
    """Return a table of the renderers in ``cost/renderers``.

    First the images: cost, and difference from the exact image. Then for each configuration the
    share of scenes in which the marker is detected in only one of the two images, and the change
    of corners, range and rotation, paired on the scenes that both solve.
    """
    return Table.of(
        "Other renderers against exact images",
        ["renderer", "configuration", *(each.heading for each in (*IMAGES, *CHANGES))],
        list(_renderer_rows(renderers)), stub=2)


def _renderer_rows(renderers: xr.Dataset) -> Iterator[list[Any]]:
    settings = [str(dim) for dim in renderers["range_bias_percent"].dims if dim != "renderer"]
    for name in renderers["renderer"].values.tolist():
        one = renderers.sel(renderer=name)
        images = [cell for each in IMAGES for cell in each.cells(one)]
        if name == renderers.attrs["reference"]:
            yield [name, None, *images, *[None] * len(CHANGES)]
            continue
        for at, cell in each_cell(one, settings):
            yield [name, configuration_label(at), *images,
                   *(value for each in CHANGES for value in each.cells(cell))]
