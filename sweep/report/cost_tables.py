"""Cost and accuracy of every configuration: the question, its table and figure, renderers."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Sequence
from os import PathLike

import numpy as np
import xarray as xr

from sweep.errors import ArgumentError
from sweep.execution.progress import progress_display, stage_display
from sweep.execution.runner import execute
from sweep.messages import nearest, notice, quoted
from sweep.report.comparison import trade_lines
from sweep.report.figure import Figure, caption_of, sentences, write_figure
from sweep.report.output_file import figure_file
from sweep.report.report_data import read_report_data
from sweep.report.table import Column, Findings, Table, table_of
from sweep.store.lifecycle import read_pipeline
from sweep.tradeoff.measurement import measure_trade
from sweep.tradeoff.pareto import CRITERIA, UNITS, mark_front

#: Statistics in the names of the variables of rotation and range.
STATISTICS = ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99")

#: The error that ranks configurations, and the one in its place if it is infinite somewhere.
CRITERION, OTHER_CRITERION = "rotation_p95_deg", "rotation_median_deg"

MS = Column("ms a frame", "cost_ms")
FRONT = Column("on the front", "on_front")


def measure_tradeoff(
    store: str | PathLike[str], *, per: Sequence[str] = (), criterion: str = CRITERION,
    limit_s: float = 60.0, budget_ms: float | None = None,
    output: str | PathLike[str] | None = None, progress: bool = False,
) -> Findings:
    """Measure what each configuration of a store costs, beside its accuracy on the same images.

    Parameters
    ----------
    store
        Path or URL of a finished store, or a TOML file, which is run first.
    per
        Axes of the scene whose values are conditions of their own.
    criterion
        The error that ranks configurations.
    limit_s
        Seconds of the measurement.
    budget_ms
        Most milliseconds a frame: the most accurate configuration within them is named.
    output
        PNG or SVG file of a figure.
    progress
        Whether progress is told on stderr.

    Returns
    -------
    Findings
        A row for each configuration and condition; ``data`` is the dataset that the store keeps in
        its group ``cost/tradeoff``.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        As for :func:`run`; also if costs cannot be measured here.

    Examples
    --------
    >>> found = sweep.measure_tradeoff(folder / "two_sizes.zarr", limit_s=0.5)
    >>> found.data.detection_ms.item() > 0  # milliseconds a frame
    True
    """
    if criterion not in CRITERIA:
        raise ArgumentError("criterion", criterion, f"expected one of {', '.join(CRITERIA)}"
                            + nearest(criterion, CRITERIA))
    for name, value in (("budget_ms", budget_ms), ("limit_s", limit_s)):
        if value is not None and not 0 < value < math.inf:
            raise ArgumentError(name, value, "expected a finite number above 0")
    figure = figure_file(output)
    store = os.fspath(store)
    if store.lower().endswith(".toml"):
        pipeline = read_pipeline(store)
        with progress_display() if progress else contextlib.nullcontext() as display:
            summary = execute(pipeline, None, progress=display)
        for line in summary.warnings:
            notice(line)
        store = str(summary.store)
    question: dict[str, str | float] = {"criterion": criterion}
    if budget_ms is not None:
        question["budget_ms"] = budget_ms
    with stage_display() if progress else contextlib.nullcontext() as stage:
        trade, renderers = measure_trade(store, per, limit_s, stage, question=question)
    if figure is not None:
        write_figure([trade_figure(trade, criterion)], figure)
    found = trade_lines(read_report_data(store), trade, budget_ms)
    frames, sampled = trade.attrs["frames"], trade.attrs["sampled"]
    few = [] if frames >= sampled else [
        (f"costs are those of {frames:,} of {sampled:,} sampled images; more --seconds, or markers "
         "that are seen, give more")]
    return Findings(
        [*headlines(trade, criterion), tradeoff_table(trade, criterion),
         *([] if renderers is None else [renderer_table(renderers)]), *few, *found],
        trade.to_dict() | {"advice": found}
        | ({} if renderers is None else {"renderers": renderers.to_dict()}),
        trade, 0, (f"sweep report {quoted(store)}", "with these costs and a figure of them"))


def heading_of(name: str) -> str:
    """Return a variable's name in words, its unit behind a comma: ``range RMSE, %``."""
    words, _, unit = name.rpartition("_")
    words = words.replace("_", " ").replace("rmse", "RMSE")
    return f"{words}, {'%' if unit == 'percent' else unit}"


def trade_columns(trade: xr.Dataset, criterion: str) -> tuple[xr.Dataset, list[Column]]:
    """Return a trade with its front and covariances as columns, and the columns of its table.

    Columns without any value are left out, but for the cost and the criterion.
    """
    first = Column(heading_of(criterion), criterion)
    columns = [
        FRONT, MS, Column("x baseline", "cost_ratio"),
        Column("detected, %", "detection_rate", 100), Column("flips, %", "flip_rate", 100), first]
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
    return marked, [each for each in columns if each in (MS, first) or (
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
    dims = [*(str(dim) for dim in trade["cost_ms"].dims if dim != "treatment"), "configuration"]
    marked = marked.rename(treatment="configuration")
    table = table_of(
        marked, "Cost and accuracy, the cheapest first, with 95 % intervals", dims, columns)
    cost = np.ravel(marked["cost_ms"].transpose(*dims))
    order = np.lexsort((cost, np.arange(cost.size) // marked.sizes["configuration"]))
    return dataclasses.replace(table, frame=table.frame.iloc[order])


def trade_figure(
    trade: xr.Dataset, criterion: str = "", lines: Sequence[str] = ()
) -> Figure:
    """Return cost, ms a frame, against an error, a panel for each condition.

    Parameters
    ----------
    trade
        As measured by `sweep.tradeoff`.
    criterion
        An error of ``trade`` (default: `trade_criterion`).
    lines
        The recommendation.
    """
    criterion = criterion or trade_criterion(trade)
    heading = heading_of(criterion)
    return Figure(
        "trade", "Cost and accuracy", sentences(
            caption_of("trade", heading=heading, poses=trade.attrs.get("poses", 0)),
            *(f"{line}." for line in lines)),
        tradeoff_table(trade, criterion), [Column(heading, criterion)], MS.heading, FRONT.heading,
        labels="configuration")


def trade_criterion(trade: xr.Dataset) -> str:
    """Return the error that ranks configurations: that asked for, if it is finite everywhere."""
    names = [name for name in (trade.attrs.get("criterion"), CRITERION, OTHER_CRITERION)
             if name in CRITERIA and name in trade]
    return next((name for name in names
                 if bool((abs(trade[name]) < np.inf).any("treatment").all())), names[0])


def headlines(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return the title, the facts of the measurement, and what the table's words mean."""
    attrs = trade.attrs
    searched = {"full": "the whole frame", "auto": "the marker's surroundings"}.get(
        str(attrs.get("window")), "the whole frame or the marker's surroundings, by setting")
    return [
        str(attrs.get("title", "")),
        (f"{attrs.get('poses')} poses; searched: {searched}; baseline: {attrs.get('baseline')}; "
         "ms a frame: detection and estimation"),
        (f"on the front: no other configuration is both cheaper and better in {criterion}; RMSE "
         "and bias: of the solved poses; median, p95, p99: a pose that is not solved counts as an "
         "infinite error"),
    ]


#: Columns of the images, then of a configuration on them, paired on scenes that both solve.
RENDERERS = (
    Column("ms an image", "render_ms"), Column("x exact", "render_ratio"),
    Column("grey RMS", "grey_rms"), Column("grey max", "grey_max"),
    Column("detection differs, %", "detection_disagreement", 100),
    Column("corner RMS px", "corner_shift_rms_px"), Column("range bias %", "range_bias_percent"),
    Column("rotation RMS deg", "rotation_shift_deg"))


def renderer_table(renderers: xr.Dataset) -> Table:
    """Return a table of the renderers in ``cost/renderers``.

    Cost of the images and difference from the exact image; then for each configuration the share
    of scenes in which the marker is detected in only one of the two images, and the change of
    corners, range and rotation, paired on the scenes that both solve.
    """
    settings = [str(dim) for dim in renderers["range_bias_percent"].dims if dim != "renderer"]
    return table_of(renderers, "Other renderers against exact images", ["renderer", *settings],
                    RENDERERS)
