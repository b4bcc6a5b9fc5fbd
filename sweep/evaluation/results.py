"""Results of scene cells: by variable, with failures; on the grid; compared with stored ones."""

from __future__ import annotations

import dataclasses
import itertools
import platform
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.evaluation.machine_faults import raise_machine_fault
from sweep.experiment.experiment import Experiment
from sweep.experiment.grid import Block, Grid
from sweep.experiment.parameters import Stage
from sweep.experiment.schema import SCHEMA, Tolerance, Variable
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.pose import rotation_of_vector


@dataclass(frozen=True, slots=True)
class Failure:
    """A cell whose computation raised, or whose process died.

    Attributes
    ----------
    scene
        Number of the scene in the block.
    stage
        "scene", "detection" or "estimation".
    text
        The traceback; of a process that died, how it ended.
    setting, estimator
        Number of the detector setting and of the estimator, if the stage has them.
    crashed
        Whether the process died.
    """

    scene: int
    stage: str
    text: str
    setting: int | None = None
    estimator: int | None = None
    crashed: bool = False


#: Failures whose traceback is kept; of the others only the last line is.
MAX_TRACEBACKS = 1000


def note_failure(
    failures: list[Failure], scene: int, stage: str, setting: int | None = None,
    estimator: int | None = None,
) -> None:
    """Append the exception that is being handled to the failures of a batch of scenes."""
    text = traceback.format_exc()
    if len(failures) >= MAX_TRACEBACKS:
        text = text.strip().rpartition("\n")[2]
    failures.append(Failure(scene, stage, text, setting, estimator))


Part = TypeVar("Part")


def all_or_each(
    compute: Callable[[NDArray[np.intp]], Part], rows: NDArray[np.intp], note: Callable[[int], None]
) -> list[Part | None]:
    """Return the result for all scenes ``rows`` together; if that raises, those for each alone.

    None for a scene that raises alone, too: ``note`` gets its row while the exception is handled.

    Raises
    ------
    MachineFaultError
        If an exception tells of a fault of this machine.
    """
    try:
        return [compute(rows)]
    except Exception as error:
        raise_machine_fault(error)
    parts: list[Part | None] = []
    for row in rows:
        try:
            parts.append(compute(np.array([row])))
        except Exception as error:
            raise_machine_fault(error)
            note(int(row))
            parts.append(None)
    return parts


@dataclass(slots=True)
class CellsResult:
    """Results of N scene cells.

    Attributes
    ----------
    columns
        Variable -> (configurations of its stage, N, ...), the last axis of configurations fastest.
    seconds
        Time spent: "scene", then "detection" and "estimation" per configuration.
    failures
        The exceptions that were raised; their cells are flagged ``failed``.
    """

    columns: dict[str, NDArray[Any]]
    seconds: dict[str, list[float]]
    failures: list[Failure] = field(default_factory=list)

    @staticmethod
    def not_run(experiment: Experiment, count: int) -> CellsResult:
        """Return the result of ``count`` cells of which nothing was computed."""
        grid, shapes = experiment.grid, experiment.cell_shapes
        return CellsResult(
            {
                variable.name: np.full(
                    (shapes[variable.name][0], count, *shapes[variable.name][1:]), variable.fill,
                    dtype=np.float64 if variable.flags is None else variable.dtype,
                )
                for variable in experiment.variables
            },
            {
                "scene": [0.0],
                "detection": [0.0] * grid.size(Stage.detection),
                "estimation": [0.0] * grid.size(Stage.detection, Stage.estimation),
            },
        )


    def take(
        self, experiment: Experiment, part: CellsResult, rows: NDArray[np.intp]
    ) -> None:
        """Take over what was computed of n scenes, whose numbers here are ``rows`` (n,)."""
        where = {
            Stage.scene: np.ones((1, len(rows)), dtype=bool),
            Stage.detection: part.columns["detection"] != DetectionStatus.not_run,
            Stage.estimation: part.columns["estimate"] != EstimateStatus.not_run,
        }
        for v in experiment.variables:
            column, row = np.nonzero(where[v.stage])
            self.columns[v.name][column, rows[row]] = part.columns[v.name][column, row]
        for stage, seconds in part.seconds.items():
            self.seconds[stage] = np.add(self.seconds[stage], seconds).tolist()
        self.failures += [
            dataclasses.replace(each, scene=int(rows[each.scene])) for each in part.failures]


def to_dataset_layout(
    variable: Variable, grid: Grid, block: Block, columns: NDArray[Any]
) -> NDArray[Any]:
    """Return a block of a variable in the dataset's dimensions and type.

    Parameters
    ----------
    variable, grid, block
        Which variable of which block of the grid.
    columns
        (configurations of the variable's stage, N, ...); N scenes, the last scene axis fastest.
    """
    inner_axes = variable.configuration_axes(grid)
    lengths = [len(axis) for axis in inner_axes]
    spread = columns.astype(variable.dtype).reshape(
        (*lengths, *block.shape, *variable.inner_shape)
    )
    axes = itertools.chain(inner_axes, grid.axes_of(Stage.scene))
    names = [*(axis.name for axis in axes), *variable.inner]
    order = [names.index(name) for name in variable.dimensions(grid)]
    return spread.transpose(order).copy(order="C")


# --------------------------------------------------------------------------------------------------
# Features of a processor, and of libraries on it, that decide the last bits of results.


@cache
def processor() -> str:
    """Return the features that OpenCV and NumPy find on this processor, and a digest of results.

    Features that a variable of the environment switches off (``OPENCV_CPU_DISABLE``,
    ``OPENCV_IPP``, ``NPY_DISABLE_CPU_FEATURES``) are missing, or marked by "?". The digest covers
    the results of the mathematical and linear algebra libraries for fixed numbers, which do not
    show in the features; code that Numba compiles gives the same bits on all.
    """
    found = np.show_config("dicts").get("SIMD Extensions", {}).get("found", ())
    ipp = cv2.ipp.getIppVersion().partition(" (")[0] if cv2.ipp.useIPP() else "no IPP"
    x = np.linspace(-3.0, 3.0, 64 * 64).reshape(64, 64)
    results = (
        *(function(x) for function in (np.sin, np.cos, np.tan, np.arctan, np.exp)),
        np.sin(x) @ np.cos(x),
        cv2.solve(np.sin(x * x), np.cos(x), flags=cv2.DECOMP_LU)[1],
    )
    digest = sha256(b"".join(each.tobytes() for each in results)).hexdigest()
    return (f"{platform.machine()}, OpenCV {cv2.getCPUFeaturesLine()}, {ipp}, "
            f"NumPy {' '.join(found)} ({digest[:12]})")


def differing_processors(counts: Mapping[str, int], things: str) -> list[str]:
    """Return a line on processors of several sets of features that compute one store; else none.

    Parameters
    ----------
    counts
        Number of ``things`` by :func:`processor`.
    things
        "workers" or "blocks".

    Examples
    --------
    >>> print(*differing_processors({"AVX2": 3, "SSE": 1}, "blocks"))
    processors with 2 different sets of features: last digits differ (3 blocks: AVX2; 1 blocks: SSE)
    """
    parts = "; ".join(f"{count:,} {things}: {name}" for name, count in sorted(counts.items()))
    line = f"processors with {len(counts)} different sets of features: last digits differ ({parts})"
    return [line] if len(counts) > 1 else []


# --------------------------------------------------------------------------------------------------
# Whether a recomputed scene agrees with the stored one.
#
# On a processor with the same features every bit agrees. On another one, OpenCV, NumPy and the
# mathematical library take other routines, and last bits differ; how far is the ``tolerance`` of
# each variable in :mod:`sweep.experiment.schema`, measured on 9,000 scenes with AVX-512, AVX2 and
# all of AVX switched off in turn. Without AVX, 0.02 % of ordinary scenes, and at most 4.4 %
# of those of a pipeline of extremes, lie outside them, because a last bit can decide between two
# minima.

#: Variable -> values of one scene, of its inner dimensions last.
Values = Mapping[str, NDArray[Any]]


def compare(
    recomputed: Values, stored: Values, variables: Sequence[Variable] = SCHEMA, *,
    same_processor: bool,
) -> str:
    """Return how a recomputed scene differs from the stored one, in the variables that both have.

    Empty if it does not, else the first variable that differs: by a bit, or on another processor
    beyond its tolerance.

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
    >>> compare(recomputed, stored, same_processor=False)
    ''
    >>> compare(recomputed, stored, same_processor=True)
    'reprojection_error_px 0.201000005, stored 0.200000003'
    """
    for variable in variables:
        if variable.name not in recomputed or variable.name not in stored:
            continue
        ours, theirs = recomputed[variable.name], stored[variable.name]
        if same_processor:
            differ = ~is_same(ours, theirs)
        elif variable.tolerance is None:
            continue
        else:
            distance = np.linalg.norm(stored["true_tvec_m"]) if "true_tvec_m" in stored else 0.0
            differ = _beyond(variable.tolerance, ours, theirs, float(distance))
        if differ.any():
            return f"{variable.name} {ours[differ][0]:.9g}, stored {theirs[differ][0]:.9g}"
    return ""


def is_same(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where two arrays are equal or both NaN; also of integers."""
    return np.asarray((a == b) | ((a != a) & (b != b)))  # noqa: PLR0124  (NaN)


def _beyond(
    tolerance: Tolerance, recomputed: NDArray[Any], stored: NDArray[Any], distance_m: float
) -> NDArray[np.bool_]:
    """Return where recomputed values lie outside a tolerance, of the arrays' shape."""
    same = is_same(recomputed, stored)
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
