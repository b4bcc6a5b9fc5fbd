"""A plug-in that ends its process once in a while: no other result suffers, and none is false."""

import json

import pytest
import xarray as xr

from support.commands import command
from sweep.measure.flags import DetectionStatus, EstimateStatus

pytestmark = pytest.mark.system


PLUGINS = '''
import os
from pathlib import Path

import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

CALLS = Path(__file__).parent / "calls"

def ends(every):
    """End the process at some of the calls, which are numbered over all processes."""
    number = len(CALLS.read_bytes()) if CALLS.exists() else 0
    with CALLS.open("ab") as file:
        file.write(b".")
    if number % every == every - 1:
        os.abort()

def second(settings, family):
    search = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))).detectMarkers
    def find(image):
        if image.max() > 200:  # not the blank frame before the run
            ends(2)
        corners, ids, _ = search(image)
        return ([], []) if ids is None else (np.concatenate(corners), ids.ravel())
    return find

def solve(detections):
    ends(3)
    count = len(detections.corners)
    return np.tile(np.diag([1.0, -1.0, -1.0]), (count, 1, 1)), np.tile([0, 0, 1.0], (count, 1))

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
detector = ["opencv"]
solver = ["ippe_square"]
trial = 3
"""


@pytest.mark.evidence
@pytest.mark.parametrize(("usual", "dying"), [
    ('["opencv"]', '["opencv", "chance:second"]'),
    ('["ippe_square"]', '["ippe_square", "chance:SOLVER"]'),
], ids=["detector", "solver"])
def test_a_run_with_a_plug_in_that_dies_by_chance_keeps_all_of_opencv_s(usual, dying, tmp_path):
    (tmp_path / "chance.py").write_text(PLUGINS)
    (tmp_path / "grid.toml").write_text(GRID.replace(usual, dying))
    ran = command("run", "grid.toml", "--store", "a.zarr", "--json", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert (told["crashed"], told["failed"]) == (0, 0)
    with xr.open_zarr(tmp_path / "a.zarr") as results:
        assert (results.detection == DetectionStatus.detected).all()
        assert (results.estimate.sel(solver="ippe_square") == EstimateStatus.solved).all()
