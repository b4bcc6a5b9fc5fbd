"""One block as a task: computed and committed by a worker."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError, StoreError, StoreReplacedError
from sweep.evaluation.block import run_cells, warm_up
from sweep.evaluation.machine_faults import local_fault, machine_faults_raised
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution import TIME_LIMIT_S
from sweep.execution.reuse import ReusedCells, Source, match, read_cells
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage, lacking_plugins
from sweep.experiment.pipeline import Pipeline, file_digest
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import Variable
from sweep.isolation.crash_isolation import WHOLE, check_repeatable, run_cells_isolated
from sweep.isolation.watchdog import ending_after
from sweep.processor import processor
from sweep.sampling.rules import Decider, Decision
from sweep.store.blocks import (
    Receipt,
    RunStore,
    begin_block,
    receipt_of,
    recorded,
    withdraw_block,
    write_block,
)
from sweep.store.lifecycle import open_store
from sweep.store.locations import exists
from sweep.store.provenance import changes, fingerprint

# --------------------------------------------------------------------------------------------------
# The task of a worker: compute one block, write it, and return its receipt.

def other_here(pipeline: Pipeline, begun: Mapping[str, Any]) -> list[str]:
    """Return where this process differs from the run's start: versions, plug-ins, files.

    Parameters
    ----------
    pipeline
        The experiment.
    begun
        The fingerprint of the process that began.
    """
    # The content of a camera file is in the pipeline's text.
    images = pipeline.values_of("background")
    return [
        *(f"{name} is {own}, the run began with {value}" for name, value, own in changes(
            {"builds": {}, **begun}, fingerprint(pipeline))),
        *lacking_plugins(pipeline.plugins, pipeline.folder),
        *(f"{path} is not in {pipeline.folder} as it was when the run began"
          for path, digest in begun["files"].items()
          if path in images and file_digest(Path(pipeline.folder) / path) != digest),
    ]


@lru_cache(maxsize=4)
def _opened(url: str, run_id: str) -> RunStore:
    """Open a store once in each process; check that this process computes the same numbers.

    The compiled code that its blocks need is loaded, by computing a scene of known pose.

    Raises
    ------
    StoreReplacedError
        If the store was replaced.
    StoreError
        If this machine cannot read it, or has other versions or files.
    MachineFaultError
        If this machine cannot compute a scene of known pose.
    """
    if not exists(url):
        raise StoreError(
            f"{url}: not found on {socket.gethostname()} by a worker; every machine needs the "
            "store under this path, or choose an s3:// URL"
        )
    store = open_store(url, "r+")
    if store.run_id != run_id:
        raise StoreReplacedError(f"{url}: replaced by another run while this one was going on")
    if lines := other_here(store.pipeline, store.fingerprint):
        raise StoreError(f"on a worker {lines[0]}; every machine needs the same")
    warm_up(store.pipeline)
    return store


@lru_cache(maxsize=16)
def _source(url: str, run_id: str, old: str) -> Source:
    """Match an old store to the new grid once in each process."""
    return match(_opened(url, run_id).pipeline, open_store(old))


@lru_cache(maxsize=2)
def _decider(url: str, run_id: str, rule: StoppingRule) -> Decider:
    """Make the rule by which sampling of a store stops once in each process."""
    return Decider.of(_opened(url, run_id), rule)


def compute_blocks(
    url: str, run_id: str, blocks: Sequence[Block], decision: Decision | None,
    reuse: Sequence[str] = (), time_limit_s: float = TIME_LIMIT_S,
) -> list[Receipt]:
    """Compute blocks one after another as :func:`compute_block` does.

    Their receipts are returned without the failures, which the store has.
    """
    return [
        dataclasses.replace(
            compute_block(url, run_id, block, reuse, time_limit_s, decision), failures=())
        for block in blocks
    ]


@contextlib.contextmanager
def _local_faults(url: str) -> Iterator[None]:
    """Raise MachineFaultError for a store that this machine cannot use."""
    try:
        with machine_faults_raised():
            yield
    except StoreReplacedError:
        raise
    except StoreError as error:
        raise local_fault(str(error).removeprefix(f"{url}: ")) from None


def compute_block(
    url: str, run_id: str, block: Block, reuse: Sequence[str] = (),
    time_limit_s: float = TIME_LIMIT_S, decision: Decision | None = None,
) -> Receipt:
    """Compute, write and commit one block; return its receipt, also if it is run twice.

    A block that was begun before and not committed may have ended its process: it is computed in a
    child process, where the scenes that crash or never return are isolated.

    Parameters
    ----------
    url, run_id
        The store, and the run that it must still belong to.
    block
        What to compute.
    reuse
        Stores whose finished cells are read instead of computed.
    time_limit_s
        Block timeout in seconds.
    decision
        Inputs that determine the needed scenes; all scenes are needed without one. A block that is
        committed on another basis is computed again, its computed scenes taken from itself.

    Raises
    ------
    StoreReplacedError
        If the store was replaced.
    MachineFaultError
        If this machine cannot compute the block, or cannot read or write the store; nothing of the
        block is committed. Another machine may be able to.
    """
    with _local_faults(url):
        store = _opened(url, run_id)
        needed, before = np.ones(len(block), dtype=bool), receipt_of(store, block)
        if before is not None and (decision is None or before.basis == decision.basis):
            return before  # another process may write the store, too
        if decision is not None:
            needed = _decider(url, run_id, decision.rule).needed(block, decision)
        sources = [_source(url, run_id, old) for old in reuse]
        if before is not None:
            done = frozenset([store.blocks.number(block)])
            sources.insert(0, Source.of(store.pipeline, store, done))
        begun_before = begin_block(store, block)
        try:
            start = time.perf_counter()
            values, receipt = _computed(
                store, block, needed, sources, time_limit_s, isolated=begun_before)
            seconds = receipt.seconds if before is None else {
                stage: [sum(both) for both in itertools.zip_longest(
                    before.seconds[stage], spent, fillvalue=0.0)]
                for stage, spent in receipt.seconds.items()
            }
            return write_block(store, block, values, dataclasses.replace(
                receipt, seconds=seconds, wall_s=time.perf_counter() - start, written=time.time(),
                basis=None if decision is None else decision.basis))
        except Exception:
            if not begun_before:  # it did not end this process
                withdraw_block(store, block)
            raise


def _computed(
    store: RunStore, block: Block, needed: NDArray[np.bool_], sources: Sequence[Source],
    time_limit_s: float, *, isolated: bool,
) -> tuple[dict[str, NDArray[Any]], Receipt]:
    """Return the values of a block's ``needed`` scenes (N,), and what a receipt tells of them.

    Cells that a source has are taken from it, the others are computed.
    """
    pipeline = store.pipeline
    shape = (len(block), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
    need = np.broadcast_to(needed[:, None, None], shape).copy()
    reused = read_cells(pipeline, block, sources) if sources and need.any() else None
    processors: set[str] = set() if reused is None else reused.processors
    if reused is not None:
        need &= ~reused.available.reshape(shape)
    # Scenes of which every cell is reused are not rendered.
    rows = np.flatnonzero(need.any(axis=(1, 2)))
    cells = CellsResult.not_run(pipeline.experiment, len(block))
    seconds: dict[str, list[float]] = {stage: [] for stage in cells.seconds}
    if len(rows):
        indices = [index[rows] for index in block.indices()]
        some = _compute(pipeline, indices, need[rows], time_limit_s, isolated=isolated)
        for name, columns in some.columns.items():
            cells.columns[name][:, rows] = columns
        seconds, cells.failures = some.seconds, some.failures
        processors.add(processor())
    values = {v.name: to_dataset_layout(v, pipeline, block, cells.columns[v.name])
              for v in store.variables}
    if reused is not None:
        values = {v.name: _merged(v, values, reused) for v in store.variables}
    lengths = dict(zip(
        (axis.name for axis in pipeline.experiment.scene_axes), block.shape, strict=True))
    for v in store.variables:
        mask = needed.reshape([lengths.get(name, 1) for name in v.dimensions(pipeline)])
        values[v.name] = np.where(mask, values[v.name], v.not_needed).astype(v.dtype)
    return values, Receipt(
        run_id=store.run_id,
        processors=tuple(sorted(processors)),
        scenes=len(block),
        computed={"scenes": len(rows), "detections": int(need.any(axis=2).sum()),
                  "estimates": int(need.sum())},
        detection=np.bincount(values["detection"].ravel()).tolist(),
        estimate=np.bincount(values["estimate"].ravel()).tolist(),
        seconds=seconds,
        failures=recorded(pipeline, block, cells.failures, rows.tolist()),
    )


def _compute(
    pipeline: Pipeline, indices: Sequence[NDArray[np.intp]], need: NDArray[np.bool_],
    time_limit_s: float, *, isolated: bool,
) -> CellsResult:
    """Compute cells in this process, or in a child if that was tried or the block raises.

    What raises is a result only if it raises again in another process.
    """
    cells = None
    if not isolated:
        try:
            with ending_after(WHOLE * time_limit_s):
                cells = run_cells(pipeline.experiment, indices, need)
        except MachineFaultError:
            raise
        except Exception:
            cells = None  # it raises as a whole, as single scenes may
    if cells is None:
        cells = run_cells_isolated(pipeline, indices, need, time_limit_s)
    check_repeatable(pipeline, indices, need, cells, time_limit_s)
    return cells


def _merged(
    variable: Variable, computed: dict[str, NDArray[Any]], reused: ReusedCells
) -> NDArray[Any]:
    """Return a variable with the reused values in the cells that were not computed.

    A cell is computed or reused as a whole, as the flag of the variable's stage says.
    """
    new, old = computed[variable.name], reused.values[variable.name]
    flag = {Stage.detection: "detection", Stage.estimation: "estimate"}.get(variable.stage)
    if flag is None:
        missing = new == variable.fill if variable.flags is not None else np.isnan(new)
    else:
        missing = computed[flag] == 0
        missing = missing.reshape(missing.shape + (1,) * (new.ndim - missing.ndim))
    return np.where(missing, old, new).astype(variable.dtype)
