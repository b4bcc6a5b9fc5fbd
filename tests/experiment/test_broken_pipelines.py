"""A file that cannot be run says so: all its faults at once, exit status 2, nothing written."""

import numpy as np
import pytest

from sweep.cli import main
from sweep.errors import PipelineError
from sweep.experiment.pipeline import Pipeline

# What is wrong, the file, and what its message must hold: file, key, value, what was expected.
P = "[pose]\ndistance_m = 1\n"

BROKEN = [
    (P + "[camra]\nwidth_px = 640", "camra: unknown; expected a section of title, seed,"),
    ('[pose]\ndistance_m = "near"', 'pose.distance_m = "near": expected a number above 0'),
    (P + "[camera]\nwidth_px = 640.5",
     "camera.width_px = 640.5: expected a whole number from 1 to 100000"),
    (P + "tilt_deg = 500", "pose.tilt_deg = 500: expected a number from -360 to 360"),
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
    (P + '[scene]\nrenderer = "supersample-0"',
     'scene.renderer = "supersample-0": expected exact, warp, supersample-N'),
    (P + "[detector]\nadaptiveThreshWinSizeMin = 31",
     "adaptiveThreshWinSizeMax = 23: expected at least adaptiveThreshWinSizeMin"),
    (P + "tilt_deg = 3\n[axes]\ntilt_deg = [0, 1]",
     "axes.tilt_deg = [0, 1]: expected it once: pose.tilt_deg is given too"),
    (P + "[axes]\ntilt_deg = []", "axes.tilt_deg = []: expected at least one value"),
    (P + "[axes]\ntilt_deg = [0, 1, 0.0]", "expected each value once (0.0 is repeated)"),
    (P + "[axes]\ntilt_deg = { linspce = [0, 1, 3] }",
     "a table with one of range, arange, linspace, geom, values; did you mean linspace?"),
    ("[axes]\ndistance_m = { geom = [0, 1, 3] }",
     "expected geom = [first, last, count], both inclusive, above 0"),
    (P + "[axes]\ntrial = 5",
     "axes.trial = 5: expected something random to repeat: jitter_px above 0"),
    (P + "[marker]\nsize_m = { uniform = [1, 2] }",
     "expected a fixed value; only these can be drawn: distance_m"),
    ("[pose]\ndistance_m = { uniform = [2, 1] }", "expected uniform = [a, b] with a < b"),
    (P + "tilt_deg = { uniform = [0, 400] }",
     "pose.tilt_deg = {uniform = [0, 400]}: expected a number from -360 to 360"),
    (P + "[axes]\ntilt_deg = { normal = [0, 4] }",
     "expected an axis; a distribution goes under [pose]"),
    (P + '[scene]\nwindow = "full"\n[camera]\nwidth_px = 100000\nheight_px = 100000',
     "expected what needs no whole frame, for one of more than 500,000,000 pixels"),
    ("pose = 3\n[axes]\ndistance_m = [1]\nfy_px = [1]\ntrial = 4",
     "pose = 3: expected a table: [pose]"),
    (P + '[require]\nall = ["detection"]', 'require.all = "detection": expected NAME >= NUMBER'),
    (P + '[require]\nall = ["detektion >= 0.5"]',
     "detektion: nothing of this name has an interval; did you mean detection_rate?"),
    ('[pose]\ndistance = 1\n[require]\nall = ["range_error_p95_m <= 0.1"]',
     'require.all = "range_error_p95_m <= 0.1": its unit is %: write range_p95_percent'),
    (P + '[require]\nall = ["detection >= 0.9", "detection <= 0.5"]',
     'require.all = "detection_rate >= 0.9": contradicts detection_rate <= 0.5'),
    (P + '[require]\nall = ["detection >= 0.9"]\nper = ["dist_m"]',
     "require.per: dist_m: no such axis; did you mean distance_m?"),
    (P + '[require]\nall = ["detection >= 0.9"]\nper = ["solver"]',
     "require.per: solver: configurations are always told apart"),
    (P + '[require]\nper = ["distance_m"]', "what is required, too"),
    ("seed = -1\n[pose]\ndistance_m = 1", "seed = -1: expected a whole number from 0"),
    ("[pose\ndistance_m = 1", "not TOML: "),
    (P + '[scene]\nbackground = "none.png"',
     'scene.background = "none.png": expected a level or an image file (No such file'),
]


@pytest.mark.parametrize(("text", "message"), BROKEN, ids=[message for _, message in BROKEN])
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
