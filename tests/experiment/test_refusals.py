"""A file that cannot be run says so: all its faults, a line each, and nothing is written.

The lines are few, short and printable, also of files that mean harm.
"""

import os

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sweep.cli import main
from sweep.errors import MAX_FAULTS, PipelineError
from sweep.experiment.photographs import read_board
from sweep.experiment.pipeline import Pipeline, cell
from sweep.messages import MAX_LINE_LENGTH

P = "[pose]\ndistance_m = 1\n"
AXES = P + "jitter_px = 1\n[axes]\n"
DIGITS = "0x1" + "0" * 20_000
BOARD = """
[marker]
dictionary = "DICT_4X4_50"
size_m = 0.05
[estimator]
solver = "iterative"
[pose]
distance_m = 0.4
[board]
"""
ONE = "[[board.markers]]\nmarker_id = 1\nx_m = 0\ny_m = 0\n"
TABLE = f'kind = "markers"\n{ONE}[[board.markers]]\nmarker_id = 2\nx_m = 0.1\ny_m = 0\n'
GRID = 'kind = "grid"\nrows = 5\ncolumns = 7\ngap_m = 0.01'
TOGETHER = {"zip": {"fx_px": [600, 800], "fy_px": [600, 800]}}


def beside(**keys):
    return "\n[[board.distractors]]\n" + "".join(f"{k} = {v}\n" for k, v in keys.items())


TILTED = "[[board.markers]]\nmarker_id = 0\nx_m = 0\ny_m = 0\ntilt_deg = 90\nazimuth_deg = 90\n"


def assert_told(error):
    """Return what a refusal tells; every line is fit to be printed."""
    lines = str(error).split("\n")
    assert len(lines) <= MAX_FAULTS + 1
    assert all(line.isprintable() and 0 < len(line) <= MAX_LINE_LENGTH for line in lines)
    return [line.removeprefix("pipeline: ") for line in lines]


def faults_of(read, *arguments, **options):
    """Return the lines that refuse something."""
    with pytest.raises(PipelineError) as refused:
        read(*arguments, **options)
    return assert_told(refused.value)


def refusal(document, *settings):
    """Return the lines that refuse a document, text or nested dictionaries."""
    read = Pipeline.from_text if isinstance(document, str) else Pipeline.from_dict
    return faults_of(read, document, settings)


# What is wrong, and what its message must hold: key, value, what was expected.
BROKEN = [
    (P + "[camra]\nwidth_px = 640", "camra: unknown key; expected a section of title, seed,"),
    ('[pose]\ndistance_m = "near"', 'pose.distance_m = "near": expected a number above 0'),
    ("[axes]\ndistance_m = [1, -1]",
     "axes.distance_m = [1, -1]: expected a number above 0 and at most 1e+12 (not -1)"),
    ("[pose]\ntilt_deg = 0", "pose: expected distance_m or side_px, fixed or under [axes]"),
    (P + "[camera]\nfy_px = 500", "fy_px = 500: expected fx_px beside it"),
    (P + "[camera]\ndistortion = [0.1, 0, 0]",
     "camera.distortion = [0.1, 0, 0]: expected a list of 0, 4, 5, 8, 12 or 14 finite numbers"),
    (P + '[axes]\ndictionary = ["DICT_5X5_100", "DICT_4X4_50"]\nmarker_id = { range = [0, 60] }',
     "expected IDs from 0 to 49, which is what DICT_4X4_50 has"),
    (P + "[detector]\nadaptiveThreshWinSizeMin = 31",
     "adaptiveThreshWinSizeMax = 23: expected at least adaptiveThreshWinSizeMin"),
    (P + "tilt_deg = 3\n[axes]\ntilt_deg = [0, 1]",
     "axes.tilt_deg = [0, 1]: expected it once: pose.tilt_deg is given too"),
    (P + "[axes]\ntilt_deg = [0, 1, 0.0]", "expected each value once (0.0 is repeated)"),
    (P + "[axes]\ntilt_deg = { linspce = [0, 1, 3] }",
     "a table with one of range, arange, linspace, geom, values; did you mean linspace?"),
    (P + "[axes]\ntrial = 5",
     "axes.trial = 5: expected something random to repeat: jitter_px above 0"),
    (P + "[marker]\nsize_m = { uniform = [1, 2] }",
     "expected a fixed value; only these can be drawn: distance_m"),
    (P + "tilt_deg = { uniform = [0, 400] }",
     "pose.tilt_deg = {uniform = [0, 400]}: expected a number from -360 to 360"),
    ("pose = 3\n[axes]\ndistance_m = [1]\nfy_px = [1]\ntrial = 4",
     "pose = 3: expected a table: [pose]"),
    (P + '[require]\nall = ["flips <= 0.1"]', 'all = "flips <= 0.1": nothing of this name has'),
    (P + '[require]\nall = ["detection >= 0.9"]\nper = ["solver"]',
     "require.per: solver: no such axis; expected one under [axes] of the scene: there is none"),
    ("[pose\ndistance_m = 1", "not TOML: "),
    (P + '[scene]\nbackground = "none.png"',
     'scene.background = "none.png": expected a level or an image file (No such file'),
    (BOARD + TABLE.replace("0.1", "0.06"),
     "board.markers = [1, 2]: expected markers that do not overlap"),
    (BOARD + 'kind = "charuco"\nsquares_x = 20\nsquares_y = 20\nsquare_m = 0.06',
     "expected IDs from 0 to 49, which is what DICT_4X4_50 has; the board has 200 markers"),
    (BOARD + 'kind = "diamond"\nsquare_m = 0.05', "marker.size_m = 0.05: expected below square_m"),
    (BOARD + "rows = 3",
     "board.rows = 3: expected kind = grid, which uses it; kind = none does not"),
    (BOARD + GRID + beside(x_m=0.2, y_m=0.16),
     "board.distractors[0].x_m = 0.2: expected no overlap with the board, white quiet zones"),
    (BOARD + GRID + beside(x_m=0.5, y_m=0, marker_id=50),
     "board.distractors[0].marker_id = 50: expected an ID from 0 to 49, which is what DICT_4X4"),
    ((BOARD + GRID, "solver='ippe_square'"), "others with points = largest_marker"),
    ((BOARD + GRID, "points='chessboard'"), "kind = charuco or diamond, which have a chessboard"),
    ((BOARD + GRID + beside(x_m=0.5, y_m=0, z_m=0.1), "renderer='warp'"),
     "exact, for prints with z_m or tilt_deg"),
    (BOARD.replace('solver = "iterative"', "") + GRID,
     "expected one of ippe, iterative, sqpnp, epnp"),
    ("[pose]\ntilt_deg = [0, 30]", "an axis: they go under [axes]"),
    ("solver = 'ippe'", "it belongs under [estimator]"), ("[pose]\nseed = 3", "at the top"),
    ("[camera]\nvelocty_x_m_s = 3", "did you mean velocity_x_m_s under [scene]?"),
    ("[detector]\ncornerRefinementMethod = 1", "expected one of none, subpix, contour, apriltag"),
    ("[detector]\ncorner_refinement_method = 'subpix'", "did you mean cornerRefinementMethod?"),
    (("", "Tilt_Deg=3"), "did you mean tilt_deg?"),
    ((P, "tilt_deg"), "expected name=value"),
    ((P, "dictionary=4X4"), "; did you mean DICT_4X4_50?"),
    ((P, "aprilTagDeglitch=1"), "aprilTagDeglitch = 1"),  # OpenCV reads memory that it never wrote
    ((AXES + "trial = 40", "sampling=sobol"),
     "axes.trial = 40: expected a multiple of 16, at least 32, for sampling"),
    (BOARD + 'kind = "markers"\n' + TILTED + TILTED.replace("id = 0", "id = 1"), "do not overlap"),
    *(((BOARD + 'kind = "markers"\n' + TILTED, setting), expected) for setting, expected in (
        ("solver=ippe", "one of iterative, sqpnp, epnp, photometric"),
        ("solver=photometric_real", "one of iterative, sqpnp, epnp, photometric"),
        ("curvature_per_m=1", "it absent, for prints with z_m or tilt_deg"),
        ("renderer=warp", "exact, for prints"), ("refineDetectedMarkers=true", "false, for prints"),
    )),
    *(((BOARD + GRID, "solver=photometric", setting), "beside solver = photometric")
      for setting in ("points=each_marker", "refine=vvs")),
]

# Sections of a document, and what each of its lines must hold.
SECTIONS = [
    *(({"camera": camera, "pose": {"distance_m": 1.0}}, lines) for camera, *lines in (
        ({"hfov_deg": 60, "vfov_deg": 40}, "vfov_deg = 40: expected hfov_deg or vfov_deg, not"),
        *(({"hfov_deg": bad}, f"camera.hfov_deg = {bad}: expected a number from 1e-05 to 179.9")
          for bad in (180, 0)),
    )),
    *(({"pose": pose}, [line]) for pose, line in (
        ({"distance_m": 1, "camera_x_m": 3, "marker_z_m": 0, "roll_deg": 2},
         "camera_x_m = 3: expected distance_m, roll_deg or camera_x_m, marker_z_m, not both"),
        ({"distance_m": 1, "frame_x": {"normal": [0.5, 0.2]}},
         "frame_x = {normal = [0.5, 0.2]}: expected mean - 8.3 sd and mean + 8.3 sd from 0 to 1"),
    )),
    *(({"pose": {"distance_m": 0.5}, "axes": {"lens": {"zip": zipped}}}, [line])
      for zipped, line in (
        ({"fx_px": [600, 800], "fy_px": [600]}, "lens: .* fx_px has 2, fy_px has 1"),
        ({"fx_px": [600, 800]}, "axes.lens = .* at least two parameters"),
        ({"fx_px": [600, 800], "trial": 2}, "axes.lens.trial = 2: .* an axis of its own"),
        ({"fx_px": [600, 800], "fy_px": {"uniform": [600, 800]}}, "axes.lens.fy_px = .* [camera]"),
        ({"fx_px": [600, 800], "fy_px": {"zip": {"cx_px": [1, 2], "cy_px": [1, 2]}}},
         "axes.lens.fy_px = .* a name of your own"),
        ({"dictionary": ["DICT_4X4_50", "DICT_4X4_100"], "marker_id": [50, 99]},
         "marker_id = 50: expected IDs from 0 to 49"),
        ({"adaptiveThreshWinSizeMin": [3, 9], "adaptiveThreshWinSizeMax": [23, 5]},
         "adaptiveThreshWinSizeMax = 5: expected at least adaptiveThreshWinSizeMin"))),
]
SD = [0.8, 0.9, 1.5, 1.2, 0.004, 0.02, 2e-4, 3e-4, 0.03]
LENS = {"fx_px": 600, "distortion": [-0.2, 0.05, 0.001, -0.0005, 0.01]}
SECTIONS += [
    ({"camera": LENS | camera, "pose": {"distance_m": 1}, "estimator": beliefs}, [line])
    for camera, beliefs, line in (
        ({}, {"believed": "calibration"}, "give calibration_sd under [camera] (or a camera_file)"),
        ({"calibration_sd": SD}, {"believed": "calibration", "believed_fx_px": 600},
         "believed_fx_px = 600: expected no other belief about the camera beside believed"),
        ({"calibration_sd": [1, 1]}, {}, "calibration_sd = [1, 1]: expected a list of 0, 4, 8, 9"),
        ({"calibration_sd": [-1, 1, 1, 1]}, {}, "expected standard deviations of at least 0"),
        ({"calibration_covariance": [1, 2, 0, 0, 2, 1, *[0] * 10]}, {}, "no correlation beyond 1"),
        ({"calibration_covariance": [1, 0.5, 0, 0, 0, 1, *[0] * 10]}, {}, "expected a symmetric"),
        ({}, {"believed_focal_scale": 1.01, "believed_fx_px": 600},
         "believed_fx_px = 600: expected believed_focal_scale or believed_fx_px, not both"),
    )
]
NAMES = [
    *(({name: TOGETHER}, f"axes.{name}: expected another name: the dataset")
      for name in ("detection", "xyz", "jitter_u_px", "solved", "outcome", "cost")),
    ({"my lens": TOGETHER}, "letters, digits and underscores"),
    ({"tilt_deg": TOGETHER}, "an axis of tilt_deg alone"),
]
HOSTILE = [
    # Axes without end, in every form.
    (AXES + "marker_id = { range = [0, 1000000000000] }", "at most 1,000,000,000 values"),
    (AXES + "tilt_deg = { arange = [0, 1e299, 5e-324] }", "at most 1,000"),
    (AXES + "tilt_deg = { linspace = [0, 1, 600000] }\nroll_deg = { linspace = [0, 1, 600000] }",
     "axes.roll_deg = {linspace = [0, 1, 600000]}: expected at most 1,000,000 values, all axes"),
    (AXES + "trial = 1000000000\nmarker_id = { range = [0, 50000] }", "poses: expected at most"),
    (AXES + "minOtsuStdDev = { linspace = [0, 9, 1000] }\n"
     "believed_size_m = { linspace = [0.1, 1, 1000] }",
     "axes: 1e+06 detector settings times estimators: expected at most 10,000"),
    (P + "[camera]\nwidth_px = 100000\nheight_px = 100000\n",
     "camera.height_px = 100000: expected a frame of at most 500,000,000 pixels"),
    # Nesting, and what takes time that grows with a square.
    ("x = " + "[" * 100_000, "not TOML: nested too deeply"),
    (P + "tilt_deg = " + "{a=" * 200 + "1" + "}" * 200, "= {a = {a = "),
    ("a" + ".a" * 100_000 + " = 1", "expected keys of at most 8 parts"),
    # Size, and numbers without end.
    ("# " + "x" * 10_000_000, "expected at most 250,000 bytes"),
    (P + "".join(f"k{i} = 1\n" for i in range(2000)), "... and 1,980 faults more"),
    (f'title = "{"k" * 1000}"\n' + P, "one line of at most 200 characters"),
    (P + f"tilt_deg = {DIGITS}", "pose.tilt_deg = 0x1000"),
    # What a terminal would obey, or take for a line of ours.
    (P + '"\\u001b[2J\\nforged: line" = 1', "pose.\\u001b[2J\\nforged: line: unknown key"),
    (P + 'tilt_deg = "\\u009b31m\\u202e\\u2028\\n"',
     'tilt_deg = "\\u009b31m\\u202e\\u2028\\n": expected'),
    (P + "# \ud800", "expected UTF-8"),
]

BROKEN += [({"pose": {"distance_m": 0.5}, "axes": axes}, message) for axes, message in NAMES]
BROKEN += HOSTILE


@pytest.mark.parametrize(("given", "message"), BROKEN, ids=[message for _, message in BROKEN])
def test_a_broken_document_is_told_with_key_value_and_expectation(given, message):
    lines = refusal(*(given if isinstance(given, tuple) else (given,)))
    assert any(message in line for line in lines), lines


@pytest.mark.parametrize(("sections", "lines"), SECTIONS, ids=[lines[0] for _, lines in SECTIONS])
def test_each_fault_is_one_line(sections, lines):
    told = refusal(sections)
    assert len(told) == len(lines)
    for expected, line in zip(lines, told, strict=True):
        assert all(part in line for part in expected.split(" .* ")), told


@pytest.mark.parametrize("command", ["run", "plan"])
def test_a_broken_file_ends_a_command_and_nothing_is_written(
    command, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.toml").write_text(
        "[pose]\ndistance_m = 1\nside_px = 3\nrol = 1\n[marker]\nmarker_id = 77\n"
        '[detector]\nadaptiveThreshWinSizeMax = 2\n'
        '[require]\nall = ["range_error_p95_m <= 0.1"]'
    )
    assert main([command, "broken.toml"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    lines = told.err.splitlines()
    # Faults of single keys do not hide those across keys.
    for part in ("pose.rol: unknown", "not both", "IDs from 0 to 49", "WinSizeMax = 2",
                 'require.all = "range_error_p95_m <= 0.1": its unit is %: write range_p95'):
        assert [line for line in lines if line.startswith("broken.toml: ") and part in line], part
    assert [path.name for path in tmp_path.iterdir()] == ["broken.toml"]
    assert main([command, "none.toml"]) == 2
    assert "cannot be read: No such file" in capsys.readouterr().err


@pytest.mark.parametrize(("setting", "expected", "at"), [
    ("tilt_deg=" + "[" * 50_000, "expected a TOML value", "expected a TOML value"),
    ("tilt_deg=0x1" + "0" * 5000, "tilt_deg = 0x1", "expected a number"),
    ("\x1b\nforged: x=3", "--set \\u001b\\nforged: x=3: unknown",
     "\\u001b\\nforged: x=3: unknown parameter"),
    ("x=1," * 10_000, "expected a TOML value", "... and 9,980 faults more"),
    ("background=\udcff", "expected a TOML value", "expected a TOML value"),
])
def test_a_hostile_setting_or_place_is_refused_in_short_lines(setting, expected, at):
    assert any(expected in line for line in refusal(P, setting))
    assert any(at in line for line in faults_of(cell, Pipeline.from_text(P), setting))


def test_a_file_with_a_byte_order_mark_is_read(tmp_path):
    (tmp_path / "p.toml").write_bytes(b"\xef\xbb\xbf" + P.encode())
    assert Pipeline.from_toml(tmp_path / "p.toml").fixed["distance_m"] == 1
    (tmp_path / "p.toml").write_bytes(b"\xff\xfe\x00")
    assert "expected UTF-8: byte 0 is not" in faults_of(Pipeline.from_toml, tmp_path / "p.toml")[0]


@settings(derandomize=True, deadline=None, max_examples=60)
@given(st.one_of(
    st.text(),
    st.binary().map(lambda data: data.decode("latin-1")),
    st.lists(st.sampled_from([
        "[pose]\n", "[axes]\n", "[scene]\n", "distance_m", "tilt_deg", "trial", "background", "=",
        "{", "}", "[", "]", ",", ".", "linspace", "range", "values", "uniform", "0", "1", "-7",
        "1e999", "nan", "0x" + "f" * 4000, '"', "'", "\\", "\n", "\r\n", "#", "2020-01-01", "true",
        "\x1b", "\u202e", "é",
    ]), max_size=40).map("".join),
))
def test_any_text_is_a_pipeline_or_is_refused(text):
    for arguments in ((text,), (P, [text]), (P, ["tilt_deg=" + text])):
        try:
            Pipeline.from_text(*arguments)
        except PipelineError as told:
            assert_told(told)


def encoded(ending, image):
    return cv2.imencode(ending, image)[1].tobytes()


NOISE = np.random.default_rng(0).integers(0, 255, (48, 64), dtype=np.uint8)
FRAME = P + "[camera]\nwidth_px = 64\nheight_px = 48\n[scene]\nbackground = '%s'\n"


@pytest.mark.parametrize(("content", "expected"), [
    (b"", "not an image"),
    (encoded(".png", NOISE)[:33], "not an image"), (encoded(".jpg", NOISE)[:1500], "not an image"),
    (encoded(".tiff", NOISE), "not an image that OpenCV can read: a PNG, JPEG, BMP"),
    (encoded(".png", NOISE[:40]), "it is 64 x 40, but height_px = 48"),
])
def test_an_image_that_is_none_is_refused(content, expected, tmp_path, capfd):
    (tmp_path / "image").write_bytes(content)
    assert expected in faults_of(Pipeline.from_text, FRAME % "image", folder=tmp_path)[0]
    assert capfd.readouterr().err == ""


def test_special_files_are_refused_unread(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "zero").symlink_to("/dev/zero")
    with (tmp_path / "large").open("wb") as file:
        file.write(encoded(".png", NOISE))
        file.truncate(10**10)
    for name, expected in (
        ("pipe", "Not a regular file"), ("folder", "Is a directory"), ("loop", "symbolic links"),
        ("zero", "Not a regular file"), ("large", "bytes"),
    ):
        for line, in (faults_of(Pipeline.from_toml, tmp_path / name),
                      faults_of(Pipeline.from_text, FRAME % name, folder=tmp_path)):
            assert expected in line


FILES = {
    "charuco": """kind = "charuco"
dictionary = "4x4_1000"
squares_x = 8
squares_y = 8
square_m = 0.0254
marker_m = 0.019
""",
    "grid": """kind = "grid"
dictionary = "DICT_APRILTAG_36h10"
rows = 2
columns = 2
marker_m = 0.019
gap_m = 0.00475
corner_squares = true
""",
    "markers": """kind = "markers"
dictionary = "DICT_5X5_50"
markers = [
    { marker_id = 1, x_m = 0, y_m = 0, size_m = 0.1 },
    { marker_id = 2, x_m = 0.2, y_m = 0, size_m = 0.1 },
]
""",
}


@pytest.mark.parametrize(("kind", "more", "dictionary", "ids"), [
    ("charuco", "legacy_pattern = true\nfirst_id = 5", "DICT_4X4_1000", tuple(range(5, 37))),
    ("grid", "ids = [3, 2, 1, 0]", "DICT_APRILTAG_36h10", (3, 2, 1, 0)),
    ("markers", "", "DICT_5X5_50", (1, 2)),
])
def test_each_kind_of_board_is_read(kind, more, dictionary, ids, tmp_path):
    (tmp_path / "board.toml").write_text(FILES[kind] + more)
    board = read_board(tmp_path / "board.toml")
    assert (board.dictionary, board.marker_ids) == (dictionary, ids)


KINDS = "expected one of charuco, grid, aprilgrid, markers"


@pytest.mark.parametrize(("text", "line"), [
    ("", f"kind: missing; {KINDS}"), ("kind = ", "not TOML"),
    ('kind = "charucco"', f'kind = "charucco": {KINDS}; did you mean charuco?'),
    (FILES["charuco"] + "square = 3",
     "square: unknown; expected a key of a board of kind charuco: "),
    (FILES["charuco"] + "ids = [1]",
     "ids = [1]: expected 32 IDs, one for each marker in reading order"),
    (FILES["grid"].replace("0.00475", "0"),
     "gap_m = 0.0: expected above 0 beside corner_squares = true"),
    ('kind = "markers"\ndictionary = "DICT_5X5_50"\nmarkers = []',
     "markers = []: expected 1 to 4000 markers; these are 0"),
    (FILES["markers"] + "margin_m = 0.1\nquiet_zone_modules = 2",
     "margin_m = 0.1: expected margin_m (one sheet) or quiet_zone_modules (a sheet each), not"),
    (None, "cannot be read: No such file"), (b"\xff\xfe\x00", "expected UTF-8"),
])
def test_a_fault_of_a_board_s_file_is_one_line(tmp_path, text, line):
    file = tmp_path / "board.toml"
    if text is not None:
        file.write_bytes(text.encode() if isinstance(text, str) else text)
    (fault,) = faults_of(read_board, file)
    assert fault.partition("board.toml")[2].removeprefix(": ").startswith(line), fault
