"""Whether a plug-in does what it declares: six checks of detectors, and of solvers."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.errors import ArgumentError, MachineFaultError, PipelineError, PluginError, SweepError
from sweep.evaluation.block import detections_for, run_cells
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.results import CellsResult
from sweep.evaluation.search import detections_of, scenes_at
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.schema import VARIABLES
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.measure.detectors import OPENCV, AnyDetectorSetting, make_detector
from sweep.measure.estimators import SOLVERS, build
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.exposure import marker_boxes
from sweep.model.marker import dictionary_names, marker_count, missing_package
from sweep.model.renderers import render_all
from sweep.model.scene import build_scenes
from sweep.plugins.declared import DeclaredPlugin, PluginSetting, described
from sweep.typing import Floats, Grey, Integers

# --------------------------------------------------------------------------------------------------
# Corners that a detector found against the truth: their order and offset, and the IDs.

#: Largest mean offset of a detector that conforms.
MAX_OFFSET_PX = 0.02

#: Standard errors of the mean offset that are allowed beside it.
STANDARD_ERRORS = 4.0

ORDERS = tuple(itertools.permutations(range(4)))

#: The markers of an image: ID and corners (4, 2) px.
Found = Sequence[tuple[int, Floats]]


@dataclass(frozen=True)
class Conventions:
    """What corners and IDs turn out to be.

    Attributes
    ----------
    detected
        Scenes in which the marker was found.
    order
        Index of the found corner that is the true top left one, and so on; None if no order of all
        scenes puts the corners where the marker is.
    offset_px
        (2,) mean of found minus true, in this order.
    offset_error_px
        (2,) its standard error.
    rms_px
        Root mean square of a corner's distance after the mean offset is taken off.
    ids
        Pairs of drawn and found ID that differ.
    """

    detected: int
    order: tuple[int, ...] | None
    offset_px: Floats
    offset_error_px: Floats
    rms_px: float
    ids: tuple[tuple[int, int], ...]


def conventions(
    found: Sequence[Found], marker_id: Integers, corners_px: Floats
) -> Conventions | None:
    """Return the conventions that explain the markers found in N scenes; None without any.

    Parameters
    ----------
    found
        N: the markers of each image. Of several the one with the right ID counts, or the nearest.
    marker_id, corners_px
        (N,) and (N, 4, 2): the truth, the second half of it the point reflection of the first.
    """
    rows, ids, corners = [], [], []
    for row, markers in enumerate(found):
        if markers:
            centre = corners_px[row].mean(axis=0)
            number, quad = min(
                markers, key=lambda marker: (
                    marker[0] != marker_id[row],
                    float(np.linalg.norm(marker[1].mean(axis=0) - centre)),
                ),
            )
            rows.append(row)
            ids.append((int(marker_id[row]), int(number)))
            corners.append(quad)
    if not rows:
        return None
    quads, truth = np.array(corners), corners_px[rows]
    # Offsets are free, so that an order is recognised whatever the centre of the first pixel.
    spreads = [(quads[:, list(some)] - truth).std(axis=(0, 1)).max() for some in ORDERS]
    best = int(np.argmin(spreads))
    side = float(np.linalg.norm(truth - np.roll(truth, 1, axis=1), axis=2).mean())
    order = ORDERS[best] if spreads[best] < 0.1 * side else None
    error = quads[:, list(ORDERS[best])] - truth
    offset = error.mean(axis=(0, 1))
    half = len(corners_px) // 2
    means = dict(zip(rows, error.mean(axis=1), strict=True))
    pairs = np.array([
        (means[row] + means[row + half]) / 2 for row in range(half)
        if row in means and row + half in means
    ])
    spread = pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs)) if len(pairs) > 1 else np.zeros(2)
    return Conventions(
        detected=len(rows), order=order, offset_px=offset, offset_error_px=spread,
        rms_px=float(np.sqrt(((error - offset) ** 2).sum(axis=2).mean())),
        ids=tuple(pair for pair in ids if pair[0] != pair[1]),
    )


def order_faults(
    result: Conventions, declared: Sequence[int] | None, pixel_center: float | None
) -> list[str]:
    """Return the faults of corners and IDs, a line each, with the declaration that fits instead.

    ``declared`` and ``pixel_center`` are a plug-in's declarations; None for OpenCV.
    """
    faults = []
    if result.ids:
        drawn, found = result.ids[0]
        steps = {other - one for one, other in result.ids}
        constant = f", always {steps.pop():+d}" if len(steps) == 1 and len(result.ids) > 1 else ""
        faults.append(
            f"IDs are wrong in {len(result.ids)} of {result.detected} scenes{constant}: "
            f"{found} for marker {drawn}"
        )
    if result.order is None:
        faults.append(
            "corners are in no fixed order of the marker, or are no pixels of the image: return "
            "them so that the first is always the same corner of the bitmap, as (x, y), y downwards"
        )
        return faults
    if result.order != (0, 1, 2, 3):
        faults.append(_order_fault(result.order, declared))
    if not faults:
        faults += offset_fault(result, pixel_center)
    return faults


def _order_fault(order: tuple[int, ...], declared: Sequence[int] | None) -> str:
    quarters = next(
        (k for k in range(1, 4) if order == tuple((i + k) % 4 for i in range(4))), None
    )
    what = {
        None: "corners run the other way round, or cross", 1: "corners are turned by one",
        2: "corners are turned by two (180°)", 3: "corners are turned by three",
    }[quarters]
    if declared is None:
        return what
    wanted = tuple(declared[index] for index in order)
    return f"{what}: declare corner_order = {wanted}"


def offset_fault(result: Conventions, pixel_center: float | None) -> list[str]:
    """Return the line that says how far corners are off in the mean; none if they are not."""
    allowed = MAX_OFFSET_PX + STANDARD_ERRORS * result.offset_error_px
    if (np.abs(result.offset_px) <= allowed).all():
        return []
    x, y = result.offset_px
    line = f"corners are offset by ({x:.2f}, {y:.2f}) px"
    if pixel_center is None:
        return [line]
    for step in (0.5, -0.5, 1.0, -1.0):
        if (np.abs(result.offset_px - step) < 0.1).all() and -1 <= pixel_center + step <= 1:
            return [f"{line}: declare pixel_center = {pixel_center + step:g}"]
    return [f"{line}: no pixel_center is the reason"]


# --------------------------------------------------------------------------------------------------
# The scenes on which plug-ins are tried: free of noise, and each with its point reflection.

SCENES = 32
WIDTH_PX, HEIGHT_PX, FOCAL_PX = 640, 480, 600.0
SIDES_PX = (60.0, 150.0)
TILTS_DEG = (0.0, 45.0)
MAX_BEARING_DEG = 8.0

#: What lines on faults begin with.
SOURCE = "plugins check"

@dataclass(frozen=True)
class TrialScenes:
    """N scenes, and the detector's setting.

    Attributes
    ----------
    setting
        The one setting of the detector.
    dictionary
        Of all markers.
    marker_id, corners_px
        (N,) and (N, 4, 2): the truth. Scene i + N/2 is scene i turned by 180° about the image's
        centre, exactly: errors that belong to the marker cancel in the mean, offsets do not.
    images
        (480, 640) each.
    """

    setting: AnyDetectorSetting
    dictionary: str
    marker_id: Integers
    corners_px: Floats
    images: list[Grey]


def trial_pipeline(
    detector: str, dictionary: str, settings: Sequence[str], folder: str, count: int = SCENES, *,
    solver: str | None = None, board: bool = False, tilts: tuple[float, float] = TILTS_DEG,
) -> Pipeline:
    """Return the pipeline of ``count`` scenes and one setting of a detector, or of a solver.

    Raises
    ------
    PipelineError
        If there is no such detector or solver, or a setting is not valid.
    """
    rng = np.random.default_rng(20)
    half = count // 2
    reflected = {
        "azimuth_deg": rng.uniform(0, 180, half), "roll_deg": rng.uniform(0, 180, half),
    }
    drawn = {
        "tilt_deg": rng.uniform(*tilts, half),
        "side_px": np.geomspace(*SIDES_PX, half).round(2),
    }
    negated = {
        name: rng.uniform(-MAX_BEARING_DEG, MAX_BEARING_DEG, half)
        for name in ("bearing_x_deg", "bearing_y_deg")
    }
    columns = {name: [*values, *values] for name, values in drawn.items()}
    columns |= {name: [*values, *(values + 180)] for name, values in reflected.items()}
    columns |= {name: [*values, *(-values)] for name, values in negated.items()}
    written = {name: [round(float(value), 6) for value in values] for name, values in
               columns.items()}
    known = dictionary in dictionary_names()  # others are refused below
    ids = rng.integers(marker_count(dictionary) if known else 1, size=half).tolist()
    if not board:
        written["marker_id"] = [*ids, *ids]
    size = {"width_px": WIDTH_PX, "height_px": HEIGHT_PX, "fx_px": FOCAL_PX, "fy_px": FOCAL_PX}
    document: dict[str, Any] = {
        "title": "Conformance", "camera": size, "marker": {"dictionary": dictionary},
        "detector": {"detector": detector}, "axes": {"trial_scene": {"zip": written}},
    }
    if solver is not None:
        document["detector"]["cornerRefinementMethod"] = "subpix"
        document["estimator"] = {"solver": solver}
    if board:
        document["board"] = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.002}
    pipeline = Pipeline.from_dict(document, settings, source=SOURCE, folder=folder)
    if len(pipeline.axes) > 1:
        raise PipelineError([f"{SOURCE}: a plug-in is tried with one setting: no axes"])
    return pipeline


@single_threaded()
def trial_scenes(pipeline: Pipeline) -> TrialScenes:
    """Return the scenes of :func:`trial_pipeline`, rendered as whole frames."""
    (axis,) = pipeline.axes_of(Stage.scene)
    values = pipeline.experiment.scene_values([np.arange(len(axis))])
    scenes = build_scenes(values, len(axis))
    rows = np.arange(len(scenes))
    frames = np.concatenate([np.zeros_like(scenes.frame), scenes.frame], axis=1)
    images = render_all(scenes, rows, marker_boxes(scenes), frames)
    return TrialScenes(
        pipeline.experiment.detectors[0], scenes.dictionary[0], scenes.marker_id,
        scenes.corners_px, [np.ascontiguousarray(image) for image in images],
    )


# --------------------------------------------------------------------------------------------------
# Six checks of a detector, and of a solver: each a function that returns its finding.
#
# They run in a child process, which the plug-in may end or never leave.

#: Time limit of each check.
TIME_LIMIT_S = 120.0

#: Share of the scenes in which a marker must be found, or solved: all are large and sharp.
FEWEST_SHARE = 0.75

#: Largest median errors of a solver that has the right frames and units.
MAX_ROTATION_DEG, MAX_POSITION_PERCENT = 5.0, 5.0

PREFERRED = "DICT_APRILTAG_36h11"

OK, NOTE, FAULT = "ok", "note", "fault"

#: Result of a check: a verdict, a line, and maybe numbers by name.
Outcome = tuple[str, str] | tuple[str, str, dict[str, Any]]


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
        In the order of the checks; those after a crash or a time limit are missing.
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
    kind = "estimator" if name in SOLVERS else "detector" if plugin is None else plugin.kind
    known = () if plugin is None else plugin.dictionaries
    if dictionary is None:
        dictionary = PREFERRED if not known or PREFERRED in known else next(
            (each for each in known if missing_package(each) is None), known[0])
    of_boards = plugin is not None and plugin.of_boards
    arguments = (kind, name, dictionary, tuple(settings), folder, of_boards)
    _pipeline(*arguments)  # refuses what is wrong with them
    findings: list[Finding] = []
    with Child("sweep.conformance.check") as child:
        try:
            child.call(_open, arguments, limit_s=time_limit_s)
            findings.extend(
                child.call(_run, kind, number, limit_s=time_limit_s)
                for number in range(len(CHECKS))
            )
        except MachineFaultError:
            raise
        except (ChildDiedError, ChildRaisedError, SweepError) as error:
            findings.append(Finding(NAMES[kind][len(findings)], FAULT, _ending(error)))
    versions = {} if plugin is None else dict(plugin.versions)
    return ConformanceReport(name, kind, dictionary, versions, findings)


def _declared(name: str, folder: str) -> DeclaredPlugin | None:
    """Return the detector or solver of a name; None for our own."""
    if name == OPENCV or name in SOLVERS:
        return None
    for each in described(name, folder):
        if each.kind in NAMES:
            return each
    raise ArgumentError("name", name, "expected a detector or a solver; runs check the others")


def _pipeline(
    kind: str, name: str, dictionary: str, settings: Sequence[str], folder: str, of_boards: bool,
    tilts: tuple[float, float] = TILTS_DEG,
) -> Pipeline:
    if kind == "detector":
        return trial_pipeline(name, dictionary, settings, folder)
    return trial_pipeline(
        OPENCV, dictionary, settings, folder, solver=name, board=of_boards, tilts=tilts)


def _ending(error: ChildDiedError | ChildRaisedError | SweepError) -> str:
    if isinstance(error, ChildDiedError):
        return f"did not return: {error}" if error.timed_out else f"ended its process ({error})"
    return last_line(error) if isinstance(error, ChildRaisedError) else str(error)


# In the child process.

_trials: list[DetectorTrial | SolverTrial] = []


@single_threaded()
def _open(arguments: tuple[str, str, str, tuple[str, ...], str, bool]) -> None:
    """Make the trial whose checks are called next."""
    pipeline = _pipeline(*arguments)
    _trials[:] = [
        DetectorTrial(pipeline) if arguments[0] == "detector"
        else SolverTrial(pipeline, _pipeline(*arguments, (80.0, 85.0)))
    ]


@single_threaded()
def _run(kind: str, number: int) -> Finding:
    """Run one check and return its finding."""
    verdict, text, *numbers = CHECKS[number](_trials[0])
    return Finding(NAMES[kind][number], verdict, text, *numbers)


class DetectorTrial:
    """A detector, the scenes, and the markers that it finds in their images."""

    returned = "corners and IDs of the right shapes"
    found_key, found_what, found_hint = "detected", "a marker", ""
    order, survived = "in reverse, after noise", "plain, black, noise, down to 8 x 8 px"

    def __init__(self, pipeline: Pipeline) -> None:
        self.scenes = trial_scenes(pipeline)
        self.find = make_detector(self.scenes.setting)
        setting = self.scenes.setting
        self.record = setting.record() if isinstance(setting, PluginSetting) else None
        self.faults: list[str] = []
        self.markers_found = self.search(range(SCENES))
        self.first = [_bits(found) for found in self.markers_found]
        self.asked, self.found = SCENES, sum(map(bool, self.first))

    def search(self, rows: Sequence[int]) -> list[Found]:
        """Search scenes in an order; return the markers of each."""
        found: list[Found] = []
        for row in rows:
            try:
                found.append(self.markers(self.scenes.images[row]))
            except PluginError as error:
                self.faults.append(str(error))
                found.append([])
        return found

    def results(self, rows: Sequence[int]) -> list[bytes]:
        """Search scenes in an order; return the bits of each result."""
        return [_bits(found) for found in self.search(rows)]

    def markers(self, image: NDArray[np.uint8]) -> Found:
        """Return the markers of an image."""
        corners, ids, _ = self.find(image, self.scenes.dictionary, max(image.shape))
        numbers = [] if ids is None else np.ravel(ids).tolist()
        return [
            (int(number), np.asarray(quad, dtype=np.float64).reshape(4, 2))
            for number, quad in zip(numbers, corners, strict=True)
        ]

    def judged(self) -> Outcome:
        """Demand IDs, order of corners and centre of the first pixel as they are declared."""
        result = conventions(self.markers_found, self.scenes.marker_id, self.scenes.corners_px)
        if result is None:
            return FAULT, "no marker was found"
        declared, center = (None, None) if self.record is None else (
            self.record.corner_order, self.record.pixel_center)
        numbers = {"offset_px": result.offset_px.tolist(), "rms_px": result.rms_px}
        if faults := order_faults(result, declared, center):
            if self.record is None and faults == offset_fault(result, None):
                return NOTE, f"{faults[0]}: OpenCV's own, which stays in its results", numbers
            return FAULT, "; ".join(faults), numbers
        x, y = result.offset_px
        return OK, (
            f"IDs and order of corners; mean offset ({x:+.3f}, {y:+.3f}) px, RMS beside it "
            f"{result.rms_px:.3f} px"
        ), numbers

    def odd(self) -> list[str]:
        """Search plain, black, noisy and small images; return the errors' lines."""
        generator = np.random.default_rng(1)
        lines = []
        for height, width, low, high in (
            (480, 640, 128, 129), (480, 640, 0, 1), (480, 640, 0, 256), (241, 319, 0, 256),
            (37, 53, 0, 256), (8, 8, 0, 256),
        ):
            image = generator.integers(low, high, (height, width)).astype(np.uint8)
            try:
                self.markers(image)
            except PluginError as error:
                lines.append(f"an image of {width} x {height} px: {error}")
        return lines


class SolverTrial:
    """A solver, and its poses of the scenes' detections."""

    returned = "poses of the right shapes, rotations that are rotations"
    found_key, found_what = "solved", "a pose that reprojects to the corners"
    found_hint = "; expected marker to camera, OpenCV's axes, metres"
    order, survived = "alone, or in reverse order", "tilts of 80 to 85 degrees"

    def __init__(self, pipeline: Pipeline, steep: Pipeline) -> None:
        self.pipeline, self.steep = pipeline, steep
        self.cells = run_cells(pipeline.experiment, [np.arange(SCENES)])
        self.first = self.bits(self.cells)
        self.faults = _raised(self.cells) or self._faults_of_all()
        self.solved = self.column("estimate") == EstimateStatus.solved
        self.asked = int((self.column("detection") == DetectionStatus.detected).sum())
        self.found = int(self.solved.sum())

    def results(self, rows: Sequence[int]) -> list[bytes]:
        """Solve scenes together; return the bits of each result."""
        return self.bits(run_cells(self.pipeline.experiment, [np.array(rows, dtype=np.intp)]))

    @staticmethod
    def bits(cells: CellsResult) -> list[bytes]:
        """Return the bits of the estimate of each scene."""
        columns = [column for name, (column,) in cells.columns.items()
                   if VARIABLES[name].stage is Stage.estimation]
        return [b"".join(np.asarray(value).tobytes() for value in values)
                for values in zip(*columns, strict=True)]

    def column(self, name: str) -> NDArray[Any]:
        """Return a variable of all scenes."""
        values: NDArray[Any] = self.cells.columns[name][0]
        return values

    def _faults_of_all(self) -> list[str]:
        """Return the errors raised when all detected targets are solved in one call.

        A run solves them one by one then, which takes long and hides it.
        """
        experiment = self.pipeline.experiment
        batch = scenes_at(experiment, [np.arange(SCENES)])
        (searched,), _ = detections_of(
            batch, np.ones((SCENES, 1), dtype=bool), [], keep=True)
        (setting,) = experiment.estimators
        rows = np.flatnonzero(searched.flags == DetectionStatus.detected)
        try:
            build(setting)(detections_for(setting, batch, searched, rows))
        except PluginError as error:
            return [str(error)]
        return []

    def judged(self) -> Outcome:
        """Demand poses of the marker in the camera's frame, in metres."""
        if not self.solved.any():
            return FAULT, "no pose was solved"
        turned = float(np.median(self.column("rotation_error_deg")[self.solved]))
        distance = np.linalg.norm(self.column("true_tvec_m")[self.solved], axis=1)
        away = np.linalg.norm(self.column("translation_error_m")[self.solved], axis=1)
        percent = float(np.median(100 * away / distance))
        wrong = turned > MAX_ROTATION_DEG or percent > MAX_POSITION_PERCENT
        return FAULT if wrong else OK, (
            f"median errors {turned:.2g} deg and {percent:.2g} % of the distance"
        )

    def odd(self) -> list[str]:
        """Solve markers that are seen nearly from the side; return the errors' lines."""
        return _raised(run_cells(self.steep.experiment, [np.arange(SCENES)]))


def _bits(found: Found) -> bytes:
    """Return the bits of the markers of an image."""
    return b"".join(number.to_bytes(8, "big", signed=True) + quad.tobytes()
                    for number, quad in found)


def _raised(result: CellsResult) -> list[str]:
    """Return the last lines of the errors that were raised."""
    return [failure.text.strip().splitlines()[-1] for failure in result.failures]


Trial = DetectorTrial | SolverTrial


def returns_what_it_should(trial: Trial) -> Outcome:
    """Demand right shapes and types; nothing is raised, and no image is changed."""
    faults = "; ".join(dict.fromkeys(trial.faults))
    return (FAULT, faults) if faults else (OK, trial.returned)


def finds_markers(trial: Trial) -> Outcome:
    """Demand that large, sharp markers are found, or solved."""
    text, numbers = f"{trial.found_what} in {trial.found} of {trial.asked} scenes", {
        trial.found_key: trial.found}
    if trial.found < max(1, FEWEST_SHARE * trial.asked):
        return FAULT, text + trial.found_hint, numbers
    return OK if trial.found == trial.asked else NOTE, text, numbers


def keeps_conventions(trial: Trial) -> Outcome:
    """Demand the conventions that are declared, or the frames of poses."""
    return trial.judged()


def repeats_itself(trial: Trial) -> Outcome:
    """Demand the same bits for the same input."""
    return _same(_differing(trial, range(SCENES)), "again")


def ignores_order(trial: Trial) -> Outcome:
    """Demand the same bits in another order, alone, and after other input."""
    trial.odd()
    different = _differing(trial, range(SCENES)[::-1])
    alone = sum(_differing(trial, [row]) for row in range(SCENES))
    return _same(max(different, alone), trial.order)


def _differing(trial: Trial, rows: Sequence[int]) -> int:
    """Return how many results differ by a bit when scenes are tried again in an order."""
    again = trial.results(rows)
    return sum(trial.first[row] != bits for row, bits in zip(rows, again, strict=True))


def survives_odd_input(trial: Trial) -> Outcome:
    """Try odd input; errors are noted."""
    lines = "; ".join(dict.fromkeys(trial.odd()))
    return (NOTE, lines) if lines else (OK, trial.survived)


def _same(different: int, how: str) -> Outcome:
    if different:
        return FAULT, f"called {how}, it gives other results in {different} of {SCENES} scenes"
    return OK, f"the same bits, called {how}"


CHECKS: tuple[Callable[[Trial], Outcome], ...] = (
    returns_what_it_should, finds_markers, keeps_conventions, repeats_itself, ignores_order,
    survives_odd_input,
)

#: Kind of plug-in -> the names of its checks.
NAMES = {
    "detector": ("returns markers", "finds markers", "keeps conventions", "repeats itself",
                 "has no memory", "survives odd images"),
    "estimator": ("returns poses", "solves scenes", "keeps frames", "repeats itself",
                  "ignores the batch", "survives odd detections"),
}
