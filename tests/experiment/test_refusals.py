"""A file that cannot be run says so: all its faults, a line each, and nothing is written."""

import pytest

import sweep
from sweep.cli import main
from sweep.errors import PipelineError

P = "[pose]\ndistance_m = 1\n"
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


UPRIGHT = beside(x_m=0.5, y_m=0, z_m=0, tilt_deg=90, azimuth_deg=0)


def refusal(document, *settings):
    """Return the lines that refuse a document, text or nested dictionaries."""
    read = sweep.Pipeline.from_text if isinstance(document, str) else sweep.Pipeline.from_dict
    with pytest.raises(PipelineError) as refused:
        read(document, settings)
    return [line.removeprefix("pipeline: ") for line in refused.value.faults]


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
    (P + '[marker]\ndictionary = "DICT_9X9"',
     'marker.dictionary = "DICT_9X9": expected one of DICT_4X4_100'),
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
    (P + '[require]\nall = ["detection"]', 'require.all = "detection": expected NAME >= NUMBER'),
    (P + '[require]\nall = ["detection >= 0.9"]\nper = ["solver"]',
     "require.per: solver: no such axis; expected one under [axes] of the scene: there is none"),
    ("[pose\ndistance_m = 1", "not TOML: "),
    (P + '[scene]\nbackground = "none.png"',
     'scene.background = "none.png": expected a level or an image file (No such file'),
    (BOARD + TABLE.replace("0.1", "0.06"),
     "board.markers = [1, 2]: expected markers that do not overlap"),
    (BOARD + TABLE.replace("= 2", "= 1"),
     "board.markers = [1, 1]: expected each ID once; 1 is listed"),
    (BOARD + TABLE.replace("= 2", "= 50"), "expected IDs from 0 to 49"),
    (BOARD + TABLE.replace("y_m = 0\n", "y_m = 0\nw_m = 0\n", 1),
     "board.markers[0].w_m: unknown; expected a key of a marker: marker_id, x_m"),
    (BOARD + TABLE.replace("x_m = 0.1\n", ""), "board.markers[1].x_m: missing; expected a number"),
    (BOARD + 'kind = "charuco"\nsquares_x = 20\nsquares_y = 20\nsquare_m = 0.06',
     "expected IDs from 0 to 49, which is what DICT_4X4_50 has; the board has 200 markers"),
    (BOARD + 'kind = "diamond"\nsquare_m = 0.05', "marker.size_m = 0.05: expected below square_m"),
    (BOARD + GRID.replace("7", "1000"), "a board of at most 4000 markers; it has 5000"),
    (BOARD + 'kind = "diamond"', 'board.square_m: missing; kind = "diamond"'),
    (BOARD + "rows = 3",
     "board.rows = 3: expected kind = grid, which uses it; kind = none does not"),
    (BOARD + GRID + beside(x_m=0.2, y_m=0.16),
     "board.distractors[0].x_m = 0.2: expected no overlap with the board, white quiet zones"),
    (BOARD + GRID + UPRIGHT + UPRIGHT.replace("z_m = 0", "z_m = 0.03"),
     "board.distractors[1].x_m = 0.5: expected no overlap with distractors[0]"),
    (BOARD + GRID + beside(x_m=0.5, y_m=0, marker_id=50),
     "board.distractors[0].marker_id = 50: expected an ID from 0 to 49, which is what DICT_4X4"),
    ((BOARD + GRID, "solver='ippe_square'"), "others with points = largest_marker"),
    ((BOARD + GRID, "points='chessboard'"), "kind = charuco or diamond, which have a chessboard"),
    ((BOARD + GRID + beside(x_m=0.5, y_m=0, z_m=0.1), "renderer='warp'"),
     "exact, for prints with z_m or tilt_deg"),
    (BOARD.replace('solver = "iterative"', "") + GRID,
     "expected one of ippe, iterative, sqpnp, epnp"),
    ("[pose]\ntilt_deg = [0, 30]", "an axis: they go under [axes]"),
    ("[pose]\ntrial = 3", "belongs under [axes]"), ("trial = 3", "it belongs under [axes]"),
    ("solver = 'ippe'", "it belongs under [estimator]"), ("[pose]\nseed = 3", "at the top"),
    ("[camera]\nvelocty_x_m_s = 3", "did you mean velocity_x_m_s under [scene]?"),
    ("[detector]\ncornerRefinementMethod = 1", "OpenCV's constant 1 is subpix"),
    ("[marker]\ndictionary = 4", "OpenCV's constant 4 is DICT_5X5_50"),
    ('[estimator]\nsolver = "ippe_sqare"', "did you mean ippe_square?"),
    ("[pose]\nTilt_Deg = 3", "did you mean tilt_deg?"),
    ("[detector]\ncorner_refinement_method = 'subpix'", "did you mean cornerRefinementMethod?"),
    ("[Pose]\ntilt_deg = 3", "did you mean pose?"),
    (("", "Tilt_Deg=3"), "did you mean tilt_deg?"),
    ((P, "tilt_deg"), "expected name=value"),
    ((P, "tilt=3"), "unknown parameter; did you mean"),
    ((P, "tilt_deg=[0, 1"), "expected a TOML value"),
    ((P, "camera.tilt_deg=3"), "expected tilt_deg or pose.tilt_deg"),
    ((P, "solver=best"), 'estimator.solver = "best": expected one of'),
]

# Sections of a document, and what each of its lines must hold.
SECTIONS = [
    *(({"camera": camera, "pose": {"distance_m": 1.0}}, lines) for camera, *lines in (
        ({"hfov_deg": 60, "vfov_deg": 40}, "vfov_deg = 40: expected hfov_deg or vfov_deg, not"),
        ({"vfov_deg": 60, "focal_length_mm": 5, "sensor_width_mm": 6},
         "vfov_deg = 60: expected sensor_width_mm, focal_length_mm or vfov_deg, not both"),
        ({"pixel_size_um": 3, "sensor_width_mm": 6, "focal_length_mm": 4},
         "pixel_size_um = 3: expected sensor_width_mm or pixel_size_um, not both"),
        *(({"hfov_deg": bad}, f"camera.hfov_deg = {bad}: expected a number from 1e-05 to 179.9")
          for bad in (180, 0)),
        ({"fov_deg": 60}, "camera.fov_deg: unknown key; did you mean"),
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
        ({"fx_px": [600, 800], "solver": ["ippe", "iterative"]}, "axes.lens: .* of one stage"),
        ({"fx_px": [600, 800, 600], "fy_px": [600, 800, 600]}, "lens: .* 600, 600 is repeated"),
        ({"fx_px": [600, 800], "trial": 2}, "axes.lens.trial = 2: .* an axis of its own"),
        ({"fx_px": [600, 800], "fy_px": {"uniform": [600, 800]}}, "axes.lens.fy_px = .* [camera]"),
        ({"fx_px": [600, 800], "fy_px": {"zip": {"cx_px": [1, 2], "cy_px": [1, 2]}}},
         "axes.lens.fy_px = .* a name of your own"),
        ({"fx_px": [600, -1], "fy_px": [600, 800]}, "axes.lens.fx_px = .* (not -1)"),
        ({"distance_m": [1, 2], "tilt_deg": [1, 2]}, "axes.lens.distance_m = .* pose.distance_m"),
        ({"dictionary": ["DICT_4X4_50", "DICT_4X4_100"], "marker_id": [50, 99]},
         "marker_id = 50: expected IDs from 0 to 49"),
        ({"adaptiveThreshWinSizeMin": [3, 9], "adaptiveThreshWinSizeMax": [23, 5]},
         "adaptiveThreshWinSizeMax = 5: expected at least adaptiveThreshWinSizeMin"))),
]
NAMES = [
    *(({name: TOGETHER}, f"axes.{name}: expected another name: the dataset")
      for name in ("detection", "xyz", "jitter_u_px", "solved", "outcome", "cost")),
    ({"my lens": TOGETHER}, "letters, digits and underscores"),
    ({"tilt_deg": TOGETHER}, "an axis of tilt_deg alone"),
    ({"trial": TOGETHER}, "a whole number from 1"),
    ({"fx_px": [1], "lens": TOGETHER}, "axes.fx_px is given too"),
    ({"lens": TOGETHER, "fx_px": [1]}, "axes.lens.fx_px is given too"),
    ({"a": TOGETHER, "b": TOGETHER}, "axes.a.fx_px is given too"),
]
BROKEN += [({"pose": {"distance_m": 0.5}, "axes": axes}, message) for axes, message in NAMES]


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
        "[detector]\nadaptiveThreshWinSizeMax = 2"
    )
    assert main([command, "broken.toml"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    lines = told.err.splitlines()
    # Faults of single keys do not hide those across keys.
    for part in ("pose.rol: unknown", "not both", "IDs from 0 to 49", "WinSizeMax = 2"):
        assert [line for line in lines if line.startswith("broken.toml: ") and part in line], part
    assert [path.name for path in tmp_path.iterdir()] == ["broken.toml"]
    assert main([command, "none.toml"]) == 2
    assert "cannot be read: No such file" in capsys.readouterr().err


def test_all_faults_of_a_table_come_at_once():
    lines = refusal(BOARD + TABLE.replace("x_m = 0\n", "X = 0\n") + "size_m = true")
    assert [line.split(" ")[0] for line in lines] == [
        "board.markers[0].X:", "board.markers[0].x_m:", "board.markers[1].size_m"
    ]


@pytest.mark.parametrize(("text", "message"), [
    (P + '[require]\nall = ["detektion >= 0.5"]',
     "detektion: nothing of this name has an interval; did you mean detection_rate?"),
    ('[pose]\ndistance = 1\n[require]\nall = ["range_error_p95_m <= 0.1"]',
     'require.all = "range_error_p95_m <= 0.1": its unit is %: write range_p95_percent'),
    (P + '[require]\nall = ["detection >= 0.9", "detection <= 0.5"]',
     'require.all = "detection_rate >= 0.9": contradicts detection_rate <= 0.5'),
    (P + '[require]\nall = ["detection >= 0.9"]\nper = ["dist_m"]',
     "require.per: dist_m: no such axis; did you mean distance_m?"),
])
def test_a_requirement_of_nothing_that_is_known_is_told_by_a_run(
    text, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.toml").write_text(text)
    assert main(["run", "broken.toml"]) == 2
    assert message in capsys.readouterr().err
