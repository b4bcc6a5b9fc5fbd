"""Sets of public photographs, where the environment variable SWEEP_PHOTOS names their folder."""

import os
from pathlib import Path

import numpy as np
import pytest

import sweep
from sweep.measure.estimation import rotation_difference
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.model.pose import rotation_of_vector
from sweep.photographs.cameras import stereo_of_file

FOLDER = os.environ.get("SWEEP_PHOTOS", "")

pytestmark = [
    pytest.mark.evidence,
    pytest.mark.skipif(
        not Path(FOLDER, "charuco_480").is_dir(),
        reason="SWEEP_PHOTOS does not name the folder of the sets of photographs",
    ),
]


PIXELS = ['solver=["ippe_square", "photometric_real"]', 'cornerRefinementMethod="subpix"']


@pytest.mark.parametrize(("name", "board", "most", "nees"), [
    # Rotation error of frontal markers is that of 0.01 px: 0.61 [0.52, 0.70] by photograph.
    ("charuco_480", "marker_m = 0.01905\n", 0.55, 12.0),
    ("charuco_1280_legacy", "marker_m = 0.019\nlegacy_pattern = true\n", 0.7, 40.0),
])
def test_poses_from_pixels_are_better_than_those_of_subpix(name, board, most, nees, tmp_path):
    file = tmp_path / "board.toml"
    file.write_text(
        'kind = "charuco"\ndictionary = "DICT_4X4_1000"\nsquares_x = 8\nsquares_y = 8\n'
        f"square_m = 0.0254\n{board}")
    results = sweep.photos(
        Path(FOLDER, name), camera="calibrate", board=file, store=tmp_path / f"{name}.zarr",
        settings=PIXELS,
    ).load()
    results["range_error"] = (results.translation_error_m / results.true_tvec_m).isel(xyz=2)
    ours, theirs = (results.sel(solver=each) for each in ("photometric_real", "ippe_square"))
    solved = (ours.estimate == EstimateStatus.solved).values
    turned = ours.rotation_error_deg.values
    errors = np.concatenate([ours.rotation_error_rad, ours.translation_error_m], axis=-1)
    near = solved & (turned < 10)
    std = np.hypot(ours.predicted_std.values[near], results.truth_std.values[near])
    squares = ((errors[near] / std) ** 2).mean(axis=0)
    rotation = np.median(turned[solved]) / np.median(theirs.rotation_error_deg.values[solved])
    distance = np.sqrt((ours.range_error.values[solved] ** 2).mean()
                       / (theirs.range_error.values[solved] ** 2).mean())
    print(f"{name}: solved {solved.sum()}, rotation {rotation:.3f}, range {distance:.3f} of "
          f"subpix's, squared errors over variances {np.round(squares, 1)}")
    assert solved.sum() >= 0.9 * (results.detection == DetectionStatus.detected).sum()
    assert rotation <= most
    assert distance <= 0.5
    assert squares.sum() < nees


def test_poses_from_pixels_agree_between_both_cameras(tmp_path):
    """Without the position along x: there all markers differ by 1.5 mm, 5 % of the baseline."""
    board = tmp_path / "board.toml"
    board.write_text(
        'kind = "grid"\ndictionary = "DICT_APRILTAG_36h10"\nrows = 4\ncolumns = 5\n'
        "marker_m = 0.019\ngap_m = 0.00475\ncorner_squares = true\n"
        f"ids = {list(range(19, -1, -1))}\n"
    )
    file = Path(FOLDER, "aprilgrid_stereo", "stereo_calibration.yml")
    results = sweep.photos(
        file.parent, stereo=file, board=board, store=tmp_path / "grid.zarr", settings=PIXELS,
    ).load()
    stereo = stereo_of_file(str(file), (1280, 720))
    detected = (results.detection == DetectionStatus.detected).values
    flags = results.estimate.sel(solver="photometric_real")
    solved = (flags == EstimateStatus.solved).values
    both = (flags == EstimateStatus.solved).all("stereo_camera")
    medians, largest, ranges = {}, {}, {}
    for solver in ("photometric_real", "ippe_square"):
        turns, positions, variances = [], [], []
        for side in range(2):
            each = results.sel(solver=solver).isel(stereo_camera=side)
            known = both.transpose(*each.detection.dims).values
            error = rotation_of_vector(each.rotation_error_rad.values[known].astype(np.float64))
            turns.append(error @ rotation_of_vector(each.true_rvec.values[known]))
            moved = each.translation_error_m.values[known]
            positions.append(each.true_tvec_m.values[known] + moved)
            variances.append(each.predicted_std.values[known] ** 2)
        turned = rotation_difference(turns[1], stereo.rotation @ turns[0])
        degrees = np.degrees(np.linalg.norm(turned, axis=1))
        medians[solver], largest[solver] = np.median(degrees), degrees.max()
        shift = positions[1] - positions[0] @ stereo.rotation.T - stereo.translation
        ranges[solver] = np.sqrt(((shift[:, 2] / positions[1][:, 2]) ** 2).mean())
        if solver == "photometric_real":  # the cameras are almost parallel
            squares = (np.hstack([turned, shift]) ** 2 / sum(variances)).mean(axis=0)
    print(f"grid: solved {solved.sum()}, left against right {medians}, largest {largest}, range "
          f"{ranges}, squared differences over variances {np.round(squares, 1)}")
    assert solved.sum() >= 0.9 * detected.sum()
    assert medians["photometric_real"] <= 0.3 * medians["ippe_square"]
    assert largest["photometric_real"] < 10
    assert ranges["photometric_real"] <= 0.5 * ranges["ippe_square"]
    assert squares[[0, 1, 2, 4, 5]].sum() < 12
