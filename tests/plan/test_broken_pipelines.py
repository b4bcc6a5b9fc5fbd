"""A file that cannot be run says so: all its faults at once, exit status 2, nothing written."""

import numpy as np
import pytest

from sweep.cli import main
from sweep.errors import PipelineError
from sweep.plan.experiment import Pipeline

# What is wrong, the file, and what its message must hold: file, key, value, what was expected.
BROKEN = {
    "unknown key, nearest named": (
        "[pose]\ndistance_m = 1\ntilt_dge = 3",
        "pose.tilt_dge: unknown key; did you mean tilt_deg?",
    ),
    "unknown section, nearest named": (
        "[pose]\ndistance_m = 1\n[camra]\nwidth_px = 640",
        ("camra: unknown; expected a section of title, seed, sampling, effects, camera, marker, "
        "board, pose, scene, detector, estimator, axes, require, limit, precision, choose; "
        "did you mean camera?"),
    ),
    "a key without its section": (
        "tilt_deg = 3\n[pose]\ndistance_m = 1", "tilt_deg = 3: expected it under [pose]",
    ),
    "a key under another section": (
        "[pose]\ndistance_m = 1\n[camera]\nsize_m = 1",
        "camera.size_m: unknown key; it belongs under [marker]",
    ),
    "unknown axis, nearest named": (
        "[axes]\ndistance = [1, 2]\n[pose]\ndistance_m = 1",
        "axes.distance: unknown parameter; did you mean distance_m?",
    ),
    "wrong type": (
        '[pose]\ndistance_m = "near"',
        'pose.distance_m = "near": expected a number above 0',
    ),
    "a boolean is no number": (
        "[pose]\ndistance_m = true", "pose.distance_m = true: expected a number above 0",
    ),
    "a fraction where a count belongs": (
        "[pose]\ndistance_m = 1\n[camera]\nwidth_px = 640.5",
        "camera.width_px = 640.5: expected a whole number from 1 to 100000",
    ),
    "out of range": (
        "[pose]\ndistance_m = 1\ntilt_deg = 500",
        "pose.tilt_deg = 500: expected a number from -360 to 360",
    ),
    "distance at 0": ("[pose]\ndistance_m = 0", "pose.distance_m = 0: expected a number above 0"),
    "distance below 0 on an axis": (
        "[axes]\ndistance_m = [1, -1]",
        "axes.distance_m = [1, -1]: expected a number above 0 and at most 1e+12 (not -1)",
    ),
    "not finite": ("[pose]\ndistance_m = inf", "pose.distance_m = inf: expected a number above 0"),
    "not a number": ("[pose]\ndistance_m = nan", "pose.distance_m = nan: expected a number"),
    "neither distance nor side": (
        "[pose]\ntilt_deg = 0", "pose: expected distance_m or side_px, fixed or under [axes]",
    ),
    "distance and side": (
        "[pose]\ndistance_m = 1\nside_px = 30",
        "side_px = 30: expected distance_m or side_px, not both; delete one of them",
    ),
    "camera in millimetres and in pixels": (
        "[pose]\ndistance_m = 1\n[camera]\nfx_px = 500\nfocal_length_mm = 4",
        ("fx_px = 500: expected a camera in pixels or in millimetres, not both; delete it or "
        "focal_length_mm"),
    ),
    "fy without fx": (
        "[pose]\ndistance_m = 1\n[camera]\nfy_px = 500", "fy_px = 500: expected fx_px beside it",
    ),
    "three lens coefficients": (
        "[pose]\ndistance_m = 1\n[camera]\ndistortion = [0.1, 0, 0]",
        "camera.distortion = [0.1, 0, 0]: expected a list of 0, 4, 5, 8, 12 or 14 finite numbers",
    ),
    "an ID outside its dictionary": (
        '[pose]\ndistance_m = 1\n[marker]\ndictionary = "DICT_5X5_50"\nmarker_id = 50',
        "marker_id = 50: expected IDs from 0 to 49, which is what DICT_5X5_50 has",
    ),
    "an ID outside one dictionary of the grid": (
        ('[pose]\ndistance_m = 1\n[axes]\ndictionary = ["DICT_5X5_100", "DICT_4X4_50"]\n'
        "marker_id = { range = [0, 60] }"),
        "expected IDs from 0 to 49, which is what DICT_4X4_50 has",
    ),
    "unknown dictionary": (
        '[pose]\ndistance_m = 1\n[marker]\ndictionary = "DICT_9X9"',
        'marker.dictionary = "DICT_9X9": expected one of DICT_4X4_100',
    ),
    "unknown renderer": (
        '[pose]\ndistance_m = 1\n[scene]\nrenderer = "supersample-0"',
        'scene.renderer = "supersample-0": expected exact, warp, supersample-N',
    ),
    "unknown refinement": (
        '[pose]\ndistance_m = 1\n[detector]\ncornerRefinementMethod = "best"',
        'detector.cornerRefinementMethod = "best": expected one of none, subpix, contour, apriltag',
    ),
    "unknown solver": (
        '[pose]\ndistance_m = 1\n[estimator]\nsolver = "dlt"',
        'estimator.solver = "dlt": expected one of ippe, ippe_square',
    ),
    "largest threshold window below the smallest": (
        "[pose]\ndistance_m = 1\n[detector]\nadaptiveThreshWinSizeMin = 31",
        "adaptiveThreshWinSizeMax = 23: expected at least adaptiveThreshWinSizeMin",
    ),
    "an axis given twice": (
        "[pose]\ndistance_m = 1\ntilt_deg = 3\n[axes]\ntilt_deg = [0, 1]",
        "axes.tilt_deg = [0, 1]: expected it once: pose.tilt_deg is given too",
    ),
    "an empty axis": (
        "[pose]\ndistance_m = 1\n[axes]\ntilt_deg = []",
        "axes.tilt_deg = []: expected at least one value",
    ),
    "an empty range": (
        "[pose]\ndistance_m = 1\n[axes]\nmarker_id = { range = [5, 5] }",
        "axes.marker_id = {range = [5, 5]}: expected at least one value",
    ),
    "a repeated value": (
        "[pose]\ndistance_m = 1\n[axes]\ntilt_deg = [0, 1, 0.0]",
        "expected each value once (0.0 is repeated)",
    ),
    "an unknown form of axis": (
        "[pose]\ndistance_m = 1\n[axes]\ntilt_deg = { linspce = [0, 1, 3] }",
        ("expected a list, or a table with one of range, arange, linspace, geom, values; "
        "did you mean linspace?"),
    ),
    "a geometric axis from 0": (
        "[axes]\ndistance_m = { geom = [0, 1, 3] }",
        "expected geom = [first, last, count], both inclusive, above 0",
    ),
    "an axis of 10^12 values": (
        "[axes]\ndistance_m = { linspace = [1, 2, 1000000000000] }",
        "expected at most 1,000,000 values",
    ),
    "an endless step": (
        "[axes]\ndistance_m = { arange = [1, 2, 0] }",
        "expected arange = [start, stop, step], half-open",
    ),
    "a scalar axis": (
        "[pose]\ndistance_m = 1\n[axes]\ntilt_deg = 4",
        "axes.tilt_deg = 4: expected a list, or a table",
    ),
    "trials of nothing random": (
        "[pose]\ndistance_m = 1\n[axes]\ntrial = 5",
        "axes.trial = 5: expected something random to repeat: jitter_px above 0",
    ),
    "no trials": (
        "[pose]\ndistance_m = 1\njitter_px = 1\n[axes]\ntrial = 0",
        "axes.trial = 0: expected a whole number from 1 to 1,000,000,000",
    ),
    "a distribution of what is not drawn": (
        "[pose]\ndistance_m = 1\n[marker]\nsize_m = { uniform = [1, 2] }",
        "expected a fixed value; only these can be drawn: distance_m",
    ),
    "a distribution the wrong way round": (
        "[pose]\ndistance_m = { uniform = [2, 1] }", "expected uniform = [a, b] with a < b",
    ),
    "a distribution beyond the range": (
        "[pose]\ndistance_m = 1\ntilt_deg = { uniform = [0, 400] }",
        "pose.tilt_deg = {uniform = [0, 400]}: expected a number from -360 to 360",
    ),
    "a distribution under axes": (
        "[pose]\ndistance_m = 1\n[axes]\ntilt_deg = { normal = [0, 4] }",
        "expected an axis; a distribution goes under [pose]",
    ),
    "an axis under its section": (
        "[pose]\ndistance_m = { geom = [0.1, 1, 4] }",
        "expected one value here; more than one goes under [axes]",
    ),
    "a normal whose draws leave the range": (
        "[pose]\ndistance_m = { normal = [0.05, 0.05] }",
        "expected mean - 8.3 sd and mean + 8.3 sd above 0 and at most 1e+12",
    ),
    "a number of 400 digits": (
        "[pose]\ndistance_m = 1\n[marker]\nmarker_id = 1" + "0" * 400,
        "expected a whole number from 0 to 1e+06",
    ),
    "a step too small to count": (
        "[axes]\ndistance_m = { arange = [0.1, 1e299, 1e-200] }",
        "expected at most 1,000,000 values",
    ),
    "a whole frame too large to hold": (
        ('[pose]\ndistance_m = 1\n[scene]\nwindow = "full"\n[camera]\nwidth_px = 100000\n'
        "height_px = 100000"),
        "expected auto, for a frame of more than 500,000,000 pixels",
    ),
    "a section that is no table, beside others": (
        "pose = 3\n[axes]\ndistance_m = [1]\nfy_px = [1]\ntrial = 4",
        "pose = 3: expected a table: [pose]",
    ),
    "a requirement without a relation": (
        '[pose]\ndistance_m = 1\n[require]\nall = ["detection"]',
        'require.all = "detection": expected NAME >= NUMBER',
    ),
    "a requirement of what does not exist": (
        '[pose]\ndistance_m = 1\n[require]\nall = ["detektion >= 0.5"]',
        ('require.all = "detektion >= 0.5": detektion: nothing of this name has an interval; '
         "did you mean detection_rate?"),
    ),
    "a requirement in a wrong unit, beside another fault": (
        '[pose]\ndistance = 1\n[require]\nall = ["range_error_p95_m <= 0.1"]',
        'require.all = "range_error_p95_m <= 0.1": its unit is %: write range_p95_percent',
    ),
    "requirements that contradict each other": (
        '[pose]\ndistance_m = 1\n[require]\nall = ["detection >= 0.9", "detection <= 0.5"]',
        'require.all = "detection_rate >= 0.9": contradicts detection_rate <= 0.5',
    ),
    "a condition that is no axis": (
        '[pose]\ndistance_m = 1\n[require]\nall = ["detection >= 0.9"]\nper = ["dist_m"]',
        "require.per: dist_m: no such axis; did you mean distance_m?",
    ),
    "a condition that is a configuration": (
        '[pose]\ndistance_m = 1\n[require]\nall = ["detection >= 0.9"]\nper = ["solver"]',
        "require.per: solver: configurations are always told apart",
    ),
    "conditions of nothing": (
        '[pose]\ndistance_m = 1\n[require]\nper = ["distance_m"]', "what is required, too",
    ),
    "an unknown key of what is required": (
        '[pose]\ndistance_m = 1\n[require]\nany = ["detection >= 0.9"]',
        "require.any: unknown key; expected all or per",
    ),
    "a negative seed": (
        "seed = -1\n[pose]\ndistance_m = 1", "seed = -1: expected a whole number from 0",
    ),
    "not TOML": ("[pose\ndistance_m = 1", "not TOML: "),
    "a key given twice": ("[pose]\ndistance_m = 1\ndistance_m = 2", "not TOML: "),
    "nested too deeply": ("x = " + "[" * 100_000, "not TOML: nested too deeply"),
    "a section that is no table": ("pose = 3", "pose = 3: expected a table: [pose]"),
    "a background that is not there": (
        '[pose]\ndistance_m = 1\n[scene]\nbackground = "none.png"',
        'scene.background = "none.png": expected a level or an image file (No such file',
    ),
    "a grid without end": (
        ("[pose]\njitter_px = 1\n[axes]\ndistance_m = { linspace = [1, 2, 10000] }\n"
        "trial = 1000000000"),
        "axes: 1e+13 poses: expected at most 1e+12",
    ),
}


@pytest.mark.parametrize(("text", "message"), BROKEN.values(), ids=BROKEN)
def test_broken_file_names_file_key_value_and_expectation(
    text, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.toml").write_text(text)
    assert main(["run", "broken.toml"]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert "Traceback" not in told.err
    assert any(
        line.startswith("broken.toml: ") and message in line for line in told.err.splitlines()
    ), told.err
    assert [path.name for path in tmp_path.iterdir()] == ["broken.toml"]


def test_all_faults_are_told_at_once(tmp_path):
    path = tmp_path / "many.toml"
    path.write_text("[pose]\ndistance_m = 0\ntilt_deg = 999\nrol = 1\n[axes]\nsolver = ['x']")
    with pytest.raises(PipelineError) as told:
        Pipeline.from_toml(path)
    assert len(told.value.faults) == 4


def test_a_missing_file_and_one_that_is_no_text_are_told_in_a_line(tmp_path, capsys):
    assert main(["plan", str(tmp_path / "none.toml")]) == 2
    assert "cannot be read: No such file" in capsys.readouterr().err
    (tmp_path / "bytes.toml").write_bytes(b"\xff\xfe\x00")
    assert main(["plan", str(tmp_path / "bytes.toml")]) == 2
    assert "expected UTF-8" in capsys.readouterr().err
    (tmp_path / "long.toml").write_text("# " + "x" * 2_000_000)
    assert main(["plan", str(tmp_path / "long.toml")]) == 2
    assert "expected at most 250,000 bytes" in capsys.readouterr().err


def test_a_background_of_another_size_or_no_image_is_told(tmp_path, capsys):
    import cv2  # noqa: PLC0415

    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((48, 64), np.uint8))
    (tmp_path / "text.png").write_text("no image")
    for name, words in (
        ("small.png", "an image of exactly the frame's size: it is 64 x 48, but width_px = 640"),
        ("text.png", "not an image that OpenCV can read"),
    ):
        path = tmp_path / "p.toml"
        path.write_text(f'[pose]\ndistance_m = 1\n[scene]\nbackground = "{name}"')
        assert main(["run", str(path), "--store", str(tmp_path / "s.zarr")]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("tilt_deg", "expected key=value"),
        ("tilt=3", "unknown parameter; did you mean"),
        ("tilt_deg=[0, 1", "expected a TOML value"),
        ("camera.tilt_deg=3", "expected tilt_deg or pose.tilt_deg"),
        ("tilt_deg=3\nseed=4", "expected a TOML value"),
        ("solver=best", 'estimator.solver = "best": expected one of'),
    ],
)
def test_a_broken_setting_is_told(setting, message, tmp_path, capsys):
    path = tmp_path / "p.toml"
    path.write_text("[pose]\ndistance_m = 1")
    assert main(["plan", str(path), "--set", setting]) == 2
    assert message in capsys.readouterr().err


def test_settings_replace_values_axes_and_distributions(tmp_path):
    path = tmp_path / "p.toml"
    path.write_text("# kept\n[pose]\ndistance_m = 1\n[axes]\ntilt_deg = [0, 1]")
    pipeline = Pipeline.from_toml(
        path,
        ["tilt_deg=5", "distance_m=[1, 2]", "roll_deg={uniform = [0, 90]}", "solver=sqpnp",
         "trial=3", "distortion=[[], [0.1, 0, 0, 0]]", "seed=7"],
    )
    assert pipeline.fixed["tilt_deg"] == 5.0
    assert [axis.name for axis in pipeline.axes] == ["distance_m", "trial", "distortion"]
    assert pipeline.fixed["solver"] == "sqpnp"
    assert str(pipeline.distributions["roll_deg"]) == "uniform(0,90)"
    assert pipeline.seed == 7
    assert pipeline.text.startswith("# kept")
    again = Pipeline.from_text(pipeline.text)
    assert (again.fixed, again.axes) == (pipeline.fixed, pipeline.axes)


def test_faults_of_single_keys_do_not_hide_those_across_keys(tmp_path):
    path = tmp_path / "both.toml"
    path.write_text(
        "[pose]\ndistance_m = 1\nside_px = 3\nrol = 1\n[marker]\nmarker_id = 77\n"
        "[detector]\nadaptiveThreshWinSizeMax = 2"
    )
    with pytest.raises(PipelineError) as told:
        Pipeline.from_toml(path)
    text = str(told.value)
    for part in ("pose.rol: unknown", "not both", "IDs from 0 to 49", "WinSizeMax = 2"):
        assert part in text
