"""Questions to stores, each answered with findings that print themselves.

`sweep.require`, `sweep.measure_tradeoff` and `sweep.write_report` are these functions.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import xarray as xr

from sweep.analysis import simulation_gap
from sweep.analysis.comparisons import is_measured, regressions, store_differences
from sweep.analysis.requirements import (
    Decision,
    check_required,
    check_requirements,
    combined,
    conditions,
    parse_requirements,
    verdicts,
)
from sweep.errors import ArgumentError
from sweep.execution.progress import progress_display, stage_display
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline
from sweep.messages import byte_count, nearest, notice, quoted
from sweep.report import decisions
from sweep.report.comparison import trade_lines
from sweep.report.comparison_tables import (
    gap_figures,
    gap_lines,
    gap_table,
    store_difference_tables,
)
from sweep.report.error_model_file import check_error_model_file, written_error_models
from sweep.report.figure import write_figure
from sweep.report.output_file import figure_file, is_standard_stream
from sweep.report.report_data import read_report_data
from sweep.report.table import UNDECIDED, Findings, plural
from sweep.report.tradeoff_figure import headlines, renderer_table, trade_figure, tradeoff_table
from sweep.report.write_report import write_page
from sweep.store.lifecycle import open_dataset, open_finished, read_pipeline
from sweep.tradeoff.measurement import measure_trade
from sweep.tradeoff.pareto import CRITERIA

# --------------------------------------------------------------------------------------------------
# Whether requirements are met.


def require(
    store: str | PathLike[str], requirements: Sequence[str] = (), *,
    per: Sequence[str] | None = None, at: Sequence[str] = (), pipeline: str | None = None,
    against: str | PathLike[str] | None = None, every: bool = True,
) -> Findings:
    """Decide whether a store's results meet requirements.

    Parameters
    ----------
    store
        Path or URL of a finished store.
    requirements
        Such as "detection >= 0.95" (default: the section [require] of the store's pipeline).
    per
        Axes whose values are conditions, at each of which all must hold; others are pooled
        (default: those of [require], else the axes of size, angle and boards).
    at
        "name=value": only these values of axes.
    pipeline
        A TOML file whose section [require] is taken.
    against
        An older store, with which it is compared pose by pose: significantly worse is not met.
    every
        Whether the table of conditions has all of them, or those that fail.

    Returns
    -------
    Findings
        The decisions as tables and numbers; ``numbers["decision"]`` is that on all together, and
        ``data`` the dataset of `sweep.analysis.check_requirements`.

    Raises
    ------
    ArgumentError, StoreError, DatasetError
        For what cannot be required, and stores that cannot be read.

    Examples
    --------
    >>> found = sweep.require(folder / "two_sizes.zarr", ["detection >= 0.01"], per=[])
    >>> found.numbers["decision"].name
    'met'
    """
    results, stored = _selected(store, at)
    if pipeline is not None:
        stored = read_pipeline(pipeline)
        check_required(stored.requirements, pipeline)
    texts = list(requirements) or list(stored.requirements)
    axes = list(conditions(results, per, stored.require_per))
    if not texts and against is None:
        raise ArgumentError(
            "requirements", "[]", "the pipeline has no section [require]; give some, such as "
            "'detection >= 0.95' 'range_error_p95_percent <= 1'")
    required = parse_requirements(texts) if texts else ()
    table = check_requirements(results, required, axes) if required else None
    found = [] if table is None else verdicts(table)
    worse = [] if against is None else regressions(
        _selected(against, at)[0], results, [each.variable for each in required], axes)
    decision = combined(found) if found else Decision.met
    if any(each.worse for each in worse):
        decision = Decision.not_met
    pooled = decisions.pooled_axes(results, axes)
    lines = []
    if per is None and list(stored.require_per) != axes and axes:
        lines.append(f"at each value of {', '.join(axes)}; --per '' pools all")
    if pooled:
        lines.append(f"pooled over {', '.join(pooled)}; --per keeps axes apart as conditions")
    tables = [decisions.decision_table(found), decisions.regression_table(worse)]
    if table is not None:
        tables.append(decisions.condition_table(found, table, every=every))
    return Findings(
        [*tables, *lines], {
            "decision": decision, "per": axes, "pooled": pooled,
            "requirements": [
                {**dataclasses.asdict(each), "failing": [] if table is None else
                 decisions.conditions_of(each, table)[:decisions.MAX_ROWS]} for each in found],
            "against": worse},
        table, {Decision.met: 0, Decision.not_met: 1}.get(decision, UNDECIDED),
        (decisions.more_draws(found, results, os.fspath(store)), ""))


def _selected(
    url: str | PathLike[str], at: Sequence[str]
) -> tuple[xr.Dataset, Pipeline]:
    """Return a finished store's results at some values of axes, and its pipeline."""
    store = open_finished(os.fspath(url))
    return decisions.selected(open_dataset(url), at, store.pipeline), store.pipeline


# --------------------------------------------------------------------------------------------------
# The cost of each configuration.

def measure_tradeoff(
    store: str | PathLike[str], *, per: Sequence[str] = (), criterion: str = "rotation_p95_deg",
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
        check_required(pipeline.requirements, store)
        with progress_display() if progress else contextlib.nullcontext() as display:
            summary = execute(pipeline, None, progress=display)
        for line in summary.warnings:
            notice(line)
        store = summary.store
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


# --------------------------------------------------------------------------------------------------
# How two stores differ: photographs and their simulation, or two versions.

def compare(
    first: str, second: str, *, bins: Mapping[str, Sequence[float]] | None = None,
    output: str | None = None,
) -> Findings:
    """Compare photographs with a simulation, or two stores of one pipeline; as `sweep.compare`."""
    figure = figure_file(output)
    one, other = (_selected(url, ())[0] for url in (first, second))
    then = (f"sweep report {quoted(second)}", "")
    if is_measured(one) == is_measured(other):
        for name, value in (("bins", bins), ("output", output)):
            if value:
                raise ArgumentError(name, "", "expected a store of photographs and a simulation")
        table = store_differences(one, other)
        tables = store_difference_tables(table)
        return Findings([*tables.values()], {
            "first": first, "second": second,
            **{name: each.as_json()["rows"] for name, each in tables.items()}}, table, 0, then)
    gap = simulation_gap(one, other, bins).load()
    if figure is not None:
        write_figure(gap_figures(one, other, bins), figure)
    found = gap_table(gap)
    return Findings(
        [found, *gap_lines(gap)],
        {"photographs": first, "simulated": second, "paired": bool(gap.attrs["paired"]),
         **found.as_json()}, gap, 0, then)


# --------------------------------------------------------------------------------------------------
# The report of a store.

#: Suffixes of files that neither HTML nor Markdown would be taken for.
NO_REPORTS = {
    ".pdf", ".png", ".svg", ".jpg", ".jpeg", ".docx", ".odt", ".tex", ".ipynb", ".csv",
}


def write_report(
    store: str | PathLike[str], output: str | PathLike[str] | None = None, *,
    require: Sequence[str] = (), per: Sequence[str] | None = None, form: str | None = None,
    figures: str | PathLike[str] | None = None, error_model: Sequence[str] = (),
    command: str = "",
) -> Findings:
    """Write the report of a store: answer, figures, example scenes.

    Parameters
    ----------
    store
        Path or URL of a finished store.
    output
        File to write (default: ``report.html``, or ``report.md`` with the form "md").
    require, per
        As for :func:`require`: the report begins with whether, and how far, it is met.
    form
        "html": one page; "md": Markdown with a folder of figures (default: by the file's suffix).
    figures
        Folder into which each figure is written as SVG and PNG, too.
    error_model
        JSON files of the error models to write, too.
    command
        The command line that asked for it, which the report shows.

    Returns
    -------
    Findings
        The first line and the numbers of the report.

    Raises
    ------
    ArgumentError, StoreError, DatasetError
        For what cannot be required, or written.

    Examples
    --------
    >>> found = sweep.write_report(folder / "two_sizes.zarr", folder / "report.html")
    >>> found.numbers["figures"], (folder / "report.html").exists()
    (4, True)
    """
    output, figures = (
        None if each is None else os.fspath(each) for each in (output, figures))
    for name, value in (("output", output), ("figures", figures)):
        if value is not None and not value.strip():
            raise ArgumentError(name, repr(value), "expected a name")
    for path in error_model:
        check_error_model_file(path)
    if Path(output or "").suffix.lower() in NO_REPORTS:
        raise ArgumentError("output", output, "expected a file that ends in .html or .md")
    form = form or ("md" if str(output).lower().endswith(".md") else "html")
    page = Path(output or f"report.{form}")
    data = read_report_data(os.fspath(store), require, per, command)
    if error_model:
        written_error_models(data, error_model)
    count, answer = write_page(data, page, form, Path(figures) if figures else None)
    size = f", {byte_count(page.stat().st_size)}" if page.is_file() else ""
    then = (f"look at {page}", "")
    if data.trade is None and data.setting_axes:
        then = (f"sweep tradeoff {quoted(data.store)}", "what each configuration costs")
    content: dict[str, Any] = {
        "report": str(page), "figures": count, "store": data.store,
        "required": list(data.require), "per": list(data.per)}
    # Into the page's own stream a line more would not be HTML.
    lines = [] if is_standard_stream(page) else [
        f"{page}: {plural(count, 'figure')}{size}", *data.warnings, answer.headline]
    return Findings(lines, content | answer.as_json(), None, 0, then if lines else ("", ""))
