"""Cells recomputed and compared with the stored ones, within the tolerances of the processor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError, SweepError
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution.limits import TIME_LIMIT_S
from sweep.experiment.cell_selection import selection_text
from sweep.experiment.grid import Block, detector_settings, estimators, scene_axes
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import SCHEMA, VARIABLES, Tolerance, Variable
from sweep.isolation.child_process import OUTSIDE_SIGNALS
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.detectors import OPENCV
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.pose import rotation_of_vector
from sweep.plugins.declared import PluginSetting
from sweep.processor import processor
from sweep.sampling.rules import by_scene, scenes_needed
from sweep.store.blocks import RunStore, committed, missing_chunks, receipts, region
from sweep.store.provenance import differences
from sweep.store.receipt import Receipt

# --------------------------------------------------------------------------------------------------
# What a verification finds, in one record that each check adds to.

Kind = Literal["file", "array", "block", "scene", "sample", "not deterministic"]


@dataclass(frozen=True, slots=True)
class Damage:
    """What is damaged.

    Attributes
    ----------
    kind
        "file" (missing, changed or unreadable), "array" (missing, foreign, or of another schema),
        "block" (its flags and numbers contradict each other), "scene" (it gives other values when
        it is recomputed), "sample" (too many scenes of another processor differ), or "not
        deterministic" (a part whose answers change from call to call).
    where
        A key, a path, a block's name, a scene as ``sweep repro`` takes it, or the part's name.
    what
        What is wrong.
    block
        Number of the block that is damaged, None if none is.
    """

    kind: Kind
    where: str
    what: str
    block: int | None = None

    @property
    def lasting(self) -> bool:
        """Whether recomputing blocks does not repair it."""
        return self.kind in ("sample", "not deterministic")

    def to_json(self) -> dict[str, Any]:
        """Return it as ``sweep verify --json`` prints it.

        >>> Damage("file", "detection/c/0/0", "missing", 0).to_json()
        {'where': 'detection/c/0/0', 'what': 'missing', 'block': 0}
        """
        return {"where": self.where, "what": self.what, "block": self.block}


@dataclass(slots=True)
class IntegrityReport:
    """The result of a verification.

    Attributes
    ----------
    store
        The store's URL.
    finished
        Whether the store is finished.
    blocks, blocks_done
        Blocks of the grid, and how many are committed.
    files, bytes
        Stored files that belong to the store, and their size.
    sampled
        Scenes that were recomputed.
    not_sampled
        Why none was, if none was.
    retried
        Scenes flagged ``failed``, or ended by a signal from outside, that were recomputed.
    damage
        What is damaged; empty for a sound store.
    repaired
        What was damaged and has been repaired.
    left_over
        Files that do not belong to the store, such as those that a killed process was writing.
    processors
        Features of the processors that computed the blocks -> how many blocks.
    """

    store: str
    finished: bool
    blocks: int
    blocks_done: int
    files: int = 0
    bytes: int = 0
    sampled: int = 0
    not_sampled: str = ""
    retried: int = 0
    damage: list[Damage] = field(default_factory=list)
    repaired: list[Damage] = field(default_factory=list)
    left_over: list[str] = field(default_factory=list)
    processors: dict[str, int] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return the report as ``sweep verify --json`` prints it."""
        told = {each.name: getattr(self, each.name) for each in fields(self)}
        damage = ("damage", "repaired")
        return told | {name: [each.to_json() for each in told[name]] for name in damage}


@dataclass(frozen=True, slots=True)
class SoundBlock:
    """What is kept of the receipt of a block without damage.

    Attributes
    ----------
    processors
        Features of the processors that computed it.
    needed
        How many of its scenes were needed.
    doubtful
        Whether scenes failed, or were ended by a signal from outside.
    """

    processors: tuple[str, ...]
    needed: int
    doubtful: bool


# --------------------------------------------------------------------------------------------------
# Values as a store holds them, and the pipeline with which they are recomputed.

StoredValues = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class StoredCell:
    """A cell of a store.

    Attributes
    ----------
    values
        Variable -> its value, of the dimensions that are no axes.
    same_processor
        Whether it was computed on a processor with the features of this one.
    """

    values: StoredValues
    same_processor: bool


def stored_cell(store: RunStore, index: Mapping[str, int]) -> StoredCell | None:
    """Return the cell at an index along each axis; None if its block is not committed.

    Raises
    ------
    StoreError
        If its receipt is damaged, or a chunk of it is missing.
    """
    corner = tuple(index[axis.name] for axis in scene_axes(store.pipeline))
    number = store.blocks.number(Block(corner, corner))
    if number not in committed(store):
        return None
    _, receipt = next(iter(receipts(store, [number])))
    for key in missing_chunks(store, [number]).values():
        raise StoreError(
            f"{store.url}: damaged: {key} is missing; `sweep verify --repair` repairs it")
    values = {}
    for variable in store.variables:
        part = tuple(
            index.get(name, slice(None)) for name in variable.dimensions(store.pipeline)
        )
        values[variable.name] = np.asarray(store.array(variable.name)[part])
    return StoredCell(values, tuple(receipt.processors) == (processor(),))


def stored_scene(store: RunStore, number: int, scene: int) -> StoredValues:
    """Return a scene of a block with all its configurations; its scene axes have length 1."""
    index = store.blocks[number].cell(scene)
    block = Block(index, tuple(k + 1 for k in index))
    return {
        variable.name: np.asarray(
            store.array(variable.name)[region(variable, store.pipeline, block)]
        )
        for variable in store.variables
    }


def current_pipeline(store: RunStore) -> tuple[Pipeline, list[str]]:
    """Return a store's pipeline with the files and versions of this machine, and what changed.

    Raises
    ------
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    stored = store.pipeline
    pipeline = Pipeline.from_text(
        stored.text, name=stored.name, source=store.url, folder=stored.folder,
        camera_files=stored.files,
    )
    return pipeline, differences(pipeline, stored, store.fingerprint)


def computable(store: RunStore) -> Pipeline:
    """Return a store's pipeline, to be computed on this machine.

    Raises
    ------
    StoreError
        If it would give other numbers.
    PipelineError
        If it cannot be computed at all, for want of a file, say.
    """
    pipeline, changes = current_pipeline(store)
    if changes:
        raise StoreError("\n".join(
            [f"{store.url}: cannot be recomputed on this machine:", *changes]
        ))
    return pipeline


# --------------------------------------------------------------------------------------------------
# Whether a recomputed scene agrees with the stored one.
#
# On a processor with the same features every bit agrees. On another one, OpenCV, NumPy and the
# mathematical library take other routines, and last bits differ; how far is the ``tolerance`` of
# each variable in :mod:`sweep.experiment.schema`, measured on 9,000 scenes with AVX-512, AVX2 and
# all of AVX switched off in turn. Without AVX, 0.02 % of ordinary scenes, and at most 4.4 %
# of those of a pipeline of extremes, lie outside them, because a last bit can decide between two
# minima.

Values = Mapping[str, NDArray[Any]]
"""Variable -> values of one scene, of its inner dimensions last."""

MAX_OUTSIDE = 0.1
"""Largest share of the scenes recomputed on another processor that may lie outside."""

MIN_OUTSIDE = 2
"""That many scenes may lie outside however few were recomputed."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """How a recomputed scene differs from the stored one; texts are empty if it does not.

    Attributes
    ----------
    departure
        The first variable that differs in a way in which no scene may: by a bit on a processor
        with the same features, beyond the tolerance of the truth or the bound on another one.
    outside
        The first variable of detection or estimation outside its tolerance: few scenes of another
        processor may.
    """

    departure: str = ""
    outside: str = ""

    @property
    def difference(self) -> str:
        """The departure, or else what lies outside."""
        return self.departure or self.outside


def compare(
    recomputed: Values, stored: Values, variables: Sequence[Variable] = SCHEMA, *,
    same_processor: bool,
) -> Comparison:
    """Compare a recomputed scene with the stored one, in the variables that both have.

    Parameters
    ----------
    recomputed, stored
        The values by variable, of the same shapes. A tolerance of the kind "distance" needs
        ``true_tvec_m`` among the stored ones.
    variables
        Those that are compared, in this order.
    same_processor
        Whether both were computed by the same versions on processors with the same features, so
        that every bit must agree.

    Examples
    --------
    >>> stored = {"reprojection_error_px": np.array([0.2], dtype="f4")}
    >>> recomputed = {"reprojection_error_px": np.array([0.201], dtype="f4")}
    >>> compare(recomputed, stored, same_processor=False).difference
    ''
    >>> compare(recomputed, stored, same_processor=True).difference
    'reprojection_error_px 0.201000005, stored 0.200000003'
    """
    outside = ""
    for variable in variables:
        if variable.name not in recomputed or variable.name not in stored:
            continue
        ours, theirs = recomputed[variable.name], stored[variable.name]
        if same_processor:
            differ = ~_same(ours, theirs)
        elif variable.tolerance is None:
            continue
        else:
            distance = np.linalg.norm(stored["true_tvec_m"]) if "true_tvec_m" in stored else 0.0
            differ = _beyond(variable.tolerance, ours, theirs, float(distance))
        if not differ.any():
            continue
        text = f"{variable.name} {ours[differ][0]:.9g}, stored {theirs[differ][0]:.9g}"
        if same_processor or variable.stage is Stage.scene:
            return Comparison(departure=text)
        outside = outside or text
    return Comparison(outside=outside)


def _same(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where two arrays are equal or both NaN; also of integers."""
    return np.asarray((a == b) | ((a != a) & (b != b)))  # noqa: PLR0124  (NaN)


def _beyond(
    tolerance: Tolerance, recomputed: NDArray[Any], stored: NDArray[Any], distance_m: float
) -> NDArray[np.bool_]:
    """Return where recomputed values lie outside a tolerance, of the arrays' shape."""
    same = _same(recomputed, stored)
    if tolerance.kind == "equal":
        return ~same
    a, b = recomputed.astype(np.float64), stored.astype(np.float64)
    if tolerance.kind == "rotation":
        # The norm of the difference of two rotations is sqrt(8) times the sine of half their angle.
        turned = [rotation_of_vector(vector.reshape(-1, 3)) for vector in (a, b)]
        angle = np.linalg.norm(turned[0] - turned[1], axis=(1, 2)) / np.sqrt(2)
        within = (angle <= tolerance.limit).reshape(a.shape[:-1])[..., None]
    elif tolerance.kind == "distance":
        within = np.linalg.norm(a - b, axis=-1, keepdims=True) <= tolerance.limit * distance_m
    elif tolerance.kind == "length":
        length = np.linalg.norm(b, axis=-1, keepdims=True)
        within = np.abs(a - b) <= tolerance.limit * length
    elif tolerance.kind == "relative":
        within = np.abs(a - b) <= tolerance.limit * np.abs(b)
    else:
        within = np.abs(a - b) <= tolerance.limit
    return np.asarray(~(same | within))


# --------------------------------------------------------------------------------------------------
# Scenes of sound blocks that are recomputed: a sample, and those that failed.

REPEATED = 128
"""Scenes that are recomputed, in turns, where a recomputed one differs. They are searched and
solved in calls of several scenes, where the first time each scene has calls of its own."""

Scene = tuple[int, int]
"""Number of a block, and of a scene within it."""


def check_scenes(
    store: RunStore, sample: int, sound: Mapping[int, SoundBlock], report: IntegrityReport
) -> None:
    """Recompute up to ``sample`` scenes, and all that failed; with a sample of 0, none.

    Raises
    ------
    MachineFaultError
        If this machine cannot compute them.
    """
    if not sample or not sound:
        report.not_sampled = (
            "there is no sound block" if sample else "a sample of 0 scenes was asked for")
        return
    try:
        pipeline = computable(store)
    except SweepError as error:
        report.not_sampled = str(error).splitlines()[-1].strip()
        return
    # Scenes whose process died are not tried again.
    drawn = {scene: stored_scene(store, *scene) for scene in _drawn(store, sample, sound)}
    scenes = {
        scene: values for scene, values in drawn.items()
        if not any((values[name] == crashed).any() for name, (_, crashed) in FLAGS.items())
    }
    report.sampled = len(scenes)
    if scenes:
        computed = _recomputed(store, pipeline, list(scenes))
        report.damage += _compared(store, pipeline, scenes, computed, sound)
    else:
        report.not_sampled = "every scene that was drawn had crashed"
    doubtful = [number for number, block in sound.items() if block.doubtful]
    for number, receipt in receipts(store, doubtful):
        _check_failed(store, pipeline, number, receipt, report)


def _drawn(store: RunStore, count: int, sound: Mapping[int, SoundBlock]) -> list[Scene]:
    """Draw needed scenes, each with the same probability, without repetitions."""
    generator = np.random.default_rng()
    sizes = np.array([block.needed for block in sound.values()])
    numbers = generator.choice(np.array(list(sound)), size=count, p=sizes / sizes.sum())
    drawn = set()
    for number in numbers.tolist():
        block = store.blocks[number]
        if sound[number].needed < len(block):
            scene = generator.choice(np.flatnonzero(scenes_needed(store, block)))
        else:
            scene = generator.integers(len(block))
        drawn.add((number, int(scene)))
    return sorted(drawn)


def _recomputed(store: RunStore, pipeline: Pipeline, scenes: Sequence[Scene]) -> CellsResult:
    """Recompute scenes in child processes."""
    cells = [store.blocks[block].cell(number) for block, number in scenes]
    indices = [np.array(index, dtype=np.intp) for index in zip(*cells, strict=True)]
    shape = (len(scenes), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
    return run_cells_isolated(pipeline, indices, np.ones(shape, dtype=bool), TIME_LIMIT_S)


def _compared(
    store: RunStore, pipeline: Pipeline, scenes: Mapping[Scene, StoredValues],
    computed: CellsResult, sound: Mapping[int, SoundBlock], before: Stage | None = None,
) -> list[Damage]:
    """Compare recomputed scenes with the stored ones, up to the stages ``before`` one."""
    damage: list[Damage] = []
    outside: list[str] = []
    other_processor = 0
    variables = [each for each in store.variables if before is None or each.stage < before]
    axes = scene_axes(pipeline)
    one = Block((0,) * len(axes), (1,) * len(axes))
    for row, (scene, stored) in enumerate(scenes.items()):
        values = {
            variable.name: to_dataset_layout(
                variable, pipeline, one,
                [column[row : row + 1] for column in computed.columns[variable.name]])
            for variable in variables
        }
        same_processor = sound[scene[0]].processors == (processor(),)
        other_processor += not same_processor
        comparison = compare(values, stored, variables, same_processor=same_processor)
        at = f"--at {_at(store, scene)}"
        if comparison.departure:
            damage.append(Damage(
                "scene", at, f"recomputed, it differs: {comparison.departure}", scene[0]))
        if comparison.outside:
            outside.append(f"{at}: {comparison.outside}")
    if len(outside) > max(MIN_OUTSIDE, MAX_OUTSIDE * other_processor):
        damage.append(Damage(
            "sample", "sample",
            f"{len(outside)} of {other_processor} scenes that another processor computed "
            f"differ beyond the tolerances, such as {outside[0]}"))
    if damage and before is None:
        unstable = _unstable(store, pipeline, list(scenes), computed)
        if unstable is not None:
            stage, found = unstable
            return [*_compared(store, pipeline, scenes, computed, sound, stage), found]
    return damage


def _unstable(
    store: RunStore, pipeline: Pipeline, scenes: list[Scene], computed: CellsResult
) -> tuple[Stage, Damage] | None:
    """Recompute scenes again and again; return what changes, from which stage on, if it does.

    A detector or solver may change from call to call, or with the other scenes of a call.
    """
    rows = np.resize(np.arange(len(scenes)), REPEATED)
    again = _recomputed(store, pipeline, [scenes[row] for row in rows])
    for stage in Stage:
        changed = {
            configuration: int(rows[np.argmax(differ)])
            for variable in store.variables if variable.stage is stage
            for configuration, (first, second) in enumerate(zip(
                computed.columns[variable.name], again.columns[variable.name], strict=True))
            if (differ := _differing(first[rows], second)).any()
        }
        if changed:
            name = ", ".join(dict.fromkeys(
                _part(pipeline, stage, configuration) for configuration in sorted(changed)))
            example = _at(store, scenes[min(changed.values())])
            return stage, Damage(
                "not deterministic", name,
                f"not deterministic: {name}: scenes that were recomputed twice on the same images "
                f"differ, such as --at {example}")
    return None


def _differing(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """Return (N,) which rows of two arrays (N, ...) differ; NaN is equal to NaN."""
    return np.asarray(~_same(first, second).reshape(len(first), -1).all(axis=1))


def _part(pipeline: Pipeline, stage: Stage, configuration: int) -> str:
    """Return the name of what computes a configuration of a stage, as far as can be told."""
    if stage is Stage.estimation:
        settings = estimators(pipeline)
        return settings[configuration % len(settings)].solver
    if stage is Stage.detection:
        setting = detector_settings(pipeline)[configuration]
        if isinstance(setting, PluginSetting):
            return setting.plugin.name
    drawing = [each.name for each in pipeline.plugins if each.kind in {"effect", "renderer"}]
    return " or ".join(drawing) or (OPENCV if stage is Stage.detection else "the renderer")


def _at(store: RunStore, scene: Scene) -> str:
    """Return a scene as ``--at`` takes it."""
    block, number = scene
    return selection_text({
        axis.name: axis.values[index] for axis, index in zip(
            scene_axes(store.pipeline), store.blocks[block].cell(number), strict=True)
    })


# --------------------------------------------------------------------------------------------------
# Scenes that failed: a machine may have been at fault. One that ended its process is recomputed
# only if a signal from outside did so.

FLAGS = {
    "detection": (DetectionStatus.failed, DetectionStatus.crashed),
    "estimate": (EstimateStatus.failed, EstimateStatus.crashed),
}
"""Variable -> its flags of scenes that raised, and of those that ended their process."""


def is_doubtful(receipt: Receipt) -> bool:
    """Return whether a block has scenes that failed and are recomputed."""
    counts = {"detection": receipt.detection, "estimate": receipt.estimate}
    return bool(_killed(receipt)) or any(
        sum(counts[name][failed:][:1]) for name, (failed, _) in FLAGS.items())


def _killed(receipt: Receipt) -> list[int]:
    """Return the scenes of a block that a signal from outside ended, as far as recorded."""
    return sorted({
        failure.scene for failure in receipt.failures
        if failure.kind == "crashed" and failure.text.strip() in OUTSIDE_SIGNALS
    })


def _check_failed(
    store: RunStore, pipeline: Pipeline, number: int, receipt: Receipt, report: IntegrityReport
) -> None:
    """Recompute the scenes of a block that failed; those that succeed now are damage of it."""
    block = store.blocks[number]
    killed = np.zeros((len(block), 1), dtype=bool)
    killed[_killed(receipt)] = True
    doubtful = {}
    for name, (failed, crashed) in FLAGS.items():
        variable = VARIABLES[name]
        stored = np.asarray(store.array(name)[region(variable, store.pipeline, block)])
        flags = by_scene(variable, store.pipeline, block, stored)
        doubtful[name] = (flags == failed) | ((flags == crashed) & killed)
    rows = np.flatnonzero(np.any([each.any(axis=1) for each in doubtful.values()], axis=0))
    if not len(rows):
        return
    report.retried += len(rows)
    cells = _recomputed(store, pipeline, [(number, row) for row in rows.tolist()])
    succeed = np.zeros(len(rows), dtype=bool)
    for name, failures in FLAGS.items():
        again = np.stack(cells.columns[name], axis=1)
        succeed |= (doubtful[name][rows] & ~np.isin(again, failures)).any(axis=1)
    if succeed.any():
        example = _at(store, (number, int(rows[np.argmax(succeed)])))
        report.damage.append(Damage(
            "block", f"block {block}",
            f"scenes that had failed and succeed when recomputed: {int(succeed.sum())}, such "
            f"as --at {example}", number))
