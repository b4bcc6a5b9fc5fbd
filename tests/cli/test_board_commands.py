"""Every command and every analysis on a store of boards: an answer, or one line that says why not.

The targets are one marker, a ChArUco and a grid of the same area, on one axis; of the other stores
one shows boards at angles, one their backs, and one nothing that could be detected.
"""

import numpy as np
import pytest
import xarray as xr

import sweep
from sweep import analysis
from sweep.cli import main
from sweep.errors import SweepError
from sweep.measure.flags import DetectionStatus

pytestmark = pytest.mark.long

COMMON = {
    "seed": 22,
    "camera": {"width_px": 320, "height_px": 240, "fx_px": 300},
    "estimator": {"solver": "iterative"},
    "pose": {"jitter_px": 5, "tilt_deg": {"uniform": [0, 50]},
             "azimuth_deg": {"uniform": [0, 360]}},
    "scene": {"noise_grey": 2, "black": 40, "white": 200, "background": 120},
}
GRID = {"kind": "grid", "rows": 2, "columns": 2, "gap_m": 0.006}
SIDE = {"dictionary": "DICT_5X5_100", "quiet_zone_modules": 1}
AXES = {"distance_m": [0.25, 0.5], "solver": ["iterative", "sqpnp"], "trial": 6}
BOARDS = {
    "mixed": {
        "marker": SIDE,
        "board": {key: value for key, value in GRID.items() if key != "kind"}
        | {"squares_x": 3, "squares_y": 3, "square_m": 0.032},
        "axes": {"target": {"zip": {"kind": ["none", "charuco", "grid"],
                                    "size_m": [0.08, 0.024, 0.04]}}, **AXES},
    },
    "folded": {
        "marker": SIDE | {"size_m": 0.04},
        "board": {"kind": "markers", "markers": [
            {"marker_id": k, "x_m": x, "y_m": 0, "tilt_deg": tilt, "azimuth_deg": 90}
            for k, (x, tilt) in enumerate([(-0.022, -30), (0.022, 30)])]},
        "axes": AXES,
    },
    "unseen": {"marker": SIDE | {"size_m": 0.04}, "board": GRID, "axes": AXES,
               "scene": {"noise_grey": 200}},
    "backs": {"marker": SIDE | {"size_m": 0.04}, "board": GRID, "axes": AXES,
              "pose": {"tilt_deg": 180}},
    "renderers": {"marker": SIDE | {"size_m": 0.04}, "board": GRID,
                  "axes": AXES | {"renderer": ["exact", "supersample-2"]}},
}


@pytest.fixture(scope="module")
def stores(tmp_path_factory):
    """Return the path of the store of each of `BOARDS`."""
    folder = tmp_path_factory.mktemp("boards")
    for name, own in BOARDS.items():
        document = COMMON | own
        document = {key: COMMON.get(key, {}) | value if isinstance(value, dict) else value
                    for key, value in document.items()}
        if "solver" in document["axes"]:
            document.pop("estimator")
        sweep.run(document, store=folder / f"{name}.zarr", workers=1)
    return folder


REFUSED = {
    "calibration": "expected at least", "compare": "not the same scenes",
    "error-model": "needs 200 or more",
}
"""Command -> what stands in the line in which it refuses these stores."""

ANSWERED = {("error-model", "backs"), ("compare", "mixed")}
"""Commands of `REFUSED` that have an answer of a store: of one without poses, and of itself."""

COMMANDS = {
    "status": [], "plan": [], "verify": ["--sample", "2"], "error-model": [], "calibration": [],
    "tradeoff": ["--seconds", "3"], "require": ["detection >= 0.5", "--per", ""],
    "report": ["-o", "report.html"], "export": ["images-{name}"], "compare": ["mixed.zarr"],
    "show": ["--at", "distance_m=0.25,trial=0", "-o", "scene.png"],
    "repro": ["--at", "distance_m=0.25,trial=0"],
}


@pytest.mark.parametrize("name", BOARDS)
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_answers_of_boards_or_refuses_in_a_line(
    command, name, stores, monkeypatch, capfd
):
    monkeypatch.chdir(stores)
    arguments = [each.format(name=name) for each in COMMANDS[command]]
    status = main([command, f"{name}.zarr", *arguments])
    output = capfd.readouterr()
    assert "Traceback" not in output.err
    if command in REFUSED and (command, name) not in ANSWERED:
        assert status == 2
        assert REFUSED[command] in output.err
        assert len(output.err.strip().splitlines()) == 1
    else:
        expected = {0, 1, 3} if command == "require" else {0, 2} if name == "backs" else {0}
        assert status in expected, output.err


ANALYSES = {
    "ambiguity": lambda each: analysis.ambiguity(each, ["distance_m"]),
    "check_requirements": lambda each: analysis.check_requirements(each, ["detection >= 0.5"]),
    "compare": lambda each: analysis.compare(each, each),
    "covariance_trust": analysis.covariance_trust,
    "detection_limit": analysis.detection_limit,
    "detection_rate": analysis.detection_rate,
    "efficiency": analysis.efficiency,
    "error_models": analysis.error_models,
    "error_statistics": analysis.error_statistics,
    "failure_composition": analysis.failure_composition,
    "farthest_met": lambda each: analysis.farthest_met(each, ["detection >= 0.5"],
                                                       along="distance_m"),
    "flip_rate": analysis.flip_rate,
    "marker_ranking": analysis.marker_ranking,
    "precision_reached": lambda each: analysis.precision_reached(each, {"detection_rate": 0.1}),
    "renderer_bias": analysis.renderer_bias,
    "requirement_limits": lambda each: analysis.requirement_limits(
        each, ["detection >= 0.5"], along="distance_m"),
    "store_differences": lambda each: analysis.store_differences(each, each),
    "decode_flags": sweep.decode_flags,
}


@pytest.mark.parametrize("markers", [False, True], ids=["boards", "markers"])
@pytest.mark.parametrize("analysed", ANALYSES)
def test_an_analysis_answers_of_boards_or_refuses_in_a_line(analysed, markers, stores):
    for name in BOARDS:
        results = sweep.open(stores / f"{name}.zarr")
        results = analysis.per_marker(results) if markers else results
        refusal = ""
        try:
            assert isinstance(ANALYSES[analysed](results).compute(), xr.Dataset)
        except SweepError as error:
            refusal = str(error)
        assert "\n" not in refusal


def test_denominators_of_a_board_are_poses_and_of_its_markers_are_markers(stores):
    results = sweep.open(stores / "mixed.zarr").load()
    table = analysis.detection_rate(results, ["target"])
    assert table["looked_for"].values.tolist() == [12, 12, 12]
    flags = results["marker_detection"]
    each = analysis.detection_rate(analysis.per_marker(results), ["target"])
    assert each["looked_for"].values.tolist() == [12, 48, 48]
    found = (flags == DetectionStatus.detected).sum(["distance_m", "trial", "marker"])
    np.testing.assert_array_equal(each["detected"], found)
    any_found = (flags == DetectionStatus.detected).any("marker").sum(["distance_m", "trial"])
    np.testing.assert_array_equal(table["detected"], any_found)


def test_reports_name_boards_and_count_their_markers(stores, monkeypatch):
    monkeypatch.chdir(stores)
    assert main(["report", "mixed.zarr", "-o", "mixed.md"]) == 0
    text = (stores / "mixed.md").read_text()
    assert "A board counts as detected if at least one of its markers is." in text
    for target in ("none, 0.08", "charuco, 0.024", "grid, 0.04"):
        assert f"| {target} · sqpnp |" in text, "targets are compared, never pooled"
    assert "of 4 visible markers" in text
    assert "the marker is detected" not in text


def test_the_farthest_of_several_boards_is_a_choice_among_them(tmp_path):
    document = COMMON | BOARDS["mixed"]
    choice = sweep.size(
        {key: value for key, value in document.items() if key != "estimator"} | {
            "axes": {key: value for key, value in document["axes"].items() if key != "trial"},
            "require": {"all": ["detection >= 0.5"]},
            "search": {"largest": "distance_m", "among": ["target"], "max_trials": 100},
        }, store=tmp_path / "farthest.zarr", workers=1, limit_s=3)
    assert choice.best is not None
