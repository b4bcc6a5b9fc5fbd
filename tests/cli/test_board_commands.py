"""Every command and every analysis on a store of boards: an answer, or one line that says why not.

The targets are one marker, a ChArUco and a grid of the same area, on one axis; the other store
shows the back of a board.
"""

import pytest
import xarray as xr

import sweep
from sweep import analysis
from sweep.cli import main
from sweep.errors import SweepError

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
AXES = {"distance_m": [0.25, 0.5], "solver": ["iterative", "sqpnp"], "trial": 5}
BOARDS = {
    "mixed": {
        "marker": SIDE,
        "board": {key: value for key, value in GRID.items() if key != "kind"}
        | {"squares_x": 3, "squares_y": 3, "square_m": 0.032},
        "axes": {"target": {"zip": {"kind": ["none", "charuco", "grid"],
                                    "size_m": [0.08, 0.024, 0.04]}}, **AXES},
    },
    "backs": {"marker": SIDE | {"size_m": 0.04}, "board": GRID, "axes": AXES,
              "pose": {"tilt_deg": 180}},
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
    "tradeoff": ["--seconds", "0.1"], "require": ["detection >= 0.5", "--per", ""],
    "report": ["-o", "report.html"], "export": ["images-{name}"], "compare": ["mixed.zarr"],
    "show": ["--at", "distance_m=0.25,trial=0", "-o", "scene.png"],
    "repro": ["--at", "distance_m=0.25,trial=0"],
}


@pytest.mark.parametrize(("command", "name"), [
    (command, name) for command in COMMANDS for name in BOARDS
    if name == "mixed" or command not in {"report", "tradeoff"}])
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
