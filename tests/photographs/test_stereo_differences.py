"""Poses in both images of a stereo camera, compared without truth: against SciPy's rotations."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import Rotation

from sweep.errors import SweepError
from sweep.measure.flags import EstimateStatus
from sweep.photographs.stereo_differences import stereo_differences

TURN = Rotation.from_rotvec([0.02, -0.1, 0.03])
SHIFT = np.array([-0.06, 0.001, 0.002])


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / "rig.yml"
    numbers = {
        "K1": [800, 0, 320, 0, 800, 240, 0, 0, 1], "K2": [800, 0, 320, 0, 800, 240, 0, 0, 1],
        "D1": [0] * 5, "D2": [0] * 5, "R": TURN.as_matrix().ravel().tolist(), "T": SHIFT.tolist(),
    }
    shapes = {"K1": (3, 3), "K2": (3, 3), "R": (3, 3), "D1": (1, 5), "D2": (1, 5), "T": (3, 1)}
    lines = ["%YAML:1.0", "---"]
    for name, values in numbers.items():
        rows, columns = shapes[name]
        lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}",
                  "   dt: d", f"   data: {[float(each) for each in values]}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def results_of(rng, estimated, truth):
    """Return the results of poses (2, 8, 5) that were estimated, and what was taken for true."""
    shape = (8, 5)
    dims = ("trial", "marker_id", "stereo_camera")
    error = [estimated[0][c] * truth[0][c].inv() for c in range(2)]
    missed = rng.random((*shape, 2)) < 0.1

    def stack(values):
        return np.stack([each.reshape(*shape, 3) for each in values], axis=2)

    flags = np.where(missed, EstimateStatus.no_detection, EstimateStatus.solved)
    names = (*dims, "xyz")
    found = xr.Dataset(
        {
            "true_rvec": (names, stack([each.as_rotvec() for each in truth[0]])),
            "true_tvec_m": (names, stack(truth[1])),
            "rotation_error_rad": ((*dims, "solver", "xyz"), stack(
                [each.as_rotvec() for each in error])[..., None, :]),
            "translation_error_m": ((*dims, "solver", "xyz"), stack(
                [estimated[1][c] - truth[1][c] for c in range(2)])[..., None, :]),
            "detection": (dims, np.ones((*shape, 2), np.uint8)),
            "estimate": ((*dims, "solver"), flags[..., None].astype(np.uint8)),
            "flipped": ((*dims, "solver"), np.ones((*shape, 2, 1), np.uint8)),
        },
        {"trial": range(8), "marker_id": range(5), "stereo_camera": ["left", "right"],
         "solver": ["ippe"], "width_px": 640, "height_px": 480},
    )
    return found, ~missed.any(axis=2).ravel()


def test_differences_are_those_of_poses_taken_to_the_left_camera(rig):
    rng = np.random.default_rng(1)
    left = Rotation.from_rotvec(rng.normal(0, 0.3, (40, 3))) * Rotation.from_rotvec([np.pi, 0, 0])
    place = rng.normal((0.0, 0.0, 1.0), 0.1, (40, 3))
    turned = Rotation.from_rotvec(rng.normal(0, 0.01, (40, 3)))
    moved = rng.normal(0, 0.002, (40, 3))
    estimated = (
        [left, TURN * (turned * left)],
        [place, TURN.apply(place + moved) + SHIFT],
    )
    # What was taken for the truth does not matter.
    truth = (
        [Rotation.from_rotvec(rng.normal(0, 0.2, (40, 3))) * left, TURN * left],
        [place + 0.1, TURN.apply(place) + SHIFT],
    )
    results, both = results_of(rng, estimated, truth)
    table = stereo_differences(results, rig).sel(solver="ippe")
    assert table.compared == both.sum()
    angle = np.degrees(turned.magnitude())[both]
    depth = 100 * np.abs(moved[:, 2] / place[:, 2])[both]
    for name, values, share in (
        ("rotation_median_deg", angle, 0.5), ("rotation_p90_deg", angle, 0.9),
        ("range_median_percent", depth, 0.5), ("range_p90_percent", depth, 0.9),
    ):
        expected = np.quantile(values, share, method="inverted_cdf")
        assert table[name].item() == pytest.approx(expected, rel=1e-6)
        assert table[f"{name}_low"] <= expected
    assert table.flipped == 0
    with pytest.raises(SweepError, match="stereo_camera"):
        stereo_differences(results.isel(stereo_camera=0), rig)
