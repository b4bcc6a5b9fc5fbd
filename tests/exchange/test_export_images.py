"""``sweep export``: images as a run searches them, their truth, and camera files."""

import json
import shutil
from concurrent.futures import BrokenExecutor
from contextlib import nullcontext
from unittest import mock

import cv2
import numpy as np
import pytest
import xarray as xr

from support.answers import TEXT, rows_of
from sweep import cli
from sweep.errors import ArgumentError, RunError, StoreError
from sweep.exchange import export as exporting
from sweep.exchange.export import export
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import end_with


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, [
        "distance_m=[0.1, 0.2, 0.3]", "azimuth_deg={ uniform = [0, 360] }", "noise_grey=2",
        'cornerRefinementMethod="subpix"'], name="exported")


@pytest.fixture(scope="module")
def exported(pipeline, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export") / "images"
    return folder, export(pipeline, folder)


def truth(folder):
    return rows_of(folder / "truth.csv")


def corners_of(row):
    return np.array([float(row[f"{axis}{k}"]) for k in range(4) for axis in "xy"]).reshape(4, 2)


def matrix_of(path):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    return (file.getNode("camera_matrix").mat(), file.getNode("distortion_coefficients").mat(),
            file.getNode("image_width").real(), file.getNode("image_height").real())


def test_truth_is_what_opencv_projects_with_the_camera_file(exported):
    folder, result = exported
    rows = truth(folder)
    assert result.images == len(rows) == 18
    assert {path.name for path in (folder / "images").iterdir()} == {row["image"] for row in rows}
    for row in rows:
        matrix, lens, width, height = matrix_of(folder / f"cameras/{row['camera']}.opencv.yml")
        half = float(row["size_m"]) / 2
        square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
        rvec, tvec = ([float(row[f"{kind}{axis}"]) for axis in "xyz"] for kind in "rt")
        projected, _ = cv2.projectPoints(square, np.array(rvec), np.array(tvec), matrix, lens)
        np.testing.assert_allclose(corners_of(row), projected[:, 0], atol=1e-9)
        image = cv2.imread(str(folder / "images" / row["image"]), cv2.IMREAD_UNCHANGED)
        assert image.shape == (height, width) == (160, 200)
        assert (float(row["fx_px"]), float(row["cx_px"])) == (matrix[0, 0], matrix[0, 2])


def test_windows_are_parts_of_the_frames_and_their_truth_is_shifted(exported, pipeline, tmp_path):
    folder, _ = exported
    export(pipeline, tmp_path / "windows", windowed=True)
    for whole, part in zip(truth(folder), truth(tmp_path / "windows"), strict=True):
        x0, y0, width, height = (
            int(part[name]) for name in ("origin_x_px", "origin_y_px", "width_px", "height_px"))
        frame = cv2.imread(str(folder / "images" / whole["image"]), cv2.IMREAD_UNCHANGED)
        window = cv2.imread(
            str(tmp_path / "windows/images" / part["image"]), cv2.IMREAD_UNCHANGED)
        assert (window == frame[y0 : y0 + height, x0 : x0 + width]).all()
        np.testing.assert_allclose(corners_of(part), corners_of(whole) - (x0, y0), atol=1e-12)
        assert float(part["cx_px"]) == float(whole["cx_px"]) - x0
    assert any(int(row["origin_x_px"]) for row in truth(tmp_path / "windows"))


def test_tables_agree_and_netcdf_has_the_axes(exported, pipeline):
    folder, _ = exported
    rows = truth(folder)
    coco = json.loads((folder / "truth_coco.json").read_text())
    assert [image["file_name"] for image in coco["images"]] == [
        f"images/{row['image']}" for row in rows]
    for row, annotation in zip(rows, coco["annotations"], strict=True):
        points = np.reshape(annotation["keypoints"], (4, 3))
        assert (points[:, :2] == corners_of(row)).all()
        assert annotation["bbox"][:2] == corners_of(row).min(axis=0).tolist()
    with xr.open_dataset(folder / "truth.nc", engine="scipy") as dataset:
        assert dataset["true_tvec_m"].dims == ("tilt_deg", "distance_m", "trial", "xyz")
        assert dataset["image"].values.ravel().tolist() == [row["image"] for row in rows]
        at = dataset.sel(tilt_deg=50, distance_m=0.2, trial=2)
        row = next(row for row in rows if row["image"] == str(at["image"].values))
        assert (row["tilt_deg"], row["distance_m"], row["trial"]) == ("50.0", "0.2", "2")
        assert at["azimuth_deg"].item() == float(row["azimuth_deg"])
        assert (at["true_corners_px"].values == corners_of(row)).all()
        assert dataset.attrs["pipeline"] == pipeline.text


def test_camera_files_are_read_as_the_same_camera(exported, pipeline):
    folder, _ = exported
    for name in ("camera-0.opencv.yml", "camera-0.ros.yaml"):
        other = Pipeline.from_dict({
            "camera": {"camera_file": str(folder / "cameras" / name)}, "pose": {"distance_m": 1},
        })
        assert other.fixed["distortion"][:4] == pipeline.fixed["distortion"]
        assert [other.fixed[key] for key in ("width_px", "fx_px", "cx_px", "cy_px")] == [
            200, 180, 99.5, 79.5]


def test_an_interrupted_export_continues_and_damage_is_repaired(exported, pipeline, tmp_path):
    whole, _ = exported
    folder = tmp_path / "again"
    shutil.copytree(whole, folder)
    names = sorted(path.name for path in (folder / "images").iterdir())
    (folder / "images" / names[3]).unlink()
    (folder / "images" / names[4]).write_bytes(b"half a file")
    (folder / "truth.csv").unlink()
    again = export(pipeline, folder)
    assert (again.kept, again.written, again.damaged) == (16, 2, 2)
    assert files_of(folder) == files_of(whole)
    # One that was killed has no list of digests yet.
    (folder / "images.sha256").unlink()
    (folder / "images" / names[5]).unlink()
    again = export(pipeline, folder)
    assert (again.kept, again.written, again.damaged) == (17, 1, 0)
    assert files_of(folder) == files_of(whole)


def files_of(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*") if path.is_file()}


def test_folders_of_others_and_what_is_large_are_refused_in_a_line(
    exported, pipeline, tmp_path, monkeypatch
):
    (tmp_path / "notes.txt").write_text("mine")
    other = Pipeline.from_text(pipeline.text, ["seed=6"], name="exported")
    for some, folder, options, line in (
        (pipeline, tmp_path, {}, r"holds notes\.txt, and no export"),
        (pipeline, tmp_path / "notes.txt", {}, "cannot be written: "),
        (other, exported[0], {}, "(?s)holds another export.*pipeline: the folder has"),
        (pipeline, exported[0], {"windowed": True}, "images: the folder has whole frames"),
    ):
        with pytest.raises(StoreError, match=line):
            export(some, folder, **options)
    huge = Pipeline.from_text(pipeline.text.replace("trial = 3", "trial = 1000000"), name="huge")
    monkeypatch.setattr(exporting, "MAX_BYTES", 1000)
    for some, options, line in (
        (pipeline, {}, "takes about .*confirm it with --yes"),
        (huge, {}, "takes about .* in 6,000,000 files"),
        (pipeline, {"workers": 0}, "workers"),
    ):
        with pytest.raises((ArgumentError, StoreError), match=line):
            export(some, tmp_path / "new", **options)
    assert not (tmp_path / "new").exists()
    pool = nullcontext(mock.Mock(map=mock.Mock(side_effect=BrokenExecutor)))
    monkeypatch.setattr(exporting, "ProcessPoolExecutor", made := mock.Mock(return_value=pool))
    with pytest.raises(RunError, match="a process ended; use fewer workers"):
        export(pipeline, tmp_path / "new", workers=2, yes=True)
    assert made.call_args.kwargs["initializer"] is end_with  # none outlives the command


def test_scenes_without_a_visible_marker_have_no_image_and_are_counted(tmp_path, capsys):
    (tmp_path / "p.toml").write_text(
        TEXT.replace("tilt_deg = [0, 50]", "bearing_x_deg = [0, 80]")
        .replace("distance_m = [0.1, 0.25]\ntrial = 3", "distance_m = [0.2]"))
    assert cli.main(["export", str(tmp_path / "p.toml"), str(tmp_path / "out")]) == 0
    assert "1 images" in capsys.readouterr().out
    assert len(truth(tmp_path / "out")) == 1
    assert "1 scenes more have no image" in (tmp_path / "out/README.md").read_text()
