"""The checks of plug-ins, on OpenCV's own detector, on our solvers, and on plug-ins with faults."""

import json
from unittest import mock

import numpy as np
import pytest

from support.here import Here
from sweep.cli import main
from sweep.conformance.check import check_plugin, judged_corners
from sweep.errors import ArgumentError, PipelineError
from sweep.isolation.child_process import Child
from sweep.plugins import DetectorPlugin

DETECTOR = """
import os, time
import cv2
import numpy as np

SEEN = []

def D(settings, family):
    aruco = cv2.aruco
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    inner = aruco.ArucoDetector(aruco.getPredefinedDictionary(getattr(aruco, family)), parameters)
    def search(image):
        SEEN.append(0)
        corners, ids, _ = inner.detectMarkers(image)
        corners = np.reshape(corners, (-1, 4, 2)).astype(float)
        ids = np.ravel(ids).astype(int) if len(corners) else np.empty(0, int)
        {body}
        return corners, ids
    return search
"""

SOLVER = """
import os
import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

SQUARE = np.array([[-0.5, 0.5, 0], [0.5, 0.5, 0], [0.5, -0.5, 0], [-0.5, -0.5, 0]])
SEEN = []

def solve(detections):
    SEEN.append(0)
    rotation, translation = [], []
    for row, corners in enumerate(detections.corners):
        camera = detections.cameras.matrix(row)
        _, rvec, tvec = cv2.solvePnP(
            SQUARE * detections.size_m[row], corners, camera, None, flags=cv2.SOLVEPNP_SQPNP)
        rotation.append(cv2.Rodrigues(rvec)[0])
        translation.append(tvec.ravel())
    rotation, translation = np.array(rotation), np.array(translation)
    {body}
    return rotation, translation

D = EstimatorPlugin(make=lambda settings: solve)
"""


@pytest.fixture
def checked(tmp_path):
    def run(source, body="pass", **options):
        (tmp_path / "mine.py").write_text(source.replace("{body}", body))
        with mock.patch("sweep.conformance.check.Child", options.pop("child", Here)):
            return check_plugin("mine:D", folder=str(tmp_path), **options)
    return run


def faults(report):
    return report[report.verdict == "fault"].set_index("check").text


def test_what_conforms_passes_six_checks(checked):
    report = checked(DETECTOR)
    assert report.verdict.tolist() == ["ok"] * 6, report
    assert (report.attrs["conforms"], report.attrs["detected"]) == (True, 32)


@pytest.mark.parametrize(("source", "body", "check", "named"), [
    (DETECTOR, "corners += 0.5", "keeps conventions",
     "offset by (0.50, 0.50) px: declare pixel_center = 0.5"),
    (SOLVER, "translation = translation + 1e-9 * len(SEEN)", "repeats itself", "32 of 32"),
    (SOLVER, "translation = translation + 1e-6 * len(rotation)", "ignores the batch", "32 of 32"),
    *(pytest.param(*case, marks=pytest.mark.evidence) for case in (
        (DETECTOR, "corners, ids = corners[:0], ids[:0]", "finds markers", "0 of 32"),
        (DETECTOR, "corners += (len(SEEN) == 100) * 1e-3", "has no memory", "1 of 32"),
        (SOLVER, "translation = translation * 1000", "solves scenes", "metres"),
        (SOLVER, "rotation = rotation.transpose(0, 2, 1)", "keeps frames", "20 deg"),
        (SOLVER, "raise ValueError('none')", "returns poses", "ValueError: none"),
    )),
])
def test_a_fault_is_found_by_its_check(source, body, check, named, checked):
    found = faults(checked(source, body))
    assert named in found[check]


@pytest.mark.system
@pytest.mark.parametrize(("source", "body", "check", "named"), [
    (DETECTOR, "image.shape[0] > 8 or os._exit(3)", "has no memory", "exit status 3"),
    (DETECTOR, "time.sleep(60)", "returns markers", "time limit of 2 s"),
    (SOLVER, "os.abort()", "returns poses", "SIGABRT"),
])
def test_a_crash_or_an_endless_call_ends_the_checks(source, body, check, named, checked):
    report = checked(source, body, child=Child, time_limit_s=2 if "sleep" in body else 60)
    assert named in faults(report)[check]
    assert report.check.iloc[-1] == check


@pytest.mark.parametrize(("name", "options", "error", "named"), [
    ("nothing", {}, ArgumentError, "no such plug-in"),
    ("opencv", {"settings": ["cornerRefinementMetod=none"]}, PipelineError,
     "cornerRefinementMethod"),
    ("opencv", {"settings": ["cornerRefinementMethod=['none', 'subpix']"]}, PipelineError,
     "no axes"),
    ("opencv", {"dictionary": "DICT_NONE"}, PipelineError, "DICT_NONE"),
    ("ippe", {"time_limit_s": 0}, ArgumentError, "above 0"),
])
def test_what_cannot_be_tried_is_refused(name, options, error, named):
    with pytest.raises(error, match=named):
        check_plugin(name, **options)


def test_the_command_checks_a_solver(capsys):
    with mock.patch("sweep.conformance.check.Child", Here):
        assert main(["plugins", "check", "sqpnp", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["kind"], said["conforms"], said["solved"]) == ("estimator", True, 32)
    assert len(said["findings"]) == 6


def truth(count=32):
    """Squares that are turned, and the point reflection of each about (319.5, 239.5)."""
    rng = np.random.default_rng(8)
    angle = rng.uniform(0, 2 * np.pi, count // 2)[:, None] + np.arange(4) * np.pi / 2
    reach = rng.uniform(40, 110, (count // 2, 1))
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=2) * reach[:, :, None]
    corners += rng.uniform(-60, 60, (count // 2, 1, 2)) + np.array([319.5, 239.5])
    return np.concatenate([corners, 2 * np.array([319.5, 239.5]) - corners])


def told_of(change, ids=lambda number: number, **declared):
    corners, marker_id = truth(), np.arange(32) % 16 + 5
    returned = change(corners + np.random.default_rng(3).normal(0, 0.2, corners.shape))
    found = [(np.array([ids(number)]), quad[None])
             for number, quad in zip(marker_id, returned, strict=True)]
    verdict, line, _ = judged_corners(
        found, marker_id, corners, DetectorPlugin(make=print, **declared))
    assert verdict == "fault"
    return line


@pytest.mark.parametrize(("change", "given", "told"), [
    (lambda c: c + 0.5, {}, "1) px: declare pixel_center = 0.5"),
    (lambda c: c - 0.5, {"pixel_center": 0.5}, "declare pixel_center = 0"),
    (lambda c: c + np.array([0.2, -0.1]), {}, "offset by (0.2"),
    (lambda c: np.roll(c, 1, axis=1), {"corner_order": (1, 0, 3, 2)},
     "in another order: declare corner_order = (0, 3, 2, 1)"),
    (lambda c: np.roll(c, 2, axis=1), {}, "declare corner_order = (2, 3"),
    (lambda c: c[:, [1, 0, 3, 2]], {}, "declare corner_order = (1"),
    (lambda c: c[..., ::-1], {}, "no pixels (x, y)"),
    (lambda c: np.array([quad[np.lexsort(quad.T)] for quad in c]), {}, "in no fixed order"),
    (lambda c: c, {"ids": lambda number: number + 1},
     "IDs are wrong in 32 of 32 scenes: 6 for marker 5"),
    (lambda c: c, {"ids": lambda number: number if number % 4 else 700},
     "IDs are wrong in 8 of 32 scenes: 700 for marker 8"),
])
def test_a_wrong_convention_is_told_with_what_to_declare(change, given, told):
    assert told in told_of(change, **given)
