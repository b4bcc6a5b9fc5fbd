"""The viewing angle is a variable of every scene: the true one, also where nothing can be seen."""

import numpy as np

from support.blocks import run_cells
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus

EXACT_DEG = 2e-13
"""A few roundings of 1.1e-16 rad."""


def test_it_is_the_angle_between_normal_and_line_of_sight():
    tilts, azimuths, bearings = (0, 60, 180), (0, 90), (-80, 0, 25)
    shape = len(tilts), len(azimuths), len(bearings), 2
    columns = run_cells(Pipeline.from_dict({
        "marker": {"size_m": 0.05}, "pose": {"jitter_px": 2, "distance_m": 0.4},
        "axes": {"tilt_deg": list(tilts), "azimuth_deg": list(azimuths),
                 "bearing_x_deg": list(bearings), "trial": 2},
    }), [index.ravel() for index in np.indices(shape)]).columns
    angle, centre = columns["viewing_angle_deg"][0], columns["true_tvec_m"][0]
    assert angle.dtype == np.float64
    assert (columns["detection"][0] == DetectionStatus.not_visible).any()
    tilt, azimuth = (
        np.radians(np.broadcast_to(each, shape).ravel()) for each in (
            np.reshape(tilts, (-1, 1, 1, 1)), np.reshape(azimuths, (-1, 1, 1)))
    )
    # The normal of Rot(axis, tilt) · (0, 0, -1), by Rodrigues' formula.
    normal = np.column_stack(
        [-np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), -np.cos(tilt)])
    cosine = -(normal * centre).sum(axis=1) / np.linalg.norm(centre, axis=1)
    # The arc cosine has half the digits near 0 and 180°.
    np.testing.assert_allclose(angle, np.degrees(np.arccos(np.clip(cosine, -1, 1))), atol=2e-6)
    away = np.degrees(np.arctan2(np.hypot(*centre[:, :2].T), centre[:, 2]))
    for parallel, expected in ((tilt == 0, away), (tilt == np.pi, 180 - away)):
        np.testing.assert_allclose(angle[parallel], expected[parallel], atol=EXACT_DEG)
