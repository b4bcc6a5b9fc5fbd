"""Twins of photographs: the markers of photographs, simulated at the same poses."""

import cv2
import numpy as np
import pytest

from support.blocks import run_cells
from support.board_photographs import POSES, SIZE, VIEW, board, write_set
from support.board_scenes import BoardPose, board_scene, levels_of
from sweep.errors import SweepError
from sweep.evaluation.inspection import scene_image
from sweep.experiment.grid import Block
from sweep.experiment.photographs import PHOTOGRAPH_RECORDS
from sweep.experiment.pipeline import Pipeline, cell
from sweep.measure.flags import DetectionStatus
from sweep.photographs.prepare import prepare
from sweep.photographs.twins import read_scene, twin_pipeline

SCENE = {
    "black": 35, "white": 210, "blur_px": {"normal": [0.6, 0.05]}, "noise_grey": 2.0,
    "geometry_px": 0.1, "geometry_length_px": 60.0,
}


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    """The pipeline of three photographs; the last shows a part of the board."""
    folder = tmp_path_factory.mktemp("twins")
    shots = write_set(folder, [POSES[0], POSES[1], POSES[-1]])
    return prepare(
        [shots], folder / "camera.json", board=folder / "board.toml", home=folder,
        settings=["cornerRefinementMethod=subpix"],
    ).pipeline


def all_indices(pipeline):
    lengths = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return Block((0,) * len(lengths), lengths).indices()


def test_rows_are_those_of_the_photographs_with_their_poses(prepared):
    record, _ = PHOTOGRAPH_RECORDS.read(f"{prepared.folder}/{prepared.name}.photographs.npz")
    twins = twin_pipeline(prepared, SCENE, repeats=2)
    columns = run_cells(twins, all_indices(twins)).columns
    shown = record.shown
    assert not shown.all()
    flags = columns["detection"][0].reshape(2, *shown.shape)
    for repeat in flags:
        assert np.array_equal(repeat == DetectionStatus.not_in_photograph, ~shown)
        assert (repeat[shown] == DetectionStatus.detected).all()
    truth = columns["true_tvec_m"][0].reshape(2, *shown.shape, 3)
    assert np.array_equal(truth[0], truth[1], equal_nan=True)
    assert np.allclose(truth[0][shown], record.translation[shown], rtol=1e-12)
    turn = columns["true_rvec"][0].reshape(2, *shown.shape, 3)[0][shown]
    for vector, rotation in zip(turn, record.rotation[shown], strict=True):
        assert np.allclose(cv2.Rodrigues(vector)[0], rotation, atol=1e-9)
    error = columns["corner_error_px"][0].reshape(2, *shown.shape, 4, 2)[:, shown]
    assert np.abs(error).max() < 2
    std = columns["truth_std"][0].reshape(2, *shown.shape, 6)
    assert np.allclose(std[0], record.std, rtol=1e-6, equal_nan=True)


def test_what_is_drawn_of_a_photograph_is_the_same_for_all_its_markers(prepared):
    twins = twin_pipeline(prepared, SCENE, repeats=2)
    indices = all_indices(twins)
    values = twins.experiment.scene_values(indices)
    blur = values["blur_px"].values.reshape(6, -1)
    assert (blur == blur[:, :1]).all()
    assert len(set(blur[:, 0].tolist())) == 6  # other repeats, other draws
    assert len(set(values["noise_key"].values.tolist())) == len(indices[0])
    some = [index[3:9] for index in indices]
    assert np.array_equal(twins.experiment.scene_values(some)["blur_px"].values, blur.ravel()[3:9])


@pytest.mark.parametrize("marker_id", [0, 4])
def test_a_twin_has_the_prints_of_its_board_around_the_marker(prepared, marker_id):
    scene = {"black": 35, "white": 210, "background": 120, "blur_px": 0.6}
    twin = cell(twin_pipeline(prepared, scene), f"trial=0,marker_id={marker_id}")
    record, _ = PHOTOGRAPH_RECORDS.read(f"{prepared.folder}/{prepared.name}.photographs.npz")
    turn = record.rotation[0, marker_id]
    corners = board().corners_m[marker_id]
    # The whole board at a pose that has the marker where the twin has it.
    shift = record.translation[0, marker_id] - turn @ corners.mean(axis=0)
    scenes = board_scene(
        board(), {"width_px": SIZE[0], "height_px": SIZE[1],
                  **dict(zip(("fx_px", "fy_px", "cx_px", "cy_px"), VIEW, strict=True))},
        BoardPose(turn, shift), blur_px=0.6,
    )
    whole = levels_of(scenes, background=120.0, black=35.0, white=210.0)
    around = 1.8 * (corners - corners.mean(axis=0)) + corners.mean(axis=0)  # 2.4 modules wider
    x, y, z = (around @ turn.T + shift).T
    pixels = np.stack([VIEW[0] * x / z + VIEW[2], VIEW[1] * y / z + VIEW[3]], axis=1)
    inside = np.zeros(whole.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(pixels).astype(np.int32), 1)
    difference = np.abs(scene_image(twin, whole_frame=True) - whole)[inside > 0]
    assert difference.max() < 1.0  # rounding


def test_a_scene_of_another_resolution_is_said(prepared, tmp_path, capsys):
    path = tmp_path / "scene.toml"
    for width, said in ((360, False), (720, True)):
        path.write_text(
            f"[camera]\nwidth_px = {width}\nheight_px = 270\n[scene]\nblur_px = 0.6\n")
        assert read_scene(path, prepared) == {"blur_px": 0.6}
        warned = "fitted to images of 720 x 270, not of 360 x 270" in capsys.readouterr().err
        assert warned == said


def test_only_photographs_have_twins(prepared, tmp_path):
    twins = twin_pipeline(prepared, {})
    for other in (Pipeline.from_dict({"pose": {"distance_m": 1}}), twins):
        with pytest.raises(SweepError, match="expected a store of photographs"):
            twin_pipeline(other, {})
    with pytest.raises(SweepError, match="simulated = true: expected photographs beside it"):
        Pipeline.from_dict({"pose": {"distance_m": 1}, "scene": {"simulated": True}})
    with pytest.raises(SweepError, match="nothing beside photographs, which have their own poses"):
        Pipeline.from_text(
            twins.to_toml() + "\n[pose]\ndistance_m = 1\n", folder=prepared.folder)
    (tmp_path / "none.toml").write_text("seed = 1\n")
    for name, line in (("none", r"expected a section \[scene\]"), ("missing", "cannot be read")):
        with pytest.raises(SweepError, match=line):
            read_scene(tmp_path / f"{name}.toml")
