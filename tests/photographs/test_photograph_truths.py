"""Photographs, boards, cameras and poses: their truth, and what does not fit is told in a line."""

import csv
import json
import os
import shutil
import struct

import cv2
import numpy as np
import pytest

from support.board_photographs import (
    BOARD,
    POSES,
    SIZE,
    VIEW,
    camera,
    image,
    marker_poses,
    toml,
    write_set,
)
from sweep.errors import ArgumentError, PipelineError, SweepError
from sweep.experiment.photographs import PhotographRecord, board_of
from sweep.measure.flags import TruthSource
from sweep.photographs.prepare import prepare

SINGLE = ["dictionary=DICT_4X4_50", "size_m=0.022"]
RIG = (cv2.Rodrigues(np.radians([1.0, -4.0, 2.0]))[0], np.array([-0.04, 0.001, 0.002]))


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    made = tmp_path_factory.mktemp("faults")
    shots = write_set(made, POSES[:2])
    half = camera(SIZE, [number / 2 for number in VIEW])  # of an image of half as many pixels
    (made / "half.json").write_text(half.replace('"image_width": 360, "image_height": 270, ', ""))
    (made / "lens.json").write_text(camera().replace("[0, 0, 0, 0, 0]", "[0, 0, 0.3, 0.3, 0]"))
    view, none = [[VIEW[0], 0, VIEW[2]], [0, VIEW[1], VIEW[3]], [0, 0, 1]], [0] * 5
    (made / "rig.json").write_text(json.dumps({
        "K1": view, "D1": none, "K2": view, "D2": none, "R": np.eye(3).tolist(), "T": [-0.1, 0, 0],
    }))
    grey = cv2.imread(str(shots / "shot1.png"), cv2.IMREAD_GRAYSCALE)
    tags = np.hstack([np.pad(cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_50), number, 80
    ), 30, constant_values=255) for number in (3, 4)])
    for name, images in {
        "mixed": (grey, grey, grey[:200]), "without": (np.full_like(grey, 128),), "empty": (),
        "mirrored": (tags[:, ::-1],), "twice": (np.hstack([grey, grey]),),
    }.items():
        (made / name).mkdir()
        for number, shown in enumerate(images):
            cv2.imwrite(str(made / name / f"{number}.png"), shown)
    other = board_of({**BOARD, "first_id": 5}, "board")
    shutil.copytree(shots, made / "other")
    cv2.imwrite(str(made / "other" / "other.png"), image(POSES[1], 7, printed=other))
    return made


def record_of(prepared, name=None):
    name = name or prepared.pipeline.name
    return PhotographRecord.read(f"{prepared.pipeline.folder}/{name}.photographs.npz")[0]


def write_poses(path, scale=1.0, suffix="", sign=1.0, first=0):
    """Write the exact poses of all markers, also of those that are cut by the frame."""
    with path.open("w") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "id", "rx", "ry", "rz", "tx", "ty", "tz"])
        for number, pose in enumerate(POSES[:2]):
            for marker, (turn, shift) in enumerate(zip(*marker_poses(pose), strict=True)):
                x, y, z = np.asarray(shift) * scale
                writer.writerow([f"shot{number}{suffix}", first + marker,
                                 *cv2.Rodrigues(turn)[0].ravel(), x, y, sign * z])
    return path


def test_a_file_of_poses_is_the_truth(faulty, tmp_path):
    made = prepare([faulty / "shots"], faulty / "camera.json", settings=SINGLE,
                   poses=write_poses(tmp_path / "poses.csv", suffix=".png"), home=tmp_path)
    record = record_of(made)
    for number, pose in enumerate(POSES[:2]):
        turn, shift = marker_poses(pose)
        shown = record.shown[number]
        assert shown.any()
        assert np.allclose(record.rotation[number][shown], turn[shown], atol=1e-9)
        assert np.allclose(record.translation[number][shown], shift[shown], atol=1e-12)
        assert (record.source[number][shown] == TruthSource.poses_file).all()
    assert np.isnan(record.std).all()


@pytest.mark.parametrize(("changes", "expected"), [
    ({"scale": 1000.0}, "positions that are .* times those of the detected markers; expected met"),
    ({"sign": -1.0}, "most markers are not where its poses have them"),
    ({"suffix": "_a"}, "image shot0_a is not among the images; expected a name such as shot0"),
    ({"first": 40}, r"markers \[40, .*\]: expected those .* photographs: \[0, 1, .*\]"),
])
def test_poses_of_another_unit_frame_or_image_are_refused(faulty, tmp_path, changes, expected):
    with pytest.raises(PipelineError, match=expected):
        prepare([faulty / "shots"], faulty / "camera.json", settings=SINGLE,
                poses=write_poses(tmp_path / "poses.csv", **changes), home=tmp_path)


@pytest.fixture(scope="module")
def stereo(tmp_path_factory):
    """Photographs of two cameras in two folders, side by side, and their calibration."""
    made = tmp_path_factory.mktemp("stereo")
    turn, shift = RIG
    for name in ("left", "right", "both"):
        (made / name).mkdir()
    for number, pose in enumerate(POSES[:3]):
        left = image(pose, number)
        right = image((turn @ pose[0], turn @ np.asarray(pose[1]) + shift), 100 + number)
        for name, pixels in (("left", left), ("right", right), ("both", np.hstack([left, right]))):
            cv2.imwrite(str(made / name / f"{number}.png"), pixels)
    fx, fy, cx, cy = VIEW
    storage = cv2.FileStorage(str(made / "rig.yml"), cv2.FILE_STORAGE_WRITE)
    for each in ("1", "2"):
        storage.write(f"K{each}", np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        storage.write(f"D{each}", np.zeros((1, 5)))
    storage.write("R", turn)
    storage.write("T", shift)
    storage.release()
    (made / "board.toml").write_text(toml())
    return made


def test_the_other_camera_is_the_truth_in_two_folders_and_side_by_side(stereo, tmp_path):
    records = {}
    for name, folders in (("two", ["left", "right"]), ("one", ["both"])):
        made = prepare([stereo / each for each in folders], stereo=stereo / "rig.yml",
                       board=stereo / "board.toml", store=tmp_path / f"{name}.zarr")
        records[name] = [record_of(made, f"{name}-{side}") for side in ("left", "right")]
        assert "in 3 pairs of photographs; truth: stereo partner" in made.lines[-1]
    for two, one in zip(records["two"], records["one"], strict=True):
        assert np.array_equal(two.translation, one.translation, equal_nan=True)
        assert np.array_equal(two.rotation, one.rotation, equal_nan=True)
    left, right = records["two"]
    for number, pose in enumerate(POSES[:3]):
        centres = np.asarray(marker_poses(pose)[1])
        mapped = centres @ RIG[0].T + RIG[1]
        for record, expected in ((left, centres), (right, mapped)):
            shown = record.shown[number]
            error = np.linalg.norm(record.translation[number][shown] - expected[shown], axis=1)
            assert shown.sum() > 5
            assert np.median(error) < 0.01  # of 0.3 m; poses by four corners of 25 px


def test_turned_deep_and_coloured_photographs_have_the_poses_of_plain_ones(faulty, tmp_path):
    grey = cv2.imread(str(faulty / "shots" / "shot1.png"), cv2.IMREAD_GRAYSCALE)
    quality = [cv2.IMWRITE_JPEG_QUALITY, 100]
    jpeg = cv2.imencode(
        ".jpg", cv2.rotate(grey, cv2.ROTATE_90_COUNTERCLOCKWISE), quality)[1].tobytes()
    # The tag by which viewers turn it clockwise.
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, 6, 0)
    segment = b"Exif\0\0II*\0\x08\0\0\0" + struct.pack("<H", 1) + entry + b"\0\0\0\0"
    files = {
        "turned": jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:],
        "deep": cv2.imencode(".png", grey.astype(np.uint16) * 257)[1].tobytes(),
        "colour": cv2.imencode(".png", cv2.cvtColor(grey, cv2.COLOR_GRAY2BGRA))[1].tobytes(),
    }
    plain = None
    for name, content in {"plain": (faulty / "shots" / "shot1.png").read_bytes(), **files}.items():
        shots = tmp_path / name
        shots.mkdir()
        (shots / f"a.{'jpg' if name == 'turned' else 'png'}").write_bytes(content)
        made = prepare([shots], faulty / "camera.json", board=faulty / "board.toml", home=tmp_path)
        found = record_of(made).translation
        plain = found if plain is None else plain
        # The JPEG of best quality has other pixels by up to two grey levels.
        assert np.allclose(found, plain, atol=3e-4 if name == "turned" else 0, equal_nan=True)
    (tmp_path / "upright.json").write_text(camera(SIZE[::-1]))
    with pytest.raises(ArgumentError, match="they are turned, perhaps by their EXIF tags"):
        prepare([tmp_path / "turned"], tmp_path / "upright.json", board=faulty / "board.toml",
                home=tmp_path)


@pytest.mark.parametrize(("name", "options", "expected"), [
    ("other", {}, "other.png: less than 60 % of the markers"),
    ("mixed", {}, "expected photographs of one size: most are 360 x 270, not 2.png"),
    ("without", {}, "no photograph shows a marker of DICT_4X4_50"),
    ("empty", {}, "expected photographs"),
    ("shots", {"camera": "calibrate"}, "there are 2; take more"),
    ("shots", {"camera": None}, "expected the file of a calibration"),
    ("shots", {"settings": ["noise_grey=3"]}, "nothing beside photographs"),
    ("shots", {"settings": ["size_m=0.1"]}, "expected none beside a board"),
    ("shots", {"camera": None, "stereo": "camera.json"}, "K1, D1, K2, D2, R and T"),
    ("shots", {"camera": "half.json"}, "if its numbers are times 2: it is of another"),
    ("shots", {"board": {"legacy_pattern": True}}, "legacy_pattern = false fits"),
    ("shots", {"board": {"squares_x": 4, "squares_y": 5}}, "squares_x = 5, squares_y = 4 fits"),
    ("shots", {"board": {"marker_m": 0.015}}, "the photographs show about 0.02"),
    ("shots", {"board": {"first_id": 20}}, "correct first_id or ids"),
    ("shots", {"board": {"first_id": 2}}, "; first_id = 0 fits"),
    ("mirrored", {"board": {"dictionary": "DICT_6X6_50"}}, "2 of DICT_6X6_50 in the mirror image"),
    ("twice", {}, r"twice: of two cameras side by side give the calibration \(--stereo FILE\)"),
    ("shots", {"camera": "lens.json"}, "px RMS beside the camera; expected at most 2 px"),
    ("twice", {"camera": None, "stereo": "rig.json"}, "not where the other camera has them"),
])
def test_a_fault_is_one_line(faulty, tmp_path, name, options, expected):
    given = {"camera": "camera.json", "board": {}, **options}
    board = tmp_path / "board.toml"
    board.write_text(toml(**given.pop("board")))
    paths = {key: faulty / value if isinstance(value, str) and "." in value else value
             for key, value in given.items()}
    with pytest.raises(SweepError, match=expected) as caught:
        prepare([faulty / name], paths.pop("camera"), board=board, home=tmp_path, **paths)
    assert "\n" not in str(caught.value)
    assert "board" not in options or not list(tmp_path.glob("*.npz"))


def test_what_is_left_out_and_converted_is_said(faulty, tmp_path):
    shots = tmp_path / "shots"
    shutil.copytree(faulty / "shots", shots)
    grey = cv2.imread(str(shots / "shot0.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(shots / "deep.png"), grey.astype(np.uint16) * 257)
    cv2.imwrite(str(shots / "colour.png"), cv2.merge([grey, grey // 2, grey]))
    cv2.imwrite(str(shots / "blurred.png"), cv2.GaussianBlur(grey, (0, 0), 9))
    cv2.imwrite(str(shots / "faint.png"), (100 + 0.08 * grey).astype(np.uint8))  # it has a pose
    (shots / "cut.jpg").write_bytes(b"\xff\xd8\xff")
    for name in (os.fsdecode(b"\xff.png"), "again.png"):
        shutil.copy(shots / "deep.png", shots / name)
    (shots / "notes.txt").write_text("no photograph")
    made = prepare([shots], faulty / "camera.json", board=faulty / "board.toml", home=tmp_path)
    said = "\n".join(made.lines)
    for words in ("left out notes.txt", "left out cut.jpg", "the same photographs again",
                  "\\udcff.png: its name is not UTF-8", "have 16 bits", "are in colour",
                  "seen in blurred.png: all of them count as missed"):
        assert words in said
