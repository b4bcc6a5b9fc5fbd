"""Solver ``photometric_real`` on photographs of a board: its neighbours' edges are in the model."""

import dataclasses

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

import sweep
from support.board_photographs import POSES, board, marker_poses, write_set
from sweep.errors import PluginError
from sweep.experiment.photographs import PHOTOGRAPH_RECORDS
from sweep.measure.flags import EstimateStatus

ALARM = 1e-7
NUMBERS = (1, 2)
"""The poses of the photographs."""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pixels")
    shots = write_set(folder, [POSES[number] for number in NUMBERS])
    results = sweep.photos(
        shots, camera=folder / "camera.json", board=folder / "board.toml",
        settings=['solver="photometric_real"', 'cornerRefinementMethod="subpix"'],
        store=folder / "shots.zarr",
    )
    return folder, results.load()


def squared_errors(results):
    """Return the squared errors from the exact poses, in units of the covariance's diagonal."""
    rows = []
    for number, pose in enumerate(POSES[k] for k in NUMBERS):
        rotations, positions = marker_poses(pose)
        each = results.isel(trial=number)
        for k in np.flatnonzero((each.estimate == EstimateStatus.solved).values):
            cell = each.isel(marker_id=k)
            # Estimate from error and truth of the store, and its error from the exact pose.
            turn = (
                cv2.Rodrigues(cell.rotation_error_rad.values.astype(float))[0]
                @ cv2.Rodrigues(cell.true_rvec.values)[0] @ rotations[k].T
            )
            moved = cell.translation_error_m.values + cell.true_tvec_m.values - positions[k]
            error = np.concatenate([cv2.Rodrigues(turn)[0].ravel(), moved])
            rows.append((error / cell.predicted_std.values) ** 2)
    return np.array(rows)


@pytest.mark.evidence
def test_poses_of_a_board_have_the_errors_that_their_store_predicts(made):
    """Each of the six components, whose squares are those of a normal distribution."""
    _, results = made
    solved = (results.estimate == EstimateStatus.solved).values
    assert solved.sum() >= 18  # all but markers whose own truth is unknown
    assert (results.misfit_px.values[solved] < 0.1).all()
    squares = squared_errors(results)
    assert (squares.sum(axis=0) < chi2.isf(ALARM / 6, len(squares))).all()
    assert (squares.sum(axis=0) > chi2.ppf(ALARM / 6, len(squares))).all()


@pytest.mark.evidence
def test_the_board_is_in_the_record(made, tmp_path):
    folder, _ = made
    path = folder / "shots.photographs.npz"
    record, _ = PHOTOGRAPH_RECORDS.read(path)
    ids = np.array([9, 0])
    on_board = record.on_board(ids)
    assert [each.board.marker_ids[each.number] for each in on_board] == [9, 0]
    np.testing.assert_array_equal(on_board[0].board.corners_m, board().corners_m)
    other = tmp_path / "other.photographs.npz"
    for damaged in ("[]", "{}", "no JSON", record.board.replace("5", "2")):
        other.write_bytes(PHOTOGRAPH_RECORDS.content(dataclasses.replace(record, board=damaged)))
        with pytest.raises(PluginError, match="damaged: board"):
            PHOTOGRAPH_RECORDS.read(other)
