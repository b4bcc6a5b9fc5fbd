"""Golden digests: when the numbers change, their version must."""

import hashlib

import numpy as np

from sweep.engine.provenance import NUMBERS_VERSION
from sweep.measure.solver import estimate
from sweep.model.renderers import render
from sweep.model.extent import marker_boxes
from sweep.model.scene import build_scenes
from sweep.plan.grid import scene_values
from sweep.plan.pipeline import Pipeline

TEXT = """
seed = 11
[camera]
width_px = 320
height_px = 240
[marker]
size_m = 0.05
[pose]
jitter_px = 1
azimuth_deg = { uniform = [0, 360] }
roll_deg = { normal = [0, 40] }
[scene]
background = 77
black = 12
white = 243
[axes]
distortion = [[], [-0.3, 0.1, 0.001, 0.002]]
renderer = ["exact", "supersample-2", "supersample-2-jittered"]
dictionary = ["DICT_4X4_50", "DICT_APRILTAG_36h11"]
tilt_deg = [0, 33, 71]
distance_m = [0.12, 0.4, 1.1]
trial = 2
"""

# Version of the numbers -> digest of the draws and poses, of the images, and of the solved poses.
# Independent of OpenCV's version: it makes neither images nor, to 1e-6, noise-free poses.
GOLDEN = {1: ("444ab255354eab6c", "d3a2eb2642834a07", "762609d8f161cf15")}


def digest(array):
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16]


def test_numbers_change_only_with_their_version():
    pipeline = Pipeline.from_text(TEXT)
    shape = [len(axis) for axis in pipeline.axes]
    indices = [grid.ravel() for grid in np.indices(shape)]
    scenes = build_scenes(scene_values(pipeline, indices), len(indices[0]))
    boxes = marker_boxes(scenes)
    images = hashlib.sha256()
    for row in range(len(scenes)):
        images.update(render(scenes, row, boxes[row], (0, 0, 320, 240)).tobytes())
    poses = np.concatenate([scenes.rotation.reshape(-1, 9), scenes.translation], axis=1)
    # Adding a half-way offset keeps values that are exact in decimals off the rounding's edge.
    posed = np.floor(poses * 1e9 + 0.3).astype(np.int64)
    solved = estimate(
        scenes.corners_px, scenes.cameras, scenes.size_m, "ippe_square", True, 0.25
    )
    estimated = np.floor(solved.translation * 1e6 + 0.3).astype(np.int64)
    made = (
        digest(posed), images.hexdigest()[:16], digest(estimated)
    )
    assert made == GOLDEN[NUMBERS_VERSION], made
