"""What errors of a camera's numbers do to the truth: against poses fitted with wrong cameras."""

import cv2
import numpy as np
import pytest

from support.board_photographs import POSES, SIZE, VIEW, board, camera
from sweep.errors import ArgumentError
from sweep.photographs.board_check import calibrate
from sweep.photographs.folder import FoundCorners
from sweep.photographs.pose_fit import Lens, fit_pose
from sweep.photographs.truth import camera_of_file, known_camera, unshared_variance

LENS = Lens.of(*VIEW, (0.1, -0.2, 0.001, -0.001, 0.05))


def seen(number, rng, sd_px):
    """Return the chessboard's corners in a photograph, with an error."""
    turn, shift = POSES[number]
    points = board().chessboard_m
    pixels = LENS.project(points, turn, np.array(shift)) + rng.normal(0, sd_px, (len(points), 2))
    return FoundCorners(points, pixels, np.arange(len(points)))


def test_the_covariance_of_a_calibration_has_opencvs_standard_deviations():
    rng = np.random.default_rng(1)
    turned = [seen(number, rng, 0.2) for number in range(len(POSES))]
    made = calibrate(SIZE, turned)
    assert np.sqrt(np.diag(made.covariance)) == pytest.approx(made.sd, rel=1e-3)
    correlation = made.covariance[0, 1] / np.sqrt(made.covariance[0, 0] * made.covariance[1, 1])
    assert correlation > 0.5  # both focal lengths rest on the same depths


def test_a_camera_that_does_not_fit_its_photographs_is_refused():
    rng = np.random.default_rng(1)
    turned = [seen(number, rng, 4.0) for number in range(len(POSES))]
    with pytest.raises(ArgumentError, match="px RMS beside the calibrated camera; expected at mo"):
        calibrate(SIZE, turned)


@pytest.mark.parametrize("number", [0, 2])
def test_what_truth_and_estimates_do_not_share_is_that_of_fitted_poses(number):
    """Both poses are fitted to exact corners with a wrong camera, 200 times."""
    rng = np.random.default_rng(2)
    factor = np.diag([0.4, 0.4, 0.3, 0.3, 2e-3, 4e-3, 1e-4, 1e-4, 2e-3])
    factor[1, 0] = 0.35
    covariance = factor @ factor.T
    turn, shift = POSES[number]
    turn = np.asarray(turn)
    own = board().corners_m[4]
    centre = own.mean(axis=0)
    own, others = own - centre, board().chessboard_m - centre
    position = turn @ centre + shift
    pixels = [LENS.project(points, turn, position) for points in (own, others)]
    pose = fit_pose(LENS, others, pixels[1], turn, position)
    predicted = np.sqrt(unshared_variance(LENS, covariance, pose, others, own))
    errors = []
    for _ in range(200):
        numbers = np.array([*VIEW, *LENS.distortion]) + factor @ rng.normal(size=9)
        wrong = Lens.of(*numbers[:4], tuple(numbers[4:]))
        alone, truth = (
            fit_pose(wrong, points, image, turn, position, np.ones(len(points), dtype=bool))
            for points, image in zip((own, others), pixels, strict=True)
        )
        turned = cv2.Rodrigues(alone.rotation @ truth.rotation.T)[0].ravel()
        errors.append([*turned, *(alone.translation - truth.translation)])
    # Six standard deviations of 200 draws each: within four standard errors.
    assert np.std(errors, axis=0) == pytest.approx(predicted, rel=0.2)


def test_a_files_covariance_is_that_of_its_numbers(tmp_path):
    path = tmp_path / "camera.json"
    matrix = np.diag(np.arange(1.0, 10.0)).ravel().tolist()
    path.write_text(camera()[:-1] + f', "covariance_intrinsics": {matrix}}}')
    known = known_camera(camera_of_file(str(path), SIZE))
    assert known.covariance.shape == (4 + len(known.lens.distortion),) * 2
    assert np.diag(known.covariance).tolist() == list(range(1, 10))
