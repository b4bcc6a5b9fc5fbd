"""`sweep check-detector` on OpenCV's own detector and on plug-ins with faults."""

import json
from unittest import mock

import pytest

from support.here import Here
from sweep.cli import main
from sweep.conformance.check import check_detector
from sweep.errors import ArgumentError, PipelineError

DETECTOR = """
import os, sys, time
import cv2
import numpy as np
from sweep.plugins import DetectorPlugin

aruco = cv2.aruco
SEEN, KEPT = [], []

def make(settings, family):
    parameters = aruco.DetectorParameters()
    parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
    inner = aruco.ArucoDetector(aruco.getPredefinedDictionary(getattr(aruco, family)), parameters)
    def search(image):
        SEEN.append(len(SEEN))
        corners, ids, _ = inner.detectMarkers(image)
        corners = np.reshape(corners, (-1, 4, 2)).astype(float)
        ids = np.ravel(ids).astype(int) if len(corners) else np.empty(0, int)
        {body}
        return corners, ids
    return search

DETECTOR = DetectorPlugin(make=make{declared})
"""


@pytest.fixture
def checked(tmp_path):
    def run(body="pass", declared="", *, apart=False, **options):
        (tmp_path / "mine.py").write_text(
            DETECTOR.replace("{body}", body).replace("{declared}", declared)
        )
        options = {"calls": 0, "folder": str(tmp_path), **options}
        if apart:
            return check_detector("mine:DETECTOR", **options)
        with mock.patch("sweep.conformance.check.Child", Here):
            return check_detector("mine:DETECTOR", **options)
    return run


def faults(report):
    return [finding.text for finding in report.findings if finding.verdict == "fault"]


def test_a_detector_that_conforms(checked):
    report = checked()
    assert report.conforms, faults(report)
    assert report.detected == 32
    assert max(map(abs, report.offset_px)) < 0.02
    assert {finding.check for finding in report.findings} == {
        "detects", "conventions", "threads", "history", "odd images",
    }


def test_an_offset_is_told(checked):
    report = checked("corners += 0.5")
    assert faults(report) == ["corners are offset by (0.50, 0.50) px: declare pixel_center = 0.5"]


@pytest.mark.long
@pytest.mark.parametrize(("body", "line"), [
    ("corners = np.roll(corners, 1, axis=1)", "turned by one: declare corner_order = (1, 2, 3, 0)"),
    ("ids = ids + 1", "IDs are wrong in 32 of 32 scenes, always +1"),
    ("image[:] = 0", "changed the image"),
    ("corners += SEEN[-1] * 1e-6", "results depend on what was searched before: 32 of 32"),
    ("return None", "returned a NoneType"),
    ("corners, ids = corners[:0], ids[:0]", "found no marker of DICT_APRILTAG_36h11 in 32 scenes"),
])
def test_a_fault_is_told(checked, body, line):
    report = checked(body)
    assert not report.conforms
    assert line in "\n".join(faults(report))


@pytest.mark.long
def test_what_it_prints_and_what_it_raises_on_odd_images_is_noted(checked):
    report = checked("os.write(1, b'searching'); assert image.shape[0] > 8, 'too small'")
    notes = [finding.text for finding in report.findings if finding.verdict == "note"]
    assert report.conforms
    assert any("prints: 'searching" in note for note in notes)
    assert any("8 x 8 px: " in note and "too small" in note for note in notes)


@pytest.mark.long
def test_a_dictionary_that_is_declared_is_tried_in_the_same_process(checked):
    declared = ", families={'DICT_APRILTAG_36h11': 'DICT_APRILTAG_36h11', 'DICT_4X4_50': 'DICT_%s'}"
    right = checked(declared=declared % "4X4_50")
    assert any(finding.check == "families" for finding in right.findings)
    wrong = checked(declared=declared % "5X5_50")
    assert any("found no marker of DICT_4X4_50" in finding.text for finding in wrong.findings)


@pytest.mark.parametrize(("options", "error", "line"), [
    ({"detector": "nothing"}, PipelineError, "an installed detector plug-in"),
    ({"settings": ["cornerRefinementMetod=none"]}, PipelineError, "cornerRefinementMethod"),
    ({"settings": ["cornerRefinementMethod=['none', 'subpix']"]}, PipelineError, "no axes"),
    ({"dictionary": "DICT_NONE"}, PipelineError, "DICT_NONE"),
    ({"calls": -1}, ArgumentError, "at least 0"),
    ({"time_limit_s": 0}, ArgumentError, "above 0"),
])
def test_what_cannot_be_tried_is_refused(options, error, line):
    with pytest.raises(error, match=line):
        check_detector(options.pop("detector", "opencv"), **options)


@pytest.mark.long
@pytest.mark.parametrize(("body", "declared", "check", "line"), [
    ("os.abort()", "", "survives", "ended its process (SIGABRT) while it searched 32 scenes"),
    ("image.shape[0] > 8 or os._exit(3)", "", "survives",
     "ended its process (exit status 3) while it searched an image of 8 x 8 px"),
    ("time.sleep(60)", "", "returns", "did not return within 3 s while it searched 32 scenes"),
    ("KEPT.append(np.ones(100_000))", "", "memory", "grows by 781"),
    ("import threading; threading.Thread(target=time.sleep, args=(9,), daemon=True).start()", "",
     "threads", "starts 32 threads"),
    ("import subprocess; KEPT.append(subprocess.Popen(['sleep', '9']))", "", "processes",
     "leaves 32 processes running"),
])
def test_crashes_hangs_leaks_threads_and_processes_are_told(checked, body, declared, check, line):
    report = checked(body, declared, apart=True, calls=200, time_limit_s=3 if "60" in body else 30)
    assert line in {
        finding.check: finding.text for finding in report.findings if finding.verdict == "fault"
    }[check]


@pytest.mark.long
def test_the_command_checks_opencv(capsys):
    assert main(["check-detector", "opencv", "--set", "cornerRefinementMethod=apriltag"]) == 0
    assert "OpenCV's own, which stays in its results" in capsys.readouterr().out
    assert main(["check-detector", "opencv", "--json", "--calls", "0"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["conforms"]
    assert result["detected"] == 32


def test_the_command_refuses_in_a_line(capsys):
    assert main(["check-detector", "opencv", "--dictionary", "tagStandard41h12"]) == 2
    assert "one of OpenCV's for its detector" in capsys.readouterr().err
