"""A search for limits: a run along an axis, or a store that has the answer."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import xarray as xr

from sweep.analysis.decisions import requirement_limits
from sweep.analysis.requirements import check_required
from sweep.errors import ArgumentError, StoreError
from sweep.execution.runner import execute
from sweep.execution.status import Summary
from sweep.experiment.document import SEARCH
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import search_settings, texts_in
from sweep.store.lifecycle import (
    document_of,
    names_store,
    open_dataset,
    open_store,
    read_pipeline,
    unfinished_line,
)

#: The most trials of a cell where nothing says how many.
MAX_TRIALS = 2400


def search_limits(
    source: Pipeline | str | os.PathLike[str], *, require: Sequence[str] = (), along: str = "",
    per: Sequence[str] | None = None, at_all: Sequence[str] | None = None,
    max_trials: int | None = None,
    settings: Sequence[str] = (), store: str | os.PathLike[str] | None = None,
    begin: Callable[[Pipeline], None] = lambda _: None, **options: Any,
) -> tuple[xr.Dataset, Summary | None]:
    """Run a search, and return its limits and the run's summary, None if nothing had to run.

    Parameters
    ----------
    source
        A pipeline, its file, or a store: one of a search is continued, and one of equally many
        trials everywhere is analysed as it is.
    require, along, per, at_all, max_trials, store
        As `sweep.limit` has them.
    settings
        As ``--set`` takes them.
    begin
        Is called with the pipeline before it is run.
    options
        Of `sweep.execution.runner.execute`.

    Raises
    ------
    PipelineError, StoreError, RunError, ArgumentError
        As `sweep.limit`.
    """
    chosen = search_settings(require, along, per, at_all, max_trials)
    if not isinstance(source, Pipeline) and names_store(source):
        stored = open_store(os.fspath(source))
        if stored.pipeline.stopping is None and stored.pipeline.axis("trial") is not None:
            if not stored.finished:
                raise StoreError(unfinished_line(stored))
            results = open_dataset(os.fspath(source))
            limits = requirement_limits(results, require, along, per, at_all)
            return limits.assign_attrs(store=os.fspath(source)), None
        if store is None and not settings:
            store = source
    pipeline = _with_search(source, settings, chosen)
    rule = pipeline.stopping
    assert rule is not None  # noqa: S101  (the section [search] has been read)
    begin(pipeline)
    if store is None:
        store = Path("runs") / f"{pipeline.name}-limit-{rule.along}.zarr"
    summary = execute(pipeline, store, **options)
    limits = requirement_limits(open_dataset(summary.store))
    return limits.assign_attrs(store=summary.store), summary


def _with_search(
    source: Pipeline | str | os.PathLike[str], settings: Sequence[str], chosen: Sequence[str]
) -> Pipeline:
    """Return a pipeline with the section [search] of its document and of what is chosen."""
    document = document_of(source)
    if document is None and not isinstance(source, Pipeline):
        return read_pipeline(source, settings)  # it says why
    document = document or {}
    own = document.get(SEARCH, {})
    given = {*(own if isinstance(own, dict) else ()), *(
        each.partition("=")[0].partition(".")[2] for each in chosen)}
    more = [] if "max_trials" in given else search_settings(max_trials=MAX_TRIALS)
    if "all" not in given and not texts_in(document):
        raise ArgumentError("require", "", "expected what must hold, such as 'detection >= 0.9'")
    if "along" not in given:
        raise ArgumentError("along", "", "expected the axis that is searched, such as distance_m")
    pipeline = read_pipeline(source, [*settings, *chosen, *more])
    if pipeline.requirements:
        check_required(pipeline.requirements, pipeline.source)
    return pipeline
