"""Whether a plug-in does what it declares: six checks of detectors, and of solvers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from sweep.errors import ArgumentError, PipelineError, PluginError
from sweep.evaluation.block import detections_for
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.results import Failure
from sweep.evaluation.search import detections_of, scenes_at
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Child, ChildError
from sweep.measure.detectors import FITS, OPENCV, PluginSetting, fitting_order
from sweep.measure.estimation import Estimates, pose_error
from sweep.measure.estimators import SOLVERS, build
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.marker import dictionary_names, marker_count, missing_package
from sweep.model.scene import Scenes
from sweep.plugins import DetectorPlugin
from sweep.plugins.loading import DeclaredPlugin, described
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# The scenes on which plug-ins are tried: free of noise, and each with its point reflection.

SCENES = 32
RANGES = {
    "azimuth_deg": (0, 180), "roll_deg": (0, 180), "tilt_deg": (0, 45), "bearing_x_deg": (-8, 8),
    "bearing_y_deg": (-8, 8),
}

#: Frames in which no marker can be seen: plain, and noise of all grey levels; some of few pixels.
ODD = {
    "width_px": (640, 640, 640, 319, 53, 8), "height_px": (480, 480, 480, 241, 37, 8),
    "background": (128, 0, 128, 128, 128, 128), "noise_grey": (0, 0, 100, 100, 100, 100),
    "side_px": (0.01,) * 6,
}


def trial_pipeline(
    kind: str, name: str, dictionary: str, settings: Sequence[str], folder: str,
    of_boards: bool = False, count: int = SCENES,
) -> Pipeline:
    """Return the pipeline of ``count`` scenes and one setting of a detector, or of a solver.

    Scene i + count/2 is scene i turned by 180° about the image's centre, exactly. Behind them are
    count/2 scenes that are seen nearly from the side, and the frames of :data:`ODD`. What settings
    give is the same in all of them.

    Raises
    ------
    PipelineError
        If there is no such detector or solver, or a setting is not valid.
    """
    rng, half = np.random.default_rng(20), count // 2
    drawn = pd.DataFrame({name: rng.uniform(*ends, half) for name, ends in RANGES.items()})
    drawn = drawn.assign(width_px=640, height_px=480, side_px=np.geomspace(60, 150, half).round(2))
    if not of_boards and dictionary in dictionary_names():  # an unknown one is refused below
        drawn["marker_id"] = rng.integers(marker_count(dictionary), size=half)
    reflected = drawn.copy()
    reflected[["azimuth_deg", "roll_deg"]] += 180
    reflected[["bearing_x_deg", "bearing_y_deg"]] *= -1
    steep = drawn.assign(tilt_deg=rng.uniform(80.0, 85.0, half))
    scenes = pd.concat([drawn, reflected, steep, pd.DataFrame(ODD)]).fillna(0).round(6)
    names = [each.partition("=")[0].rpartition(".")[2].strip() for each in settings]
    scenes = scenes.drop(columns=names, errors="ignore")
    document: dict[str, Any] = {
        "title": "Conformance", "camera": {"fx_px": 600.0, "fy_px": 600.0},
        "marker": {"dictionary": dictionary}, "scene": {"window": "full"},
        "detector": {"detector": name},
        "axes": {"trial_scene": {"zip": scenes.drop_duplicates().convert_dtypes().to_dict("list")}},
    }
    if kind == "estimator":
        document["detector"] = {"detector": OPENCV, "cornerRefinementMethod": "subpix"}
        document["estimator"] = {"solver": name}
    if of_boards:
        document["board"] = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.002}
    pipeline = Pipeline.from_dict(document, settings, source="plugins check", folder=folder)
    if len(pipeline.axes) > 1:
        raise PipelineError(["plugins check: a plug-in is tried with one setting: no axes"])
    return pipeline


# --------------------------------------------------------------------------------------------------
# Answers of a detector, or of a solver, to numbered scenes, held against the truth.

OK, NOTE, FAULT = "ok", "note", "fault"


class Finding(NamedTuple):
    """The result of one check: "ok", "note" or "fault", a line, and numbers by name."""

    verdict: str
    text: str
    numbers: Mapping[str, Any] = {}


#: Answer to a scene, empty where nothing was found: a detector's IDs (n,) and corners (n, 4, 2) px,
#: or all numbers of a solver's estimate.
Answer = tuple[Any, ...]

#: Largest mean offset of a detector that conforms, and standard errors that are allowed beside it.
MAX_OFFSET_PX, STANDARD_ERRORS = 0.02, 4.0

#: Largest median errors of a solver that has the right frames and units.
MAX_ROTATION_DEG, MAX_POSITION_PERCENT = 5.0, 5.0


def answers_to(pipeline: Pipeline, kind: str, numbers: Sequence[int]) -> list[Answer]:
    """Search scenes of a trial together, in an order, and solve them if a solver is tried.

    Raises
    ------
    PluginError
        If the plug-in raises, or returns what cannot be an answer.
    """
    batch, failures = scenes_at(pipeline.experiment, [np.array(numbers)]), list[Failure]()
    (found,) = detections_of(batch, batch.visible[:, None], failures, keep=True)
    if failures:
        raise PluginError(failures[0].text.strip().rpartition("\n")[2].split(": ", 1)[-1])
    answers: list[Answer] = [()] * len(numbers)
    if kind == "detector":
        for row, output in found.outputs.items():
            if output.ids is not None:
                corners = np.reshape(output.corners, (-1, 4, 2)).astype(np.float64)
                answers[row] = np.ravel(output.ids), corners
        return answers
    (setting,), rows = batch.experiment.estimators, np.flatnonzero(
        found.flags == DetectionStatus.detected)
    estimates = build(setting)(detections_for(setting, batch, found, rows))
    columns = [getattr(estimates, each.name) for each in dataclasses.fields(Estimates)]
    for row, estimate in zip(rows.tolist(), zip(*columns, strict=True), strict=True):
        answers[row] = estimate if estimate[0] == EstimateStatus.solved else ()
    return answers


def judged_poses(answers: Sequence[Answer], scenes: Scenes) -> Finding:
    """Demand poses of the marker in the camera's frame, in metres, in N scenes."""
    rows = [row for row, answer in enumerate(answers) if answer]
    if not rows:
        return Finding(FAULT, "no pose was solved")
    found = Estimates(*map(np.array, zip(*filter(None, answers), strict=True)))
    truth = scenes.translation[rows]
    error = pose_error(found.rotation, found.translation, scenes.rotation[rows], truth)
    away = np.linalg.norm(error.translation_m, axis=1) / np.linalg.norm(truth, axis=1)
    turned, percent = np.degrees(np.median(error.rotation_angle_rad)), 100 * np.median(away)
    return Finding(
        OK if turned <= MAX_ROTATION_DEG and percent <= MAX_POSITION_PERCENT else FAULT,
        f"median errors {turned:.2g} deg and {percent:.2g} % of the distance")


def judged_corners(
    answers: Sequence[Answer], marker_id: Integers, corners_px: Floats,
    declared: DetectorPlugin | None,
) -> Finding:
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
    ids, found = np.full(len(marker_id), -1), np.full(corners_px.shape, np.nan)
    for row, (numbers, quads) in ((row, each) for row, each in enumerate(answers) if each):
        away = np.linalg.norm((quads - corners_px[row]).mean(axis=1), axis=1)
        best = np.lexsort([away, numbers != marker_id[row]])[0]
        ids[row], found[row] = numbers[best], quads[best]
    rows = np.flatnonzero(ids >= 0)
    if not len(rows):
        return Finding(FAULT, "no marker was found")
    x, y = offset = np.nanmean(found - corners_px, axis=(0, 1))  # in whichever order
    order, distance = fitting_order(found[rows] - offset, corners_px[rows])
    error = found[:, order] - corners_px
    rms_px = float(np.sqrt(np.nanmean(((error - offset) ** 2).sum(axis=2))))
    numbers = {"offset_px": offset.tolist(), "rms_px": rms_px}

    faults, wrong = [], rows[ids[rows] != marker_id[rows]]
    if len(wrong):
        faults.append(f"IDs are wrong in {len(wrong)} of {len(rows)} scenes: "
                      f"{ids[wrong[0]]} for marker {marker_id[wrong[0]]}")
    if distance > FITS:
        faults.append("corners are in no fixed order of the marker, or are no pixels (x, y)")
    elif order != (0, 1, 2, 3):
        own = declared.corner_order if declared else range(4)
        faults.append("corners are in another order: declare "
                      f"corner_order = {tuple(int(own[index]) for index in order)}")
    if faults:
        return Finding(FAULT, "; ".join(faults), numbers)

    # Errors that belong to the marker cancel in the mean of a scene and its reflection.
    pairs = error.mean(axis=1).reshape(2, -1, 2).mean(axis=0)
    pairs = pairs[np.isfinite(pairs[:, 0])]
    spread = pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs)) if len(pairs) > 1 else np.zeros(2)
    if (np.abs(offset) <= MAX_OFFSET_PX + STANDARD_ERRORS * spread).all():
        line = f"mean offset ({x:+.3f}, {y:+.3f}) px, RMS beside it {rms_px:.3f} px"
        return Finding(OK, line, numbers)
    line = f"corners are offset by ({x:.2f}, {y:.2f}) px"
    if declared is None:
        return Finding(NOTE, f"{line}: OpenCV's own, which stays in its results", numbers)
    step = round(2 * offset.mean()) / 2
    center = declared.pixel_center + step
    if step and abs(center) <= 1 and (np.abs(offset - step) < 0.1).all():
        line += f": declare pixel_center = {center:g}"
    return Finding(FAULT, line, numbers)


# --------------------------------------------------------------------------------------------------
# The six checks, which run in a child process that the plug-in may end or never leave.

#: Share of the scenes in which a marker must be found, or solved: all are large and sharp.
FEWEST_SHARE = 0.75

PREFERRED = "DICT_APRILTAG_36h11"

CHECKS = {
    "detector": ("returns markers", "finds markers", "keeps conventions", "repeats itself",
                 "has no memory", "survives odd images"),
    "estimator": ("returns poses", "solves scenes", "keeps frames", "repeats itself",
                  "ignores the batch", "survives odd detections"),
}


def findings_of(kind: str, pipeline: Pipeline) -> Iterator[Finding]:
    """Yield the findings of the six checks in their order; a PluginError ends them."""
    answers, every = partial(answers_to, pipeline, kind), range(SCENES)
    first = answers(every)
    yield Finding(OK, "right shapes and types")

    found, word, hint = sum(map(bool, first)), "detected", ""
    if kind == "estimator":
        word, hint = "solved", "; expected poses of marker to camera, OpenCV's axes, metres"
    verdict = OK if found == SCENES else NOTE if found >= FEWEST_SHARE * SCENES else FAULT
    line = f"{word} in {found} of {SCENES} scenes{hint * (verdict == FAULT)}"
    yield Finding(verdict, line, {word: found})

    scenes = scenes_at(pipeline.experiment, [np.array(every)]).scenes
    if kind == "detector":
        (setting,) = pipeline.experiment.detectors
        record = setting.record() if isinstance(setting, PluginSetting) else None
        yield judged_corners(first, scenes.marker_id, scenes.corners_px, record)
    else:
        yield judged_poses(first, scenes)

    def same(orders: Sequence[Sequence[int]], how: str) -> Finding:
        """Demand the same bits in other calls."""
        different = {number for order in orders
                     for number, answer in zip(order, answers(order), strict=True)
                     if _bits(answer) != _bits(first[number])}
        if different:
            return Finding(FAULT, f"{len(different)} of {SCENES} scenes differ, called {how}")
        return Finding(OK, f"the same bits, called {how}")

    yield same([every], "again")

    told = dict[str, None]()
    for number in range(SCENES, len(pipeline.axes[0])):
        try:
            answers([number])
        except PluginError as error:
            width, height = scenes_at(pipeline.experiment, [np.array([number])]).scenes.frame[0]
            told[f"a frame of {width} x {height} px: {error}"] = None
    yield same([every[::-1], *([row] for row in every)], "in reverse order, alone, after odd input")

    yield Finding(NOTE if told else OK, "; ".join(told) or "no error")


def _bits(answer: Answer) -> bytes:
    return b"".join(np.asarray(part).tobytes() for part in answer)


#: In the child: the checks that are under way.
_running: list[Iterator[Finding]] = []


@single_threaded()
def _next(number: int, kind: str, pipeline: Pipeline) -> Finding:
    """Return the finding of the next check of :func:`trial_pipeline`'s plug-in; number 0 begins."""
    if number == 0:
        _running[:] = [findings_of(kind, pipeline)]
    return next(_running[0])


def check_plugin(
    name: str, dictionary: str | None = None, settings: Sequence[str] = (), *,
    folder: str = ".", time_limit_s: float = 120.0,
) -> pd.DataFrame:
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

    Returns
    -------
    DataFrame
        A row for each check in their order, with the columns "check", "verdict" ("ok", "note" or
        "fault") and "text"; checks after one that raises, ends its process or does not return are
        missing. Attributes: "name", "kind" ("detector" or "estimator"), the "dictionary" of the
        markers, "versions" of the distributions that the plug-in is made of, whether it "conforms",
        and measurements: "detected", "offset_px", "rms_px"; "solved".

    Raises
    ------
    ArgumentError, PipelineError
        If there is no such plug-in, dictionary or setting.
    """
    if not 0 < time_limit_s < float("inf"):
        raise ArgumentError("time_limit_s", time_limit_s, "expected seconds above 0")
    if name == OPENCV or name in SOLVERS:
        tried = [DeclaredPlugin("detector" if name == OPENCV else "estimator", name)]
    else:
        tried = [each for each in described(name, folder) if each.kind in CHECKS]
    if not tried:
        raise ArgumentError("name", name, "expected a detector or a solver; runs check the others")
    plugin = tried[0]
    if dictionary is None:
        known = sorted(plugin.dictionaries or (PREFERRED,), key=lambda each: each != PREFERRED)
        dictionary = next((each for each in known if missing_package(each) is None), known[0])
    pipeline = trial_pipeline(plugin.kind, name, dictionary, settings, folder, plugin.of_boards)
    findings = dict[str, Finding]()
    with Child("sweep.conformance.check") as child:
        for number, check in enumerate(CHECKS[plugin.kind]):
            try:
                findings[check] = child.call(
                    _next, number, plugin.kind, pipeline, limit_s=time_limit_s)
            except (ChildError, PluginError) as error:
                findings[check] = Finding(FAULT, getattr(error, "line", str(error)))
                break
    report = pd.DataFrame(
        [(check, *found[:2]) for check, found in findings.items()],
        columns=["check", "verdict", "text"])
    report.attrs = {
        "name": name, "kind": plugin.kind, "dictionary": dictionary,
        "versions": dict(plugin.versions), "conforms": bool((report["verdict"] != FAULT).all()),
        **{key: found.numbers[key] for found in findings.values() for key in found.numbers}}
    return report
