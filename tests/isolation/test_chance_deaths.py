"""A plug-in that ends its process once in a while: no other result suffers, and none is false."""

import json

import pytest
import xarray as xr

from support.commands import command
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus

pytestmark = pytest.mark.system


PLUGINS = '''
import os
from pathlib import Path

import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

CALLS = Path(__file__).parent / "calls"

def ends(calls):
    """End the process at some of the calls, which are numbered over all processes."""
    number = len(CALLS.read_bytes()) if CALLS.exists() else 0
    with CALLS.open("ab") as file:
        file.write(b".")
    if number in calls:
        os.abort()

def detector(calls):
    def make(settings, family):
        search = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))).detectMarkers
        def find(image):
            if image.max() > 200:  # not the blank frame before the run
                ends(calls)
            corners, ids, _ = search(image)
            return ([], []) if ids is None else (np.concatenate(corners), ids.ravel())
        return find
    return make

third, second = detector(range(0, 10**6, 3)), detector(range(1, 10**6, 2))
always = detector(range(10**6))

def solve(detections):
    ends(range(0, 10**6, 3))
    upright = np.diag([1.0, -1.0, -1.0])
    return np.tile(upright, (len(detections.corners), 1, 1)), np.tile([0, 0, 1.0], (
        len(detections.corners), 1))

SOLVER = EstimatorPlugin(make=lambda _: solve, meaning="upright")
'''

GRID = """
seed = 7
[camera]
width_px = 128
height_px = 96
[marker]
size_m = 0.05
[pose]
side_px = 48
jitter_px = 0.5
[axes]
detector = ["opencv", {detectors}]
solver = ["ippe_square", {solver}]
trial = 3
"""


def pipeline_of(folder, *detectors, solver="iterative"):
    (folder / "chance.py").write_text(PLUGINS)
    words = ", ".join(f'"chance:{name}"' for name in detectors) or '"chance:unused"'
    text = GRID.format(detectors=words, solver=f'"{solver}"')
    if not detectors:
        text = text.replace(f", {words}", "")
    (folder / "grid.toml").write_text(text)
    return Pipeline.from_toml(folder / "grid.toml")


@pytest.mark.evidence
@pytest.mark.parametrize(("detectors", "solver"), [(["second"], "iterative"),
                                                   ([], "chance:SOLVER")])
def test_a_run_with_a_plug_in_that_dies_by_chance_keeps_all_of_opencv_s(
    detectors, solver, tmp_path
):
    pipeline_of(tmp_path, *detectors, solver=solver)
    ran = command("run", tmp_path / "grid.toml", "--store", tmp_path / "a.zarr", "--json",
                  cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert (told["crashed"], told["failed"]) == (0, 0)
    with xr.open_zarr(tmp_path / "a.zarr") as results:
        assert (results.detection == DetectionStatus.detected).all()
        assert (results.estimate.sel(solver="ippe_square") == EstimateStatus.solved).all()
