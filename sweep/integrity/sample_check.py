"""A sample of cells recomputed, and compared within the tolerances of the processor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import StoreError, SweepError
from sweep.evaluation.results import CellsResult, to_dataset_layout
from sweep.execution.limits import TIME_LIMIT_S
from sweep.isolation.crash_isolation import run_cells_isolated
from sweep.measure.detectors import OPENCV
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.pose import rotation_of_vector
from sweep.plan.cell_selection import selection_text
from sweep.plan.grid import Block, detector_settings, estimators, scene_axes
from sweep.plan.parameters import Stage
from sweep.plan.pipeline import Pipeline
from sweep.plan.schema import SCHEMA, Tolerance, Variable
from sweep.plugins.declared import PluginSetting
from sweep.processor import processor
from sweep.sampling.rules import scenes_needed
from sweep.store.blocks import RunStore, committed, missing_chunks, receipts, region
from sweep.store.provenance import differences

# --------------------------------------------------------------------------------------------------
# The kinds of damage that verification finds: to a file, an array, a block, a scene, the sample.
#
# Each names its place in the store (``where``), what is wrong (``what``), and the number of the
# block that it damages, None if it damages none. Repair acts by the kind.

@dataclass(frozen=True, slots=True)
class FileDamage:
    """A file that is missing, changed or unreadable.

    Examples
    --------
    >>> damage = FileDamage("detection/c/0/0", "missing", block=0)
    >>> as_json(damage)
    {'where': 'detection/c/0/0', 'what': 'missing', 'block': 0}
    """

    key: str
    what: str
    block: int | None = None

    @property
    def where(self) -> str:
        """The file's key."""
        return self.key


@dataclass(frozen=True, slots=True)
class ArrayDamage:
    """An array that is missing, foreign, or whose metadata or values do not fit the pipeline."""

    path: str
    what: str

    @property
    def where(self) -> str:
        """The array's path."""
        return self.path

    @property
    def block(self) -> None:
        """None: blocks hold none of its files."""
        return


@dataclass(frozen=True, slots=True)
class BlockDamage:
    """A block whose files fit their checksums and whose flags and numbers contradict each other."""

    block: int
    name: str
    what: str

    @property
    def where(self) -> str:
        """The block's name."""
        return f"block {self.name}"


@dataclass(frozen=True, slots=True)
class SceneDamage:
    """A scene that gives other values when it is recomputed."""

    at: str
    what: str
    block: int

    @property
    def where(self) -> str:
        """The scene's coordinates, as ``sweep repro`` takes them."""
        return f"--at {self.at}"


@dataclass(frozen=True, slots=True)
class SampleDamage:
    """A sample of which too many scenes differ; recomputing a block does not repair it."""

    what: str

    @property
    def where(self) -> str:
        """The word for it in lists of damage."""
        return "sample"

    @property
    def block(self) -> None:
        """None: it cannot be attributed to a block."""
        return


@dataclass(frozen=True, slots=True)
class NotDeterministic:
    """A part whose answers change from call to call; recomputing a block does not repair it."""

    name: str
    example: str

    @property
    def where(self) -> str:
        """The part's name."""
        return self.name

    @property
    def what(self) -> str:
        """What recomputing scenes has shown."""
        return (
            f"not deterministic: {self.name}: scenes that were recomputed twice on the same images "
            f"differ, such as --at {self.example}"
        )

    @property
    def block(self) -> None:
        """None: every block may have such scenes."""
        return


Damage = FileDamage | ArrayDamage | BlockDamage | SceneDamage | SampleDamage | NotDeterministic


def as_json(damage: Damage) -> dict[str, Any]:
    """Return a damage as ``sweep verify --json`` prints it."""
    return {"where": damage.where, "what": damage.what, "block": damage.block}


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
# each variable in :mod:`sweep.plan.schema`, measured on 9,000 scenes with AVX-512, AVX2 and all
# of AVX switched off in turn. Without AVX, 0.02 % of ordinary scenes, and at most 4.4 % of those
# of a pipeline of extremes, lie outside them, because a last bit can decide between two minima.

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
# The check of a sample: scenes of sound blocks are recomputed and compared.

REPEATED = 128
"""Scenes that are recomputed, in turns, where a recomputed one differs. They are searched and
solved in calls of several scenes, where the first time each scene has calls of its own."""


@dataclass(slots=True)
class SampleFindings:
    """The result of the check.

    Attributes
    ----------
    count
        Scenes that were recomputed.
    reason
        Why none was, if none was.
    damage
        What is damaged.
    """

    count: int = 0
    reason: str = ""
    damage: list[Damage] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class _Scene:
    """A scene of the sample: number of its block, number within it, and its stored values."""

    block: int
    number: int
    stored: StoredValues

    @property
    def crashed(self) -> bool:
        """Whether it ended its process when the store was made."""
        return bool(
            (self.stored["detection"] == DetectionStatus.crashed).any()
            or (self.stored["estimate"] == EstimateStatus.crashed).any()
        )


class SampleCheck:
    """Recomputes scenes of a store that are drawn at random."""

    def __init__(self, store: RunStore) -> None:
        self._store = store

    def run(
        self, count: int, sound: Mapping[int, Sequence[str]],
        needed: Mapping[int, int] | None = None,
    ) -> SampleFindings:
        """Recompute up to ``count`` scenes, none of them one that was not needed.

        Parameters
        ----------
        count
            Scenes that are drawn, with replacement.
        sound
            Number of each sound block -> features of the processors that computed it.
        needed
            Number of each -> how many of its scenes were needed; all by default.
        """
        if not count:
            return SampleFindings(reason="a sample of 0 scenes was asked for")
        if not sound:
            return SampleFindings(reason="there is no sound block")
        try:
            pipeline = computable(self._store)
        except SweepError as error:
            return SampleFindings(reason=str(error).splitlines()[-1].strip())
        # Scenes whose process died are not tried again.
        sizes = needed or {number: len(self._store.blocks[number]) for number in sound}
        scenes = [scene for scene in self._drawn(count, sizes) if not scene.crashed]
        if not scenes:
            return SampleFindings(reason="every scene that was drawn had crashed")
        return self._compare(pipeline, scenes, self._recomputed(pipeline, scenes), sound)

    def _drawn(self, count: int, needed: Mapping[int, int]) -> list[_Scene]:
        """Draw needed scenes, each with the same probability, without repetitions."""
        blocks = self._store.blocks
        generator = np.random.default_rng()
        sizes = np.array(list(needed.values()))
        numbers = generator.choice(np.array(list(needed)), size=count, p=sizes / sizes.sum())
        drawn = {
            (number, int(generator.choice(self._needed(number))) if needed[number] < len(
                blocks[number]) else int(generator.integers(len(blocks[number]))))
            for number in numbers.tolist()
        }
        return [_Scene(*each, stored_scene(self._store, *each)) for each in sorted(drawn)]

    def _needed(self, number: int) -> NDArray[np.intp]:
        """Return the numbers of a block's scenes that were needed."""
        return np.flatnonzero(scenes_needed(self._store, self._store.blocks[number]))

    def _recomputed(self, pipeline: Pipeline, scenes: Sequence[_Scene]) -> CellsResult:
        """Recompute scenes in child processes."""
        blocks = self._store.blocks
        cells = [blocks[scene.block].cell(scene.number) for scene in scenes]
        indices = [np.array(index, dtype=np.intp) for index in zip(*cells, strict=True)]
        shape = (len(scenes), pipeline.size(Stage.detection), pipeline.size(Stage.estimation))
        return run_cells_isolated(pipeline, indices, np.ones(shape, dtype=bool), TIME_LIMIT_S)

    def _values(self, pipeline: Pipeline, computed: CellsResult, count: int) -> list[StoredValues]:
        """Return the values of recomputed scenes, with scene axes of length 1."""
        axes = scene_axes(pipeline)
        block = Block((0,) * len(axes), (1,) * len(axes))
        return [
            {
                variable.name: to_dataset_layout(
                    variable, pipeline, block,
                    [column[row : row + 1] for column in computed.columns[variable.name]],
                )
                for variable in self._store.variables
            }
            for row in range(count)
        ]

    def _unstable(
        self, pipeline: Pipeline, scenes: list[_Scene], computed: CellsResult
    ) -> tuple[Stage, NotDeterministic] | None:
        """Recompute scenes again and again; return what changes, from which stage on, if it does.

        A detector or solver may change from call to call, or with the other scenes of a call.
        """
        rows = np.resize(np.arange(len(scenes)), REPEATED)
        again = self._recomputed(pipeline, [scenes[row] for row in rows])
        for stage in Stage:
            changed = {
                configuration: int(rows[np.argmax(differ)])
                for variable in self._store.variables if variable.stage is stage
                for configuration, (first, second) in enumerate(zip(
                    computed.columns[variable.name], again.columns[variable.name], strict=True
                ))
                if (differ := _differing(first[rows], second)).any()
            }
            if changed:
                name = ", ".join(dict.fromkeys(
                    _part(pipeline, stage, configuration) for configuration in sorted(changed)
                ))
                return stage, NotDeterministic(name, self._at(scenes[min(changed.values())]))
        return None

    def _compare(
        self, pipeline: Pipeline, scenes: list[_Scene], computed: CellsResult,
        sound: Mapping[int, Sequence[str]], before: Stage | None = None,
    ) -> SampleFindings:
        """Compare recomputed scenes with the stored ones, up to the stages ``before`` one."""
        findings = SampleFindings(count=len(scenes))
        other_processor = 0
        variables = [
            variable for variable in self._store.variables
            if before is None or variable.stage < before
        ]
        recomputed = self._values(pipeline, computed, len(scenes))
        outside: list[str] = []
        for scene, values in zip(scenes, recomputed, strict=True):
            same_processor = tuple(sound[scene.block]) == (processor(),)
            other_processor += not same_processor
            comparison = compare(
                values, scene.stored, variables, same_processor=same_processor
            )
            at = self._at(scene)
            if comparison.departure:
                findings.damage.append(SceneDamage(
                    at, f"recomputed, it differs: {comparison.departure}", scene.block
                ))
            if comparison.outside:
                outside.append(f"--at {at}: {comparison.outside}")
        if len(outside) > max(MIN_OUTSIDE, MAX_OUTSIDE * other_processor):
            findings.damage.append(SampleDamage(
                f"{len(outside)} of {other_processor} scenes that another processor computed "
                f"differ beyond the tolerances, such as {outside[0]}"
            ))
        if findings.damage and before is None:
            unstable = self._unstable(pipeline, scenes, computed)
            if unstable is not None:
                stage, finding = unstable
                findings = self._compare(pipeline, scenes, computed, sound, stage)
                findings.damage.append(finding)
        return findings

    def _at(self, scene: _Scene) -> str:
        index = self._store.blocks[scene.block].cell(scene.number)
        return selection_text({
            axis.name: axis.values[k]
            for axis, k in zip(scene_axes(self._store.pipeline), index, strict=True)
        })


def _differing(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """Return (N,) which rows of two arrays (N, ...) differ; NaN is equal to NaN."""
    differ = (first != second) & ~((first != first) & (second != second))  # noqa: PLR0124  (NaN)
    return np.asarray(differ.reshape(len(differ), -1).any(axis=1))


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
