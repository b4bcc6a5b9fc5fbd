"""The picture of one scene: a small marker is seen in it."""

import cv2
import numpy as np
import pytest

from sweep.evaluation.inspection import inspect_scene
from sweep.experiment.pipeline import Pipeline, cell
from sweep.report.scenes import TRUTH, scene_png

FRAME = {
    "camera": {"width_px": 1600, "height_px": 1200, "fx_px": 1000},
    "scene": {"background": 120}, "pose": {"azimuth_deg": {"uniform": [0, 360]}, "tilt_deg": 30},
    "axes": {"bearing_x_deg": [-30, 0, 30], "side_px": [12, 60, 700], "trial": 2},
}


def share_of(picture, colour, box):
    x0, y0, x1, y1 = box
    blue_green_red = list(bytes.fromhex(colour[1:]))[::-1]
    return float((picture[y0:y1, x0:x1] == blue_green_red).all(axis=2).mean())


@pytest.mark.parametrize(("bearing", "corner"), [(-30, "right"), (30, "left")])
def test_a_small_marker_is_enlarged_in_the_corner_that_is_farthest_from_it(bearing, corner):
    pipeline = cell(Pipeline.from_dict(FRAME), f"bearing_x_deg={bearing},side_px=60")
    scene = inspect_scene(pipeline, whole_frame=True)
    picture, plain = (
        cv2.imdecode(np.frombuffer(scene_png(scene, title), np.uint8), cv2.IMREAD_COLOR)
        for title in ("title", ""))
    left, right = (0, 0, 600, 1200), (1000, 0, 1600, 1200)
    assert share_of(picture, TRUTH, right if corner == "right" else left) > 0.0005
    assert plain.shape == (1200, 1600, 3)
    assert share_of(plain, TRUTH, right if corner == "right" else left) == 0
    assert picture.shape[0] > plain.shape[0]
