"""One block as a task of a worker: cells that other stores have are taken, the others computed."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import socket
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.errors import MachineFaultError, StoreError, StoreReplacedError
from sweep.evaluation.block import run_cells, warm_up
from sweep.evaluation.machine_faults import local_fault, machine_faults_raised
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution import TIME_LIMIT_S
from sweep.experiment.grid import TRIAL, Axis, Block
from sweep.experiment.parameters import Stage, lacking_plugins
from sweep.experiment.pipeline import Pipeline, file_digest
from sweep.experiment.sampling import StoppingRule
from sweep.experiment.schema import Variable
from sweep.isolation.crash_isolation import WHOLE, check_repeatable, run_cells_isolated
from sweep.isolation.watchdog import ending_after
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.processor import processor
from sweep.sampling.rules import Decider, Decision
from sweep.store.blocks import (
    Receipt,
    RunStore,
    begin_block,
    check_whole,
    receipt_of,
    receipts,
    recorded,
    region,
    withdraw_block,
    write_block,
)
from sweep.store.lifecycle import open_store
from sweep.store.locations import exists
from sweep.store.provenance import changes, differences, fingerprint
from sweep.typing import Masks

# --------------------------------------------------------------------------------------------------
# Where the cells of a new grid lie in an old one: cells agree where all parameter values do.
#
# Whether a parameter is fixed, an axis of its own, or goes together with others does not matter:
# a cell of the new grid gives every parameter a value, and these are looked up in the old grid.

class Key(NamedTuple):
    """Parameters that are looked up together, and what finds a row of their values.

    Those of an ``axis`` of the old grid: the index along it, None if it has no such row. Or one
    that the old grid keeps fixed: 0 if it is the same. ``new`` are the new grid's axes that have
    any of them, and ``fixed`` the values of the others there.
    """

    axis: str | None
    parameters: tuple[str, ...]
    find: Callable[[tuple[Any, ...]], int | None]
    new: tuple[Axis, ...]
    fixed: Mapping[str, Any]

    def found(self, along: Sequence[range]) -> Iterator[int | None]:
        """Yield the matching cell for each combination of indices along the new axes, in order."""
        for chosen in itertools.product(*along):
            values = dict(self.fixed)
            for axis, index in zip(self.new, chosen, strict=True):
                values |= axis.at(index)
            yield self.find(tuple(values[name] for name in self.parameters))


def fixed_value(pipeline: Pipeline, name: str) -> Any:
    """Return a fixed parameter's value; of ``trial`` the first."""
    return 0 if name == TRIAL else pipeline.fixed.get(name)


def _row_finder(axis: Axis) -> Callable[[tuple[Any, ...]], int | None]:
    first, *others = axis.columns.values()
    if isinstance(first, range) and not others:  # of trials, which may be many
        return lambda row: first.index(row[0]) if row[0] in first else None
    return {row: k for k, row in enumerate(zip(first, *others, strict=True))}.get


@dataclass(frozen=True, slots=True)
class Source:
    """An old store, and how the cells of a new grid are found in it.

    Attributes
    ----------
    store
        The old store.
    new
        The new grid.
    done
        Numbers of the old store's committed blocks.
    keys
        Values that are looked up for each cell.
    """

    store: RunStore
    new: Pipeline
    done: frozenset[int]
    keys: tuple[Key, ...]

    @staticmethod
    def of(new: Pipeline, store: RunStore, done: frozenset[int]) -> Source:
        """Return how the cells of a new grid are found in a store."""
        old = store.pipeline
        owned = {name for axis in old.axes for name in axis.columns}
        looked_up: list[tuple[str | None, tuple[str, ...], Callable[..., int | None]]] = [
            *((axis.name, tuple(axis.columns), _row_finder(axis)) for axis in old.axes),
            *((None, (name,), {(fixed_value(old, name),): 0}.get)
              for axis in new.axes for name in axis.columns if name not in owned),
        ]
        return Source(store, new, done, tuple(
            Key(axis, names, find,
                tuple(sorted(new.axes_with(names), key=lambda each: each.stage)),
                {name: fixed_value(new, name) for name in names})
            for axis, names, find in looked_up))

    def located(
        self, order: Sequence[str], cuts: Mapping[str, range]
    ) -> tuple[Masks, dict[str, NDArray[np.intp]]]:
        """Return which cells of a box of the new grid the old one has, and where.

        Parameters
        ----------
        order
            The new grid's axes, stage by stage, along which the results' dimensions are.
        cuts
            The box: axis -> indices.

        Returns
        -------
        Whether the old grid has a cell; old axis -> index along it.
        """
        shape = tuple(len(cuts[name]) for name in order)
        exists = np.ones(shape, dtype=bool)
        indices: dict[str, NDArray[np.intp]] = {}
        for key in self.keys:
            names = [axis.name for axis in key.new]
            at = [-1 if k is None else k for k in key.found([cuts[name] for name in names])]
            spread = np.array(at).reshape([len(cuts[name]) if name in names else 1
                                           for name in order])
            exists &= spread >= 0
            if key.axis is not None:
                indices[key.axis] = np.broadcast_to(spread, shape)
        return exists, indices

    def read(
        self, variable: Variable, number: int, at: Mapping[str, NDArray[np.intp]]
    ) -> NDArray[Any]:
        """Return a variable of some cells of an old block (cells, inner), by their indices."""
        pipeline, block = self.store.pipeline, self.store.blocks[number]
        old = next(each for each in self.store.variables if each.name == variable.name)
        starts = dict(zip(
            (axis.name for axis in pipeline.experiment.scene_axes), block.starts, strict=True))
        part = np.asarray(self.store.array(variable.name)[region(old, pipeline, block)])
        return variable.fitted(part[tuple(
            at[name] - starts.get(name, 0) for name in old.dimensions(pipeline) if name in at)])


# --------------------------------------------------------------------------------------------------
# Finished cells of other stores, copied into a new one: grids grow, halves are joined.
#
# A cell is reusable if the fingerprint and all its parameter values agree, and nothing of it
# failed or crashed. Which cells an old store has finished follows from its receipts and flags;
# the old store is only read.

#: Flags of cells that are not reused, so that the new store has the reasons of all its failures.
LOST = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed),
}


def match(pipeline: Pipeline, store: RunStore) -> Source:
    """Match a new grid to an old store's.

    Raises
    ------
    StoreError
        If no cell is reusable: another fingerprint, or parameters that never agree; or if chunks
        of committed blocks are missing.
    """
    old = store.pipeline
    mine, theirs = fingerprint(pipeline), store.fingerprint
    # A file that only one of them refers to is a value that only one of them has.
    for part in ("files", "plugins"):  # as of a plug-in
        shared = mine.get(part, {}).keys() & theirs.get(part, {}).keys()
        for stamp in (mine, theirs):
            stamp[part] = {name: stamp[part][name] for name in sorted(shared)}
    present = {variable.name for variable in store.variables}
    lacking = [variable.name for variable in pipeline.experiment.variables
               if variable.name not in present and not variable.drawn_as]
    source = Source.of(pipeline, store, frozenset(check_whole(store)))
    agree = (
        not any(changes(theirs, mine)) and pipeline.distributions == old.distributions
        and all(pipeline.fixed[name] == old.fixed[name]
                for name in pipeline.fixed.keys() & old.fixed.keys())
        # What several new axes give is looked up cell by cell.
        and all(len(key.new) > 1 or any(
            index is not None for index in key.found([range(len(axis)) for axis in key.new]))
            for key in source.keys)
    )
    if lacking or not agree:
        lines = [f"{name}: not a variable of the store" for name in lacking]
        lines += differences(pipeline, old, store.fingerprint)
        raise StoreError("\n  ".join([f"{store.url}: no cell of it can be reused", *lines]))
    return source


def is_reusable(pipeline: Pipeline, store: RunStore) -> bool:
    """Return whether a new grid could reuse cells of a store that have been computed."""
    try:
        return bool(match(pipeline, store).done)
    except StoreError:
        return False


@dataclass(slots=True)
class ReusedCells:
    """The cells of a block that old stores have.

    Attributes
    ----------
    values
        Variable -> values in the dataset's dimensions; fill values in cells that are missing.
    available
        (N, detector settings, estimators): the cells that need not be computed.
    processors
        Features of the processors that computed the blocks which cells come from.
    """

    values: dict[str, NDArray[Any]]
    available: NDArray[np.bool_]
    processors: set[str]


def read_cells(pipeline: Pipeline, block: Block, sources: Sequence[Source]) -> ReusedCells:
    """Read a block's reusable cells from old stores; of several, the first that has a cell."""
    settings = [*pipeline.axes_of(Stage.detection), *pipeline.axes_of(Stage.estimation)]
    # The last axis stands in for a grid without any.
    order = [*(axis.name for axis in (*pipeline.experiment.scene_axes, *settings)), ""]
    parts = [range(*cut) for cut in zip(block.starts, block.stops, strict=True)]
    parts += [*(range(len(axis)) for axis in settings), range(1)]
    cuts = dict(zip(order, parts, strict=True))
    variables = pipeline.experiment.variables
    values = {
        v.name: np.full(
            [len(cuts[n]) for n in v.dimensions(pipeline) if n in cuts] + list(v.inner_shape),
            v.fill, dtype=v.dtype,
        )
        for v in variables
    }
    available = np.zeros([len(part) for part in parts], dtype=bool)
    processors: set[str] = set()
    for source in sources:
        exists, at = source.located(order, cuts)
        blocks, numbers = source.store.blocks, np.zeros(exists.shape, dtype=np.intp)
        for axis, extent, count in zip(
            source.store.pipeline.experiment.scene_axes, blocks.extents, blocks.counts, strict=True
        ):
            numbers = numbers * count + at[axis.name] // extent
        present = {variable.name for variable in source.store.variables}
        taken = np.zeros_like(available)
        wanted = exists & ~available
        for number in source.done.intersection(np.unique(numbers[wanted]).tolist()):
            cells = np.nonzero(wanted & (numbers == number))
            inside = {name: index[cells] for name, index in at.items()}
            flags = {v.name: source.read(v, number, inside) for v in variables if v.name in LOST}
            # A cell is finished if its flags say that it was run. With a configuration of a scene
            # (or of a detection), what it shares is copied.
            ended = ~np.isin(flags["estimate"], (EstimateStatus.not_run, EstimateStatus.not_needed))
            for name, lost in LOST.items():
                ended &= ~np.isin(flags[name], lost)
            inside = {name: index[ended] for name, index in inside.items()}
            finished = tuple(index[ended] for index in cells)
            taken[finished] = True
            for variable in variables if ended.any() else ():
                if variable.name in present:
                    target = tuple(finished[order.index(name)]
                                   for name in variable.dimensions(pipeline) if name in order)
                    values[variable.name][target] = source.read(variable, number, inside)
        lacking = [variable for variable in variables if variable.name not in present]
        rows = np.flatnonzero(taken.reshape(len(block), -1).any(axis=1))
        if lacking and len(rows):  # what follows from the parameters alone
            indices = [index[rows] for index in block.indices()]
            drawn = pipeline.experiment.scene_values(indices)
            for v in lacking:
                values[v.name].reshape(-1)[rows] = drawn[v.drawn_as].broadcast(len(rows))
        used = np.unique(numbers[taken]).tolist()
        for _, receipt in receipts(source.store, used):
            processors.update(receipt.processors)
        available |= taken
    searches = pipeline.size(Stage.detection)
    return ReusedCells(values, available.reshape(len(block), searches, -1), processors)


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
            begun, fingerprint(pipeline))),
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
