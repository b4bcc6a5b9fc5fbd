"""Boards exported, answered by a plain OpenCV loop over the folder, and scored as a run is."""


import cv2
import numpy as np
import pytest
import xarray as xr

from support.answers import answer, rows_of, write
from sweep.errors import PipelineError
from sweep.evaluation.block import compute_block
from sweep.exchange.export import export
from sweep.exchange.score import prepare
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus

TEXT = """
title = "Exchanged"
seed = 3
[camera]
width_px = 320
height_px = 240
fx_px = 300
[marker]
size_m = 0.03
dictionary = "DICT_4X4_50"
[scene]
noise_grey = 3
background = 128
window = "full"
[estimator]
solver = "iterative"
guarded = false
[axes]
tilt_deg = [0, 40]
distance_m = [0.25, 0.4]
trial = 2
"""

BOARDS = {
    "one plane": '[board]\nkind = "grid"\nrows = 2\ncolumns = 3\ngap_m = 0.01\n',
    "several planes": """[board]
kind = "markers"
[[board.markers]]
marker_id = 3
x_m = 0.0
y_m = 0.0
[[board.markers]]
marker_id = 8
x_m = 0.04
y_m = 0.0
z_m = 0.01
tilt_deg = 20
[[board.markers]]
marker_id = 5
x_m = -0.04
y_m = 0.0
size_m = 0.02
z_m = -0.01
tilt_deg = -30
""",
}


def results_of(pipeline):
    lengths = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return compute_block(pipeline.experiment, Block((0,) * len(lengths), lengths))


def numbers(row, names):
    return [float(row[name]) for name in names]


@pytest.fixture(scope="module", params=BOARDS)
def exchanged(request, tmp_path_factory):
    """A folder with images of a board, the answers of the README's script, and the run."""
    folder = tmp_path_factory.mktemp("boards") / "export"
    pipeline = Pipeline.from_text(TEXT + BOARDS[request.param], name="exchanged")
    export(pipeline, folder)
    answer(folder)
    return folder, results_of(pipeline)


def test_detections_of_a_plain_opencv_loop_are_scored_as_a_run(exchanged):
    folder, ran = exchanged
    scored = results_of(prepare(folder, [folder / "detections.csv"]).pipeline)
    assert ran.keys() == scored.keys()
    for name, values in ran.items():
        np.testing.assert_array_equal(values, scored[name], err_msg=name)
    assert (ran["marker_detection"] == DetectionStatus.detected).sum() > 10
    assert (ran["estimate"] == EstimateStatus.solved).all()


def test_poses_of_a_plain_opencv_loop_are_scored_as_those_of_a_run(exchanged, tmp_path):
    folder, ran = exchanged
    places = {(row["image"], row["id"]): row for row in rows_of(folder / "truth.csv")}
    found = {}
    for row in rows_of(folder / "detections.csv"):
        found.setdefault(row["image"], []).append(row)
    corner_names = [f"{axis}{k}" for k in range(4) for axis in "xy"]
    place_names = [f"{axis}{k}_m" for k in range(4) for axis in "XYZ"]
    camera = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]])
    answers = []
    for image, rows in found.items():
        known = [row for row in rows if (image, row["id"]) in places]
        objects = [numbers(places[image, row["id"]], place_names) for row in known]
        pixels = [numbers(row, corner_names) for row in known]
        _, rvec, tvec = cv2.solvePnP(
            np.reshape(objects, (-1, 3)), np.reshape(pixels, (-1, 2)), camera, None,
            flags=cv2.SOLVEPNP_ITERATIVE)
        pose = dict(zip(("rx", "ry", "rz", "tx", "ty", "tz"),
                        map(repr, [*rvec.ravel().tolist(), *tvec.ravel().tolist()]), strict=True))
        answers.append({"image": image, "id": "", **dict.fromkeys(corner_names, ""), **pose})
    write(tmp_path / "poses.csv", answers)
    ready = prepare(folder, [tmp_path / "poses.csv"], names=["poses"])
    assert ready.pipeline.fixed["solver"] == "recorded"
    scored = results_of(ready.pipeline)
    assert (scored["estimate"] == EstimateStatus.solved).all()
    # The places in OpenCV's own frame, by a rotation vector: rounding, and the last step.
    for name in ("translation_error_m", "rotation_error_rad"):
        np.testing.assert_allclose(scored[name], ran[name], atol=2e-7, err_msg=name)
    assert np.nanmax(scored["reprojection_error_px"]) < 1e-9  # the corners are the pose's image


def test_truth_of_a_charuco_has_its_chessboard(tmp_path):
    board = ('[board]\nkind = "charuco"\nsquares_x = 4\nsquares_y = 3\n'
             'square_m = 0.035\n')
    settings = ['points="chessboard"', 'solver="iterative"', "size_m=0.025", "trial=1"]
    pipeline = Pipeline.from_text(TEXT + board, settings, name="charuco")
    export(pipeline, tmp_path / "out")
    rows = rows_of(tmp_path / "out/truth_chessboard.csv")
    assert len(rows) == 4 * 6
    (truth, *_) = rows_of(tmp_path / "out/truth.csv")
    rvec, tvec = (np.array(numbers(truth, [f"{kind}{axis}" for axis in "xyz"])) for kind in "rt")
    camera = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]])
    points = np.array([numbers(row, ("X_m", "Y_m", "Z_m")) for row in rows[:6]])
    expected = cv2.projectPoints(points, rvec, tvec, camera, None)[0][:, 0]
    np.testing.assert_allclose(
        [numbers(row, ("x", "y")) for row in rows[:6]], expected, atol=1e-9)
    with xr.open_dataset(tmp_path / "out/truth.nc", engine="scipy") as dataset:
        assert dataset["true_corners_px"].dims[-3:] == ("marker", "corner", "xy")
    path = tmp_path / "none.csv"
    path.write_text("")
    with pytest.raises(PipelineError, match=r"markers beside recorded detections"):
        prepare(tmp_path / "out", [path])
