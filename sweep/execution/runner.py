"""A run from its plan to its finished store: prepared, computed, closed."""

from __future__ import annotations

import contextlib
import importlib
import os
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Unpack

from sweep import errors
from sweep.evaluation.block import try_plugins
from sweep.execution import forecast, progress, status
from sweep.execution.executors import Children, Executor, Failed
from sweep.execution.waves import InWaves
from sweep.experiment.grid import MAX_VALUES, TRIAL
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.sampling import NO_TRIALS, search_settings
from sweep.isolation.child_process import Child, ChildError, Interrupts
from sweep.messages import notice, quoted
from sweep.sampling.rules import make_rule
from sweep.store import blocks, lifecycle
from sweep.store.blocks import RunStore
from sweep.store.locations import absolute_url, check_writable, exists, open_storage
from sweep.store.lock import changing, is_written, writing
from sweep.store.provenance import differences, match

if TYPE_CHECKING:
    import xarray as xr


# --------------------------------------------------------------------------------------------------
# A run from a pipeline to a finished store: prepare, compute and finish, in order.

def announce_compilation(pipeline: Pipeline) -> None:
    """Say in a line on stderr that a pipeline's functions are compiled, if they have not been."""
    used = {*pipeline.values_of("solver"), *(p.name for p in pipeline.facts.parts if p.active)}
    changing = {"lens distortion", *(effect.label for effect in pipeline.experiment.effects)}
    # Function -> how many seconds it takes with those that it needs, and whether it is used.
    needed = {
        "model.coverage.draw_greys": (3, True),
        "model.exposure.outline_extent": (4, used & changing),
        "measure.likelihood.descend": (20, used & {"photometric", "accuracy bound"}),
        "measure.photograph.locate_photograph": (30, "photometric_real" in used),
    }
    seconds = sum(length for name, (length, runs) in needed.items()
                  if runs and not is_cached(*f"sweep.{name}".rsplit(".", 1)))
    if seconds:
        notice(f"compiling, once for this version: about {seconds} s")


def is_cached(module: str, name: str) -> bool:
    """Return whether a function of a module is in the cache, or compilation is switched off."""
    function = getattr(importlib.import_module(module), name)
    with contextlib.suppress(Exception):  # there is no cache, or its use says that it is damaged
        return bool(function._cache._cache_file._load_index())  # noqa: SLF001
    return not hasattr(function, "_cache")


@progress.taking_run_options
def execute(
    pipeline: Pipeline,
    store: str | os.PathLike[str] | None = None,
    *,
    child: Child | None = None,
    **options: Unpack[progress.RunOptions],
) -> SimpleNamespace:
    """Run a pipeline into a store; blocks that are committed there are not computed again.

    Parameters
    ----------
    pipeline
        What to compute.
    store
        Path or URL of the store (default: ``runs/NAME.zarr``).
    child
        The process that measures scenes and computes small runs, if the caller started it earlier
        (`Child()`), so that it has imported its packages by now.
    options
        As `sweep.run` explains them; without ``workers``, a single process computes where
        less than :data:`sweep.execution.forecast.SMALL_RUN_S` seconds of work are predicted.

    Raises
    ------
    ArgumentError
        If an argument is out of its range, or the cluster cannot be used.
    StoreError
        If the store cannot be written, continued or reused as asked.
    RunError
        If blocks failed; the others are in the store, and another run continues.
    """
    started = time.perf_counter()
    make_rule(pipeline)  # it refuses names that it does not know
    workers, time_limit_s = options["workers"], options["time_limit_s"]
    scheduler, client = options["scheduler"], options["client"]
    reuse, overwrite = options["reuse"], options["overwrite"]
    errors.check_positive("workers", workers)
    if scheduler is not None and client is not None:
        raise errors.ArgumentError("scheduler", scheduler, "expected no client beside it")
    errors.check_positive("time_limit_s", time_limit_s, "expected seconds above 0")
    reuse = reuse if isinstance(reuse, Sequence) and not isinstance(reuse, str) else [reuse]
    if options["retry_failed"] and reuse:
        raise errors.ArgumentError(
            "reuse", errors.path_of("reuse", reuse[0]), "expected no retry_failed beside it")
    display = progress.progress_report(options["progress"])
    if options["progress"]:
        announce_compilation(pipeline)
    url = errors.path_of("store", store) if store is not None else f"runs/{pipeline.name}.zarr"
    begun = _store_to_continue(url, pipeline, overwrite)
    sources = _matching_sources(url, pipeline, reuse)
    done = set() if begun is None else blocks.committed(begun)
    again = status.failed_blocks(begun, done) if begun and options["retry_failed"] else {}
    stricter = begun is not None and begun.pipeline.stopping != pipeline.stopping
    if begun is not None and begun.finished and not (again or stricter):
        blocks.check_whole(begun)
        return status.summary_of(begun, {}, time.perf_counter() - started, {})
    done -= again.keys()
    notice(*pipeline.facts.notes)
    if begun is None:
        check_writable(url)
    elif is_written(begun.storage):
        notice(f"{url}: another process is writing it, too: each of the two may compute a block")

    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(display)
        child = stack.enter_context(child or Child())
        check_plugins(child, pipeline)
        timing = forecast.measure(child, pipeline)
        interrupts = stack.enter_context(Interrupts())
        executor: Executor
        if scheduler is not None or client is not None:
            from sweep.execution.on_cluster import connected  # noqa: PLC0415  (slow to import)

            executor = stack.enter_context(connected(pipeline, scheduler, client, workers))
        else:
            # Of a run in waves, blocks that are committed may be computed again.
            left = 1.0 if begun is None or pipeline.stopping else 1 - len(done) / len(begun.blocks)
            executor = stack.enter_context(Children(
                child, forecast.process_count(pipeline, timing, workers, left)))
        cut = begun.blocks if begun is not None else forecast.blocks_of(
            pipeline, timing.pose_s, executor.threads, time_limit_s)
        expected = forecast.forecast_of(
            url, pipeline, timing, cut, executor.threads, len(cut) - len(done))
        if expected.objections and not (options["yes"] or sources):
            raise errors.StoreError(
                f"{url}: the run {' and '.join(expected.objections)}; make it smaller, or confirm "
                "it with `--yes` (in Python, yes=True)")
        if begun is None:
            if overwrite and exists(url):
                lifecycle.remove_store(url)
            begun = lifecycle.create_store(url, pipeline, cut.extents)
        if stricter or again:  # once nothing refuses the run
            begun = lifecycle.reopen(begun, pipeline if stricter else None, again)
        limit_s = forecast.block_time_limit_s(time_limit_s, timing.pose_s * len(begun.blocks[0]))
        try:
            computed = compute(begun, executor, sources, limit_s, interrupts, listener)
        except (errors.RunError, errors.StoreError) as error:
            first, *others = str(error).splitlines()
            if not isinstance(error, blocks.StoreReplacedError):
                first += f"; run it again{' without overwrite' if overwrite else ''} to continue"
            raise errors.RunError("\n".join([first, *others])) from None
    return status.summary_of(
        lifecycle.open_store(url), computed, time.perf_counter() - started, again)


# Before anything is computed

#: Seconds that a plug-in may take to be made, and to search one blank frame.
PLUGIN_LIMIT_S = 60.0


def check_plugins(child: Child, pipeline: Pipeline) -> None:
    """Use a pipeline's plug-ins in a child process, which goes on to work.

    Raises
    ------
    PluginError
        If one cannot be imported or made, raises on a blank frame, ends its process, or does not
        return; in one line.
    """
    try:
        if pipeline.plugins:
            child.call(try_plugins, pipeline, limit_s=PLUGIN_LIMIT_S * len(pipeline.plugins))
    except ChildError as error:
        names = " or ".join(f"{plugin.kind} {plugin.name}" for plugin in pipeline.plugins)
        raise errors.PluginError(f"{names}: {error.line}") from None


def _store_to_continue(url: str, pipeline: Pipeline, overwrite: bool) -> RunStore | None:
    """Return the store at a URL if the run continues it, None if the run creates one."""
    if not exists(url):
        return None
    if overwrite:
        # It is deleted once everything else is known to work, just before the new one is made.
        storage = open_storage(url, "r+")
        lifecycle.read_root(url, storage)
        with changing(url, storage):
            return None
    store = lifecycle.open_store(url, "r+")
    if lines := differences(pipeline, store.pipeline, store.fingerprint):
        advice = "choose another store, or overwrite it"
        with contextlib.suppress(errors.StoreError):
            if match(pipeline, store).done:
                advice = f"`sweep run PIPELINE --store NEW --reuse {quoted(url)}` reuses its cells"
        raise errors.StoreError("\n  ".join([f"{url}: holds another experiment; {advice}", *lines]))
    return store


def _matching_sources(
    url: str, pipeline: Pipeline, reuse: Sequence[str | os.PathLike[str]]
) -> list[str]:
    """Return the addresses of the stores to reuse; StoreError if one has no cell in common."""
    sources = [absolute_url(errors.path_of("reuse", source)) for source in reuse]
    for source in sources:
        if source == absolute_url(url):
            raise errors.ArgumentError(
                "reuse", source, "it is the store that is written; choose another")
        match(pipeline, lifecycle.open_store(source))
    return sources


# The blocks, and the end


#: Failed blocks after which a run ends.
MAX_FAILED_BLOCKS = 10


def compute(
    store: RunStore, executor: Executor, sources: Sequence[str], time_limit_s: float,
    interrupts: Interrupts, listener: progress.ProgressReport | None = None,
) -> Mapping[str, int]:
    """Compute the blocks that are not committed, and close the store.

    Returns
    -------
    How many blocks, scenes, detections and estimates were computed and not reused.

    Raises
    ------
    RunError
        If blocks failed, or nothing can be computed any more.
    StoreReplacedError
        If the store was moved, deleted or replaced.
    StoreError
        If the receipt of a block that was committed before is damaged.
    """
    url, pipeline = absolute_url(store.url), store.pipeline
    computed: Counter[str] = Counter()

    def report() -> None:
        if listener is not None:
            listener(progress.Progress(
                totals.scenes, pipeline.size(Stage.scene),
                totals.detection["detected"], *(() if waves is None else (
                    totals.needed, waves.settled, waves.conditions))))

    with ThreadPoolExecutor(1) as thread, writing(store.url, store.storage):
        lifecycle.check_same_rule(store)
        # To close the store; xarray imports the second. Whoever imports a part of Dask meanwhile
        # may find it half imported, so that is waited for before xarray is used here.
        imported = thread.submit(list, map(importlib.import_module, ("xarray", "dask.array")))
        done = blocks.committed(store)
        missing = blocks.missing_chunks(store, done)
        for number, key in sorted(missing.items())[:1]:
            notice(
                f"{store.url}: {len(missing):,} committed blocks lack chunks, such as {key} of "
                f"block {number}, as in a copy that was made during a run; they are computed again")
        for number in missing:
            blocks.drop_block(store, store.blocks[number])
        done -= missing.keys()
        if pipeline.stopping is not None:  # a rule reads results with xarray
            imported.result()
        waves = None if pipeline.stopping is None else InWaves(store)
        totals = status.Totals()
        for _, receipt in blocks.receipts(store, done if waves is None else ()):
            totals.add(receipt)
        left = ((number, None) for number in range(len(store.blocks)) if number not in done)
        for wave in waves or [left]:
            if waves is not None:
                # Later blocks than one that was computed again hold if its results are as before.
                known = waves.current.values()
                totals = status.Totals(
                    sum(each.scenes for each in known), sum(each.needed for each in known),
                    Counter(detected=sum(each.detected for each in known)))
            report()
            tasks = (
                (number, (url, store.run_id, store.blocks[number], sources, time_limit_s, decision))
                for number, decision in wave)
            failed: list[Failed] = []
            with contextlib.closing(executor.map(tasks, time_limit_s, interrupts)) as results:
                for number, result in results:
                    if isinstance(result, Failed):
                        failed.append(result._replace(
                            reason=f"block {store.blocks[number]}: {result.reason}"))
                        if len(failed) >= MAX_FAILED_BLOCKS:
                            break
                        continue
                    if waves is not None:
                        waves.committed(number, result)
                    computed.update({"blocks": 1, **result.computed})
                    totals.add(result)
                    report()
            if failed:
                count = f"{store.url}: {len(failed)} blocks failed"
                if all(each.machine_fault for each in failed):
                    raise errors.RunError(f"{count}; {failed[0].reason}")
                raise errors.RunError("\n  ".join([count, *(each.reason for each in failed)]))
        imported.result()
        if not store.finished:  # by another process that wrote it, too
            status.close(store)
    return computed


# --------------------------------------------------------------------------------------------------
# A search for limits: a run along an axis, or a store that has the answer.

#: The most trials of a cell where nothing says how many.
MAX_TRIALS = 2400


@progress.taking_run_options
def limit(
    pipeline: Pipeline | Mapping[str, Any] | str | os.PathLike[str],
    *,
    require: Sequence[str] = (),
    along: str = "",
    per: Sequence[str] | None = None,
    at_all: Sequence[str] | None = None,
    max_trials: int | None = None,
    settings: Sequence[str] = (),
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[progress.RunOptions],
) -> xr.Dataset:
    """Find how far along an axis requirements are met, and return the limits.

    Trials come in waves where they decide; the store of a search is continued, or answers.

    Parameters
    ----------
    pipeline
        As `sweep.run` takes it; a store of equally many trials everywhere is analysed as it is,
        unless settings or max_trials are given.
    require
        What must hold, such as "detection >= 0.9", all together (default: those of the
        pipeline's section [require]).
    along
        The axis of the scene that is searched, such as ``distance_m``.
    per
        Axes of which each combination of values has its own limit (default: all others).
    at_all
        Axes at all of whose values the requirements must hold.
    max_trials
        The most trials of a cell (default: that of [search], else 2,400).
    settings
        "key=value" with TOML values, as ``--set`` takes them.
    store
        Path or URL of the store (default: ``runs/NAME-limit-AXIS.zarr``).
    workers, client, scheduler, reuse, overwrite, retry_failed, yes, progress, time_limit_s
        As in `sweep.run`.

    Returns
    -------
    xarray.Dataset
        As `sweep.analysis.requirement_limits`; the store is in its attributes.

    Raises
    ------
    PipelineError, ArgumentError, StoreError, RunError
        As `sweep.run`.

    Examples
    --------
    >>> limits = sweep.limit(
    ...     {"pose": {"jitter_px": 0.5}, "axes": {"side_px": [5, 40]}},
    ...     require=["detection >= 0.5"], along="side_px", max_trials=40,
    ...     store=folder / "limit.zarr",
    ... )
    >>> limits["value"].item()
    40.0
    """
    from sweep.analysis.requirements import requirement_limits  # noqa: PLC0415  (slow to import)

    errors.check_positive("max_trials", max_trials, most=MAX_VALUES)
    chosen = [*(settings := errors.texts_of("settings", settings)),
              *search_settings(require, along, per, at_all, max_trials)]
    if isinstance(pipeline, (str, os.PathLike)) and lifecycle.names_store(pipeline):
        stored = lifecycle.open_store(os.fspath(pipeline))
        stopped, trials = stored.pipeline.stopping is not None, stored.pipeline.axis(TRIAL)
        if trials is not None and not (stopped or settings or max_trials):
            lifecycle.open_finished(stored.url)
            limits = requirement_limits(
                lifecycle.open_dataset(stored.url), require or stored.pipeline.requirements, along,
                per, at_all)
            return limits.assign_attrs(store=stored.url)
        if store is None and stopped and not settings:
            store = pipeline
    try:
        read = lifecycle.read_pipeline(pipeline, chosen)
    except errors.PipelineError as error:
        if others := [fault for fault in error.faults if NO_TRIALS not in fault]:
            raise errors.PipelineError(others) from None
        chosen += search_settings(max_trials=MAX_TRIALS)
        read = lifecycle.read_pipeline(pipeline, chosen)
    searched = getattr(read.stopping, "along", "")
    if not searched:
        names = [axis.name for axis in read.axes_of(Stage.scene)
                 if axis.is_numeric and axis.name != TRIAL]
        raise errors.ArgumentError(
            "along", along, f"expected one of {', '.join(names) or 'its axes'}")
    summary = execute(read, store or f"runs/{read.name}-limit-{searched}.zarr", **options)
    notice(*summary.warnings)
    limits = requirement_limits(lifecycle.open_dataset(summary.store))
    return limits.assign_attrs(store=summary.store)
