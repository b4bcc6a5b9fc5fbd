"""The guide's plug-ins: each is one short file, and does what plain NumPy or a closed form says."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from support.blocks import run_cells
from sweep.evaluation.inspection import scene_image
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus

FOLDER = Path(__file__).parents[2] / "pipelines" / "plugins"

SCENE = """
[camera]
width_px = 160
height_px = 120
fx_px = 200
fy_px = 200
[marker]
size_m = 0.05
marker_id = 3
[pose]
distance_m = 0.2
tilt_deg = 35
azimuth_deg = 20
roll_deg = 12
"""


def pipeline_of(text, **options):
    return Pipeline.from_text(text, folder=FOLDER, **options)


def test_the_pipeline_runs_with_all_four():
    pipeline = Pipeline.from_toml(FOLDER / "plugins.toml", ["trial=2", "side_px=60"])
    assert {plugin.kind for plugin in pipeline.plugins} == {
        "detector", "estimator", "effect", "renderer",
    }
    cells = run_cells(pipeline, [index.ravel() for index in np.indices((2, 2, 2))])
    assert not cells.failures
    assert (np.array(cells.columns["detection"]) == DetectionStatus.detected).all()
    assert (np.array(cells.columns["estimate"]) == EstimateStatus.solved).all()


def test_the_renderer_samples_each_pixel_at_its_centre():
    images = [
        scene_image(pipeline_of(SCENE + f'[scene]\nrenderer = "{name}"\nbackground = 90\n'),
                    whole_frame=True)
        for name in ("sampled:RENDERER", "supersample-1")
    ]
    np.testing.assert_array_equal(*images)
    assert len(np.unique(images[0])) == 3


def test_the_effect_is_that_of_plain_numpy():
    lit = SCENE + "[scene]\nbackground = 120\nwhite = 180\nflicker_rows = 40\n"
    plain, bands = (
        scene_image(
            pipeline_of('effects = ["flicker:EFFECT"]\n' + lit, settings=[f"flicker={strength}"]),
            whole_frame=True,
        )
        for strength in (0, 0.25)
    )
    wave = 1 + 0.25 * np.sin(2 * np.pi * np.arange(120) / 40)[:, None]
    # Where the neighbours are equal the plain image is not rounded.
    flat = cv2.dilate(plain, np.ones((3, 3))) == cv2.erode(plain, np.ones((3, 3)))
    assert flat.mean() > 0.8
    expected = np.clip(np.floor(plain * wave + 0.5 + 1e-9), 0, 255)
    np.testing.assert_array_equal(bands[flat], expected[flat])
    assert abs(bands - plain * wave).max() <= 0.5 + 0.5 * 1.25
