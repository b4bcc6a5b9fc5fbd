"""Photographs, boards and cameras that do not fit: a line each, which says what to change."""

import os

import cv2
import numpy as np
import pytest

from support.board_photographs import BOARD, POSES, SIZE, VIEW, camera, image, toml, write_set
from sweep.errors import ArgumentError, SweepError
from sweep.experiment.photographs import board_of
from sweep.photographs.prepare import prepare


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("faults")
    shots = write_set(made, POSES[:2])
    half = camera(SIZE, [number / 2 for number in VIEW])  # of an image of half as many pixels
    (made / "half.json").write_text(half.replace('"image_width": 360, "image_height": 270, ', ""))
    grey = cv2.imread(str(shots / "shot1.png"), cv2.IMREAD_GRAYSCALE)
    for name, images in {
        "mixed": (grey, grey, grey[:200]), "without": (np.full_like(grey, 128),), "empty": (),
    }.items():
        (made / name).mkdir()
        for number, shown in enumerate(images):
            cv2.imwrite(str(made / name / f"{number}.png"), shown)
    return made


BOARDS = [
    ({"legacy_pattern": True}, "legacy_pattern = false fits"),
    ({"squares_x": 4, "squares_y": 5}, "squares_x = 5, squares_y = 4 fits"),
    ({"marker_m": 0.015}, "the photographs show about 0.02"),
    ({"first_id": 20}, "correct first_id or ids"),
]


@pytest.mark.parametrize(("changes", "expected"), BOARDS)
def test_another_board_is_found_out(folder, tmp_path, changes, expected):
    path = tmp_path / "other.toml"
    path.write_text(toml(**changes))
    with pytest.raises(ArgumentError, match=expected) as caught:
        prepare([folder / "shots"], folder / "camera.json", board=path, home=tmp_path)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("*.npz"))


@pytest.mark.parametrize(("name", "options", "expected"), [
    ("mixed", {}, "expected photographs of one size: most are 360 x 270, not 2.png"),
    ("without", {}, "no photograph shows a marker of DICT_4X4_50"),
    ("empty", {}, "expected photographs"),
    ("shots", {"camera": "calibrate"}, "there are 2; take more"),
    ("shots", {"camera": None}, "expected the file of a calibration"),
    ("shots", {"settings": ["noise_grey=3"]}, "nothing beside photographs"),
    ("shots", {"settings": ["size_m=0.1"]}, "expected none beside a board"),
    ("shots", {"camera": None, "stereo": "camera.json"}, "K1, D1, K2, D2, R and T"),
    ("shots", {"camera": "half.json"}, "if its numbers are times 2: it is of another"),
])
def test_a_fault_is_one_line(folder, tmp_path, name, options, expected):
    given = {"camera": "camera.json", "board": "board.toml", **options}
    paths = {
        key: folder / value if isinstance(value, str) and "." in value else value
        for key, value in given.items()
    }
    with pytest.raises(SweepError, match=expected) as caught:
        prepare([folder / name], paths.pop("camera"), home=tmp_path, **paths)
    assert "\n" not in str(caught.value)


def test_what_is_left_out_and_converted_is_said(folder, tmp_path):
    shots = tmp_path / "shots"
    shots.mkdir()
    for number in range(2):
        grey = cv2.imread(str(folder / "shots" / f"shot{number}.png"), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(shots / f"deep{number}.png"), grey.astype(np.uint16) * 257)
    cv2.imwrite(str(shots / "colour.png"), cv2.merge([grey, grey // 2, grey]))
    (shots / "cut.jpg").write_bytes(b"\xff\xd8\xff")
    (shots / os.fsdecode(b"\xff.png")).write_bytes((shots / "deep0.png").read_bytes())
    (shots / "notes.txt").write_text("no photograph")
    (shots / "again.png").write_bytes((shots / "deep0.png").read_bytes())
    made = prepare(
        [shots], folder / "camera.json", board=folder / "board.toml", home=tmp_path
    )
    said = "\n".join(made.lines)
    assert "left out notes.txt: no images" in said
    assert "left out cut.jpg" in said
    assert "the same photographs again" in said
    assert "\\udcff.png (its name is not UTF-8" in said
    assert "2 of 3 photographs have 16 bits" in said
    assert "1 of 3 photographs are in colour" in said


def test_a_photograph_of_another_board_is_named(folder, tmp_path):
    shots = write_set(tmp_path, POSES[:3])
    other = board_of({**BOARD, "first_id": 5}, "board")
    cv2.imwrite(str(shots / "other.png"), image(POSES[1], 7, printed=other))
    with pytest.raises(ArgumentError, match=r"other.png: less than 60 % of the markers") as caught:
        prepare([shots], folder / "camera.json", board=folder / "board.toml", home=tmp_path)
    assert "\n" not in str(caught.value)


def test_images_of_two_cameras_side_by_side_get_a_hint(folder, tmp_path):
    for number, pose in enumerate(POSES[:2]):
        halves = [image(pose, number), image(pose, number + 5)]
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.hstack(halves))
    path = tmp_path / "both.json"
    path.write_text(camera((720, 270), (420.0, 420.0, 360.0, 132.0)))
    with pytest.raises(ArgumentError, match=r"in both halves .* .--stereo FILE"):
        prepare([tmp_path], path, board=folder / "board.toml", home=tmp_path)
