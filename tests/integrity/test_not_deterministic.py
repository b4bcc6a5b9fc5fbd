"""A plug-in whose answers change is named; verify and repair do not take it for damage in turns."""

import json
from unittest import mock

import cv2
import numpy as np
import pytest

from support.here import Here
from sweep import cli
from sweep.execution.runner import execute
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.repair import repair
from sweep.integrity.verification import verify

PLUGINS = """
import itertools
import cv2
import numpy as np

COUNT = itertools.count()
SQUARE = 0.005 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def shifted(shift):
    def solve(detections):
        rotations, translations = [], []
        for row, corners in enumerate(detections.corners):
            camera = detections.cameras.matrix(row)
            _, rvec, tvec = cv2.solvePnP(
                SQUARE, corners, camera, None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
            rotations.append(cv2.Rodrigues(rvec)[0])
            translations.append(tvec.ravel())
        return np.array(rotations), np.array(translations) + shift()
    return lambda settings: solve


right = shifted(lambda: 0)
counting = shifted(lambda: 1e-6 * next(COUNT))


def search(settings, family):
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
    inner = cv2.aruco.ArucoDetector(dictionary)
    def find(image):
        corners, ids, _ = inner.detectMarkers(image)
        if ids is None:
            return [], []
        return np.concatenate(corners) + 1e-6 * next(COUNT), ids.ravel()
    return find
"""

TEXT = """
[pose]
side_px = {{ uniform = [40, 60] }}
tilt_deg = 30
azimuth_deg = 40
[detector]
detector = "{detector}"
[axes]
solver = {solvers}
trial = 12
"""


@pytest.fixture
def made(tmp_path):
    def run(detector="opencv", *solvers):
        (tmp_path / "mine.py").write_text(PLUGINS)
        text = TEXT.format(detector=detector, solvers=json.dumps(list(solvers) or ["ippe_square"]))
        (tmp_path / "grid.toml").write_text(text)
        store = tmp_path / "grid.zarr"
        execute(Pipeline.from_toml(tmp_path / "grid.toml"), store, workers=None)
        return str(store)
    with mock.patch("sweep.isolation.crash_isolation.Child", Here):
        yield run


@pytest.mark.parametrize(("detector", "solvers", "named"), [
    ("opencv", ["mine:counting", "mine:right"], "mine:counting"),
    ("mine:search", ["mine:right"], "mine:search"),
])
def test_what_changes_from_call_to_call_is_named_and_no_block_is_damaged(
    detector, solvers, named, made, capsys
):
    store = made(detector, *solvers)
    for report in (repair(store), verify(store)):  # they do not alternate
        (finding,) = report.damage
        assert finding.where == report.unstable == named
        assert finding.what.startswith(f"not deterministic: {named}: ")
        assert report.repaired == []
    assert cli.main(["verify", store]) == 1
    out = capsys.readouterr().out
    assert f"not deterministic: {named}" in out
    assert "damaged" not in out


def test_a_changed_number_of_a_plug_in_that_is_deterministic_is_damage(made, monkeypatch):
    store = made("opencv", "mine:right")
    assert verify(store).damage == []
    solve = cv2.solvePnP

    def other(*arguments, **options):
        done, rvec, tvec = solve(*arguments, **options)
        return done, rvec, tvec * np.float64(1.001)

    monkeypatch.setattr(cv2, "solvePnP", other)
    report = verify(store)
    assert report.damage
    assert report.unstable == ""
