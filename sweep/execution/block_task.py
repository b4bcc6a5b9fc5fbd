"""One block as a task of a worker: cells that other stores have are taken, the others computed."""

from __future__ import annotations

import dataclasses
import itertools
import socket
import time
from collections import ChainMap
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError, StoreError, local_fault
from sweep.evaluation.block import run_cells, warm_up
from sweep.evaluation.machine_faults import machine_faults_raised
from sweep.evaluation.results import CellsResult, processor, to_dataset_layout
from sweep.execution import TIME_LIMIT_S
from sweep.experiment.grid import Block
from sweep.experiment.parameters import Stage, lacking_plugins
from sweep.experiment.pipeline import Pipeline, file_digest
from sweep.experiment.sampling import StoppingRule
from sweep.isolation.crash_isolation import WHOLE, check_repeatable, run_cells_isolated
from sweep.isolation.watchdog import ending_after
from sweep.measure.flags import DetectionStatus, EstimateStatus, flag_counts
from sweep.sampling.rules import Decider, Decision
from sweep.store import blocks
from sweep.store.blocks import Receipt, RunStore, StoreReplacedError
from sweep.store.lifecycle import open_store
from sweep.store.locations import exists
from sweep.store.provenance import Source, both_axes, changes, fingerprint, match
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Finished cells of other stores, copied into a new one: grids grow, halves are joined.
#
# A cell is reusable if the stores match, all its parameter values agree, and nothing of it failed
# or crashed. Which cells an old store has finished follows from its receipts and flags; the old
# store is only read.

def _rows(pipeline: Pipeline, block: Block, old: Pipeline) -> dict[str, NDArray[np.intp]]:
    """Return axis of an old grid -> row along it of each cell of a block, -1 without.

    They are of shape (scenes, detector settings, estimators).
    """
    new_axes, old_axes = both_axes(pipeline, old)
    along = [range(len(axis)) for axis in new_axes]
    along[:len(block.starts)] = map(range, block.starts, block.stops)  # axes of scenes are first
    shape = len(block), pipeline.size(Stage.detection), pipeline.size(Stage.estimation)
    found = {}
    for axis in old_axes:
        # Values are looked up along those new axes alone that give them: a block has many cells.
        giving = [k for k, each in enumerate(new_axes) if axis.columns.keys() & each.columns.keys()]
        given = itertools.product(*([new_axes[k].at(i) for i in along[k]] for k in giving))
        cells = [tuple(ChainMap(*each)[name] for name in axis.columns) for each in given]
        wanted, own = set(cells), axis.values
        if isinstance(own, range):
            rows = {cell: own.index(cell[0]) for cell in wanted if cell[0] in own}
        else:
            rows = {cell: k for k, cell in enumerate(zip(*axis.columns.values(), strict=True))
                    if cell in wanted}
        lengths = [len(part) if k in giving else 1 for k, part in enumerate(along)]
        numbers = np.array([rows.get(cell, -1) for cell in cells], dtype=np.intp).reshape(lengths)
        found[axis.name] = np.broadcast_to(numbers, [*map(len, along)]).reshape(shape)
    return found


def _read(
    store: RunStore, name: str, number: int, at: Mapping[str, NDArray[np.intp]]
) -> NDArray[Any]:
    """Return a variable of some cells of an old block (cells, inner), by their indices."""
    pipeline, block = store.pipeline, store.blocks[number]
    variable = next(each for each in store.variables if each.name == name)
    starts = dict(zip(
        (axis.name for axis in pipeline.experiment.scene_axes), block.starts, strict=True))
    part = np.asarray(store.array(name)[blocks.region(variable, pipeline, block)])
    return part[tuple(
        at[name] - starts.get(name, 0) for name in variable.dimensions(pipeline) if name in at)]


#: Flags of cells that are not reused, so that the new store has the reasons of all its failures.
LOST = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed,
                 EstimateStatus.not_run, EstimateStatus.not_needed),
}


def read_cells(
    pipeline: Pipeline, block: Block, sources: Sequence[Source], cells: CellsResult
) -> tuple[Masks, set[str]]:
    """Take a block's finished cells from old stores; of several, from the first that has a cell.

    Parameters
    ----------
    pipeline, block
        The block of the new grid.
    sources
        The old stores.
    cells
        Results of the block's N scenes, which are filled.

    Returns
    -------
    (N, detector settings, estimators) the cells that need not be computed; features of the
    processors that computed the blocks which cells come from.
    """
    experiment, processors = pipeline.experiment, set[str]()
    shape = len(block), pipeline.size(Stage.detection), pipeline.size(Stage.estimation)
    available = np.zeros(shape, dtype=bool)
    drawn = experiment.scene_values(block.indices()) if sources else {}
    for store, done in sources:
        at = _rows(pipeline, block, store.pipeline)
        wanted = ~available & np.all([rows >= 0 for rows in at.values()], axis=0)
        old, numbers = store.blocks, np.zeros(shape, dtype=np.intp)
        for axis, extent, count in zip(
            store.pipeline.experiment.scene_axes, old.extents, old.counts, strict=True
        ):
            numbers = numbers * count + at[axis.name] // extent
        taken = set[int]()
        for number in done & {*np.unique(numbers[wanted]).tolist()}:
            inside = wanted & (numbers == number)
            # A cell is finished if its flags say that it was run. With a configuration of a scene
            # (or of a detection), what it shares is copied.
            where = {name: index[inside] for name, index in at.items()}
            ended = ~np.any([
                np.isin(_read(store, name, number, where), lost) for name, lost in LOST.items()],
                axis=0)
            inside[inside] = ended
            scene, setting, estimator = np.nonzero(inside)
            if not len(scene):
                continue
            column = {Stage.scene: 0 * scene, Stage.detection: setting,
                      Stage.estimation: setting * shape[2] + estimator}
            where = {name: index[ended] for name, index in where.items()}
            for v in experiment.variables:
                # Draws follow from the parameters alone; the old store may have had them fixed.
                values = drawn[v.drawn_as].broadcast(len(block))[scene] if v.drawn_as else (
                    v.fitted(_read(store, v.name, number, where)))
                cells.columns[v.name][column[v.stage], scene] = values
            available |= inside
            taken.add(number)
        for _, receipt in blocks.receipts(store, taken):
            processors.update(receipt.processors)
    return available, processors


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
    return [
        *(f"{name} is {own}, the run began with {value}" for name, value, own in changes(
            begun, fingerprint(pipeline))),
        *lacking_plugins(pipeline.plugins, pipeline.folder),
        # The content of a camera file is in the pipeline's text.
        *(f"{path} is not in {pipeline.folder} as it was when the run began"
          for path in sorted(begun["files"].keys() & {*pipeline.values_of("background")})
          if file_digest(Path(pipeline.folder) / path) != begun["files"][path]),
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
    basis = None if decision is None else decision.basis
    try:
        with machine_faults_raised():
            store = _opened(url, run_id)
            before = blocks.receipt_of(store, block)
            if before is not None and basis in (None, before.basis):
                return before  # another process may write the store, too
            needed = np.ones(len(block), dtype=bool) if decision is None else (
                _decider(url, run_id, decision.rule).needed(block, decision))
            sources = [_source(url, run_id, old) for old in reuse]
            if before is not None:
                sources.insert(0, Source(store, {store.blocks.number(block)}))
            begun_before = blocks.begin_block(store, block)
            try:
                start = time.perf_counter()
                values, receipt = _computed(
                    store, block, needed, sources, time_limit_s, before, isolated=begun_before)
                receipt = blocks.write_block(store, block, values, dataclasses.replace(
                    receipt, wall_s=time.perf_counter() - start, written=time.time(), basis=basis))
            except Exception:
                if not begun_before:  # it did not end this process
                    blocks.withdraw_block(store, block)
                raise
    except StoreReplacedError:
        raise
    except StoreError as error:  # one that this machine cannot use
        raise local_fault(str(error).removeprefix(f"{url}: ")) from None
    return dataclasses.replace(receipt, failures=())


def _computed(
    store: RunStore, block: Block, needed: Masks, sources: Sequence[Source],
    time_limit_s: float, before: Receipt | None, *, isolated: bool,
) -> tuple[dict[str, NDArray[Any]], Receipt]:
    """Return the values of a block's ``needed`` scenes (N,), and what a receipt tells of them.

    Cells that a source has are taken from it, the others are computed: in this process, or in a
    child if that was tried or the block raises. Seconds count from those of the receipt ``before``.
    """
    pipeline, experiment = store.pipeline, store.pipeline.experiment
    cells = CellsResult.not_run(experiment, len(block))
    if before is not None:
        cells.seconds = {stage: [*spent] for stage, spent in before.seconds.items()}
    available, processors = read_cells(
        pipeline, block, sources if needed.any() else (), cells)
    need = needed[:, None, None] & ~available
    # Scenes of which every cell is reused are not rendered.
    rows = np.flatnonzero(need.any(axis=(1, 2)))
    if len(rows):
        indices, some = block.indices(rows), need[rows]
        if not isolated:
            try:
                with ending_after(WHOLE * time_limit_s):
                    part = run_cells(experiment, indices, some)
            except MachineFaultError:
                raise
            except Exception:
                isolated = True  # it raises as a whole, as single scenes may
        if isolated:
            part = run_cells_isolated(pipeline, indices, some, time_limit_s)
        # What raises is a result only if it raises again in another process.
        check_repeatable(pipeline, indices, some, part, time_limit_s)
        cells.take(experiment, part, rows)
        processors.add(processor())
    for v in experiment.variables:
        cells.columns[v.name][:, ~needed] = v.not_needed
    values = {v.name: to_dataset_layout(v, pipeline, block, cells.columns[v.name])
              for v in experiment.variables}
    return values, Receipt(
        run_id=store.run_id,
        processors=tuple(sorted(processors)),
        scenes=len(block),
        computed={"scenes": len(rows), "detections": int(need.any(axis=2).sum()),
                  "estimates": int(need.sum())},
        detection=flag_counts(DetectionStatus, values["detection"]),
        estimate=flag_counts(EstimateStatus, values["estimate"]),
        seconds=cells.seconds,
        failures=blocks.recorded(pipeline, block, cells.failures),
    )
