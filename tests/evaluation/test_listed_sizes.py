"""Markers of a board with IDs and sides of their own are those that are printed."""

import numpy as np
import pytest

from support.blocks import run_cells
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import BoundStatus, DetectionStatus

ONE = {"marker_id": 7, "x_m": 0, "y_m": 0, "size_m": 0.05}
OTHER = {"marker_id": 3, "x_m": 0.07, "y_m": 0, "size_m": 0.04}


def run(default, markers):
    result = run_cells(Pipeline.from_dict({
        "camera": {"width_px": 320, "height_px": 240, "fx_px": 300},
        "marker": {"dictionary": "DICT_4X4_50", "size_m": default},
        "pose": {"distance_m": 0.3, "tilt_deg": 10},
        "scene": {"black": 40, "white": 200, "background": 120, "noise_grey": 2,
                  "bound": "known_blur"},
        "detector": {"cornerRefinementMethod": "subpix"}, "estimator": {"solver": "sqpnp"},
        "board": {"kind": "markers", "markers": markers},
    }), [])
    assert not result.failures
    return {name: parts[0][0] for name, parts in result.columns.items()}


@pytest.mark.parametrize("default", [0.05, 0.02])
@pytest.mark.parametrize("listed", [[ONE], [ONE, OTHER], [ONE, OTHER | {"z_m": 0.01}]])
def test_listed_ids_and_sides_are_printed_whatever_the_default_side(default, listed):
    columns = run(default, listed)
    assert (columns["marker_detection"] == DetectionStatus.detected).all()
    # Of markers 40 and 50 px wide; drawn by another side they would be 5 px off.
    assert np.abs(columns["marker_corner_error_px"]).max() < 1
    assert np.abs(columns["translation_error_m"]).max() < 0.01
    assert columns["bound"] == BoundStatus.given
    np.testing.assert_allclose(
        columns["bound_std"], run(0.05, listed)["bound_std"], rtol=1e-9
    )
