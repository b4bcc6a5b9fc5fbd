"""Whether a plug-in does what it declares: six checks of detectors, and of solvers."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, MachineFaultError, PipelineError, PluginError, SweepError
from sweep.evaluation.block import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import SceneBatch, detections_of, scenes_at
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildDiedError, ChildError
from sweep.measure.detectors import OPENCV, make_detector
from sweep.measure.estimation import Detections, Estimates, pose_error
from sweep.measure.estimators import SOLVERS, build
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.marker import dictionary_names, marker_count, missing_package
from sweep.model.renderers import render_all
from sweep.model.scene import Scenes
from sweep.plugins import DetectorPlugin
from sweep.plugins.loading import DeclaredPlugin, PluginSetting, described
from sweep.typing import Floats, Grey, Integers

# --------------------------------------------------------------------------------------------------
# Corners that a detector found against the truth: their order and offset, and the IDs.

#: Largest mean offset of a detector that conforms.
MAX_OFFSET_PX = 0.02

#: Standard errors of the mean offset that are allowed beside it.
STANDARD_ERRORS = 4.0

ORDERS = tuple(itertools.permutations(range(4)))

#: Order of the found corners -> what they are; all other orders mirror or cross.
TURNED: dict[tuple[int, ...], str] = {
    (1, 2, 3, 0): "turned by one", (2, 3, 0, 1): "turned by two (180°)",
    (3, 0, 1, 2): "turned by three",
}

#: IDs (n,) of the markers of an image, and their corners (n, 4, 2) px; empty without one.
Found = tuple[Integers, Floats] | tuple[()]

OK, NOTE, FAULT = "ok", "note", "fault"

#: Result of a check: a verdict, a line, and maybe numbers by name.
Outcome = tuple[str, str] | tuple[str, str, dict[str, Any]]


def judged_corners(
    answers: Sequence[Found], marker_id: Integers, corners_px: Floats,
    declared: DetectorPlugin | None,
) -> Outcome:
    """Hold the markers found in N scenes against the truth, with what to declare where they differ.

    Parameters
    ----------
    answers
        N: the markers of each image. Of several the one with the right ID counts, or the nearest.
    marker_id, corners_px
        (N,) and (N, 4, 2): the truth, the second half of it the point reflection of the first.
    declared
        The plug-in's conventions, by which its corners were changed; None for OpenCV, whose offset
        is noted.
    """
    rows, ids, quads = [], [], []
    for row, answer in enumerate(answers):
        if answer:
            found_ids, corners = answer
            away = np.linalg.norm(corners.mean(axis=1) - corners_px[row].mean(axis=0), axis=1)
            chosen = np.lexsort([away, found_ids != marker_id[row]])[0]
            rows.append(row)
            ids.append((int(marker_id[row]), int(found_ids[chosen])))
            quads.append(corners[chosen])
    if not rows:
        return FAULT, "no marker was found"
    found, truth = np.array(quads), corners_px[rows]
    # Offsets are free, so that an order is recognised whatever the centre of the first pixel.
    spreads = [(found[:, order] - truth).std(axis=(0, 1)).max() for order in ORDERS]
    order = ORDERS[int(np.argmin(spreads))]
    side = np.linalg.norm(truth - np.roll(truth, 1, axis=1), axis=2).mean()
    error = found[:, order] - truth
    offset = error.mean(axis=(0, 1))
    rms_px = float(np.sqrt(((error - offset) ** 2).sum(axis=2).mean()))
    numbers = {"offset_px": offset.tolist(), "rms_px": rms_px}

    faults = []
    if wrong := [(drawn, number) for drawn, number in ids if drawn != number]:
        steps = {number - drawn for drawn, number in wrong}
        constant = f", always {steps.pop():+d}" if len(steps) == 1 < len(wrong) else ""
        faults.append(f"IDs are wrong in {len(wrong)} of {len(rows)} scenes{constant}: "
                      f"{wrong[0][1]} for marker {wrong[0][0]}")
    if min(spreads) > 0.1 * side:
        faults.append(
            "corners are in no fixed order of the marker, or are no pixels of the image: return "
            "them so that the first is always the same corner of the bitmap, as (x, y), y downwards"
        )
    elif order != ORDERS[0]:
        line = f"corners are {TURNED.get(order, 'the other way round, or cross')}"
        if declared is not None:
            fitting = tuple(declared.corner_order[index] for index in order)
            line += f": declare corner_order = {fitting}"
        faults.append(line)
    if faults:
        return FAULT, "; ".join(faults), numbers

    # Errors that belong to the marker cancel in the mean of a scene and its reflection.
    means = np.full((len(corners_px), 2), np.nan)
    means[rows] = error.mean(axis=1)
    pairs = means.reshape(2, -1, 2).mean(axis=0)
    pairs = pairs[np.isfinite(pairs[:, 0])]
    spread = pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs)) if len(pairs) > 1 else np.zeros(2)
    x, y = offset
    if (np.abs(offset) <= MAX_OFFSET_PX + STANDARD_ERRORS * spread).all():
        return OK, f"mean offset ({x:+.3f}, {y:+.3f}) px, RMS beside it {rms_px:.3f} px", numbers
    line = f"corners are offset by ({x:.2f}, {y:.2f}) px"
    if declared is None:
        return NOTE, f"{line}: OpenCV's own, which stays in its results", numbers
    for step in (0.5, -0.5, 1.0, -1.0):
        center = declared.pixel_center + step
        if (np.abs(offset - step) < 0.1).all() and -1 <= center <= 1:
            return FAULT, f"{line}: declare pixel_center = {center:g}", numbers
    return FAULT, f"{line}: no pixel_center is the reason", numbers


# --------------------------------------------------------------------------------------------------
# The scenes on which plug-ins are tried: free of noise, and each with its point reflection.

SCENES = 32
CAMERA = {"width_px": 640, "height_px": 480, "fx_px": 600.0, "fy_px": 600.0}
SIDES_PX = (60.0, 150.0)
TILTS_DEG, STEEP_DEG = (0.0, 45.0), (80.0, 85.0)
BEARINGS_DEG = (-8.0, 8.0)

#: What lines on faults begin with.
SOURCE = "plugins check"


def trial_pipeline(
    kind: str, name: str, dictionary: str, settings: Sequence[str], folder: str,
    of_boards: bool = False, count: int = SCENES, tilts: tuple[float, float] = TILTS_DEG,
) -> Pipeline:
    """Return the pipeline of ``count`` scenes and one setting of a detector, or of a solver.

    Scene i + count/2 is scene i turned by 180° about the image's centre, exactly.

    Raises
    ------
    PipelineError
        If there is no such detector or solver, or a setting is not valid.
    """
    rng = np.random.default_rng(20)
    half = count // 2
    drawn: dict[str, NDArray[Any]] = {
        "azimuth_deg": rng.uniform(0, 180, half), "roll_deg": rng.uniform(0, 180, half),
        "tilt_deg": rng.uniform(*tilts, half), "side_px": np.geomspace(*SIDES_PX, half).round(2),
        "bearing_x_deg": rng.uniform(*BEARINGS_DEG, half),
        "bearing_y_deg": rng.uniform(*BEARINGS_DEG, half),
    }
    if not of_boards:  # an unknown dictionary is refused below
        known = marker_count(dictionary) if dictionary in dictionary_names() else 1
        drawn["marker_id"] = rng.integers(known, size=half)
    reflected = drawn | {
        "azimuth_deg": drawn["azimuth_deg"] + 180, "roll_deg": drawn["roll_deg"] + 180,
        "bearing_x_deg": -drawn["bearing_x_deg"], "bearing_y_deg": -drawn["bearing_y_deg"],
    }
    zipped = {name: np.round([*drawn[name], *reflected[name]], 6).tolist() for name in drawn}
    document: dict[str, Any] = {
        "title": "Conformance", "camera": CAMERA, "marker": {"dictionary": dictionary},
        "axes": {"trial_scene": {"zip": zipped}},
    }
    if kind == "detector":
        document["detector"] = {"detector": name}
    else:
        document["detector"] = {"detector": OPENCV, "cornerRefinementMethod": "subpix"}
        document["estimator"] = {"solver": name}
    if of_boards:
        document["board"] = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.002}
    pipeline = Pipeline.from_dict(document, settings, source=SOURCE, folder=folder)
    if len(pipeline.axes) > 1:
        raise PipelineError([f"{SOURCE}: a plug-in is tried with one setting: no axes"])
    return pipeline


def trial_scenes(pipeline: Pipeline) -> SceneBatch:
    """Return the scenes of :func:`trial_pipeline`."""
    (axis,) = pipeline.axes
    return scenes_at(pipeline.experiment, [np.arange(len(axis))])


def trial_images(batch: SceneBatch) -> list[Grey]:
    """Return the scenes' images, whole frames (480, 640)."""
    frame = batch.scenes.frame
    whole = np.concatenate([np.zeros_like(frame), frame], axis=1)
    images = render_all(batch.scenes, np.arange(len(frame)), batch.boxes, whole)
    return [np.ascontiguousarray(image) for image in images]


# --------------------------------------------------------------------------------------------------
# A trial of a detector, and of a solver: its answers, and what they are held against.

#: Largest median errors of a solver that has the right frames and units.
MAX_ROTATION_DEG, MAX_POSITION_PERCENT = 5.0, 5.0


class DetectorTrial:
    """A detector; an answer has the IDs and corners of the markers in an image."""

    found, hint = "detected", ""

    def __init__(self, arguments: Any) -> None:
        pipeline = trial_pipeline(*arguments)
        (self.setting,) = pipeline.experiment.detectors
        batch = trial_scenes(pipeline)
        self.scenes, self.images = batch.scenes, trial_images(batch)
        self.asked = len(self.images)
        self.find = make_detector(self.setting)

    def answers(self, rows: Sequence[int]) -> list[Found]:
        """Search scenes in an order."""
        return [self.markers(self.images[row]) for row in rows]

    def markers(self, image: NDArray[np.uint8]) -> Found:
        """Return the markers of an image."""
        corners, ids, _ = self.find(image, self.scenes.dictionary[0], max(image.shape))
        if ids is None or not len(ids):
            return ()
        return np.ravel(ids), np.reshape(corners, (-1, 4, 2)).astype(np.float64)

    def judged(self, answers: Sequence[Found]) -> Outcome:
        """Demand IDs, order of corners and centre of the first pixel as they are declared."""
        record = self.setting.record() if isinstance(self.setting, PluginSetting) else None
        return judged_corners(answers, self.scenes.marker_id, self.scenes.corners_px, record)

    def odd(self) -> list[str]:
        """Search plain, black, noisy and small images; return the errors' lines."""
        generator = np.random.default_rng(1)
        lines = []
        for height, width, low, high in (
            (480, 640, 128, 129), (480, 640, 0, 1), (480, 640, 0, 256), (241, 319, 0, 256),
            (37, 53, 0, 256), (8, 8, 0, 256),
        ):
            try:
                self.markers(generator.integers(low, high, (height, width)).astype(np.uint8))
            except PluginError as error:
                lines.append(f"an image of {width} x {height} px: {error}")
        return lines


class SolverTrial:
    """A solver of OpenCV's detections; an answer has all numbers of an estimate."""

    found, hint = "solved", "; expected poses of marker to camera, OpenCV's axes, metres"

    def __init__(self, arguments: Any) -> None:
        self.scenes, self.rows, self.seen = self._detections(arguments)
        _, _, self.steep = self._detections(arguments, tilts=STEEP_DEG)
        self.asked = len(self.rows)

    def _detections(
        self, arguments: Any, **options: Any
    ) -> tuple[Scenes, NDArray[np.intp], Detections]:
        """Return the scenes, the rows (n,) in which OpenCV finds the target, and detections."""
        batch = trial_scenes(trial_pipeline(*arguments, **options))
        (setting,) = batch.experiment.estimators
        self.solve = build(setting)
        (result,), _ = detections_of(batch, batch.visible[:, None], [], keep=True)
        rows = np.flatnonzero(result.flags == DetectionStatus.detected)
        return batch.scenes, rows, detections_for(setting, batch, result, rows)

    def answers(self, rows: Sequence[int]) -> list[tuple[Any, ...]]:
        """Solve detections together, in an order."""
        estimates = self.solve(self.seen.take(np.array(rows, dtype=np.intp)))
        columns = [getattr(estimates, each.name) for each in dataclasses.fields(Estimates)]
        return [numbers if numbers[0] == EstimateStatus.solved else ()
                for numbers in zip(*columns, strict=True)]

    def judged(self, answers: Sequence[tuple[Any, ...]]) -> Outcome:
        """Demand poses of the marker in the camera's frame, in metres."""
        solved = [number for number, answer in enumerate(answers) if answer]
        if not solved:
            return FAULT, "no pose was solved"
        _, rotation, translation, *_ = map(np.array, zip(*filter(None, answers), strict=True))
        rows = self.rows[solved]
        truth = self.scenes.translation[rows]
        error = pose_error(rotation, translation, self.scenes.rotation[rows], truth)
        away = np.linalg.norm(error.translation_m, axis=1) / np.linalg.norm(truth, axis=1)
        turned = float(np.median(np.degrees(error.rotation_angle_rad)))
        percent = float(np.median(100 * away))
        wrong = turned > MAX_ROTATION_DEG or percent > MAX_POSITION_PERCENT
        return FAULT if wrong else OK, (
            f"median errors {turned:.2g} deg and {percent:.2g} % of the distance")

    def odd(self) -> list[str]:
        """Solve targets that are seen nearly from the side; return the error's line."""
        try:
            self.solve(self.steep)
        except PluginError as error:
            return [str(error)]
        return []


# --------------------------------------------------------------------------------------------------
# The six checks, which run in a child process that the plug-in may end or never leave.

#: Time limit of each check.
TIME_LIMIT_S = 120.0

#: Share of the scenes in which a marker must be found, or solved: all are large and sharp.
FEWEST_SHARE = 0.75

PREFERRED = "DICT_APRILTAG_36h11"

#: Kind of plug-in -> its trial, and the names of the checks.
KINDS: dict[str, tuple[Any, tuple[str, ...]]] = {
    "detector": (DetectorTrial, (
        "returns markers", "finds markers", "keeps conventions", "repeats itself",
        "has no memory", "survives odd images")),
    "estimator": (SolverTrial, (
        "returns poses", "solves scenes", "keeps frames", "repeats itself",
        "ignores the batch", "survives odd detections")),
}


def outcomes(arguments: Any) -> Iterator[Outcome]:
    """Yield the outcomes of the six checks of :func:`trial_pipeline`'s plug-in, in their order.

    A PluginError ends them, but where input is odd.
    """
    trial = KINDS[arguments[0]][0](arguments)
    answers = trial.answers(range(trial.asked))
    yield OK, "right shapes and types"

    found, asked = sum(map(bool, answers)), trial.asked
    verdict = FAULT if found < max(1, FEWEST_SHARE * asked) else OK if found == asked else NOTE
    hint = trial.hint if verdict == FAULT else ""
    yield verdict, f"{trial.found} in {found} of {asked} scenes{hint}", {trial.found: found}

    yield trial.judged(answers)

    first = _bits(answers)

    def same(orders: Sequence[Sequence[int]], how: str) -> Outcome:
        """Demand the same bits in other calls."""
        different = {row for order in orders
                     for row, bits in zip(order, _bits(trial.answers(order)), strict=True)
                     if bits != first[row]}
        if different:
            return FAULT, (
                f"called {how}, it gives other results in {len(different)} of {asked} scenes")
        return OK, f"the same bits, called {how}"

    every = range(asked)
    yield same([every], "again")

    odd = "; ".join(dict.fromkeys(trial.odd()))
    yield same([every[::-1], *([row] for row in every)], "in reverse order, alone, after odd input")

    yield (NOTE, odd) if odd else (OK, "no error")


def _bits(answers: Sequence[Any]) -> list[bytes]:
    return [b"".join(np.asarray(part).tobytes() for part in answer) for answer in answers]


#: In the child: the checks that are under way.
_running: list[Iterator[Outcome]] = []


@single_threaded()
def _outcome(number: int, arguments: Any) -> Outcome:
    """Return the outcome of the next check, which has a number; 0 begins."""
    if number == 0:
        _running[:] = [outcomes(arguments)]
    return next(_running[0])


@dataclass(frozen=True)
class Finding:
    """The result of one check: "ok", "note" or "fault", a line, and numbers by name."""

    check: str
    verdict: str
    text: str
    numbers: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ConformanceReport:
    """The results of all checks of a plug-in.

    Attributes
    ----------
    name, kind
        The plug-in's name, and "detector" or "estimator".
    dictionary
        Dictionary of the markers that it was tried on.
    versions
        Distributions that it is made of, with versions.
    findings
        In the order of the checks; those after one that raises, ends its process or does not
        return are missing.
    """

    name: str
    kind: str
    dictionary: str
    versions: dict[str, str]
    findings: list[Finding]

    @property
    def conforms(self) -> bool:
        """Whether no check has found a fault."""
        return all(finding.verdict != FAULT for finding in self.findings)

    @property
    def numbers(self) -> dict[str, Any]:
        """Measurements of the checks: "detected", "offset_px", "rms_px"; "solved"."""
        return {key: value for each in self.findings for key, value in each.numbers.items()}


def check_plugin(
    name: str, dictionary: str | None = None, settings: Sequence[str] = (), *,
    folder: str = ".", time_limit_s: float = TIME_LIMIT_S,
) -> ConformanceReport:
    """Try a detector or a solver on 32 noise-free scenes, and on some that it may not expect.

    Parameters
    ----------
    name
        ``opencv``, one of our solvers, an installed plug-in, or ``module:name`` of a file in
        ``folder``.
    dictionary
        Of the markers; None for DICT_APRILTAG_36h11, or the first that a detector has.
    settings
        "key=value" with TOML values, as ``--set`` takes them.
    time_limit_s
        A check that takes longer is ended, and no other follows.

    Raises
    ------
    ArgumentError, PipelineError
        If there is no such plug-in, dictionary or setting.
    """
    if not 0 < time_limit_s < float("inf"):
        raise ArgumentError("time_limit_s", time_limit_s, "expected seconds above 0")
    plugin = _declared(name, folder)
    if dictionary is None:
        known = plugin.dictionaries or (PREFERRED,)
        dictionary = PREFERRED if PREFERRED in known else next(
            (each for each in known if missing_package(each) is None), known[0])
    arguments = (plugin.kind, name, dictionary, tuple(settings), folder, plugin.of_boards)
    trial_pipeline(*arguments)  # refuses what is wrong with them
    findings: list[Finding] = []
    with Child("sweep.conformance.check") as child:
        for number, check in enumerate(KINDS[plugin.kind][1]):
            try:
                outcome = child.call(_outcome, number, arguments, limit_s=time_limit_s)
            except MachineFaultError:
                raise
            except (ChildError, SweepError) as error:
                line = str(error).strip().splitlines()[-1]
                if isinstance(error, ChildDiedError):
                    line = f"the call ended by {line}"
                findings.append(Finding(check, FAULT, line))
                break
            findings.append(Finding(check, *outcome))
    return ConformanceReport(name, plugin.kind, dictionary, dict(plugin.versions), findings)


def _declared(name: str, folder: str) -> DeclaredPlugin:
    """Return the detector or solver of a name, a plug-in or our own."""
    if name == OPENCV or name in SOLVERS:
        return DeclaredPlugin("detector" if name == OPENCV else "estimator", name)
    for each in described(name, folder):
        if each.kind in KINDS:
            return each
    raise ArgumentError("name", name, "expected a detector or a solver; runs check the others")
