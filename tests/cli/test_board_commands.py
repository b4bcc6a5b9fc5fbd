"""Every command on a store of boards: an answer, or one line that says why not.

The targets are one marker, a ChArUco and a grid of the same area, on one axis.
"""

import pytest
from matplotlib.figure import Figure

import sweep
from sweep.cli import main

BOARDS = {
    "seed": 22,
    "camera": {"width_px": 320, "height_px": 240, "fx_px": 300},
    "marker": {"dictionary": "DICT_5X5_100", "quiet_zone_modules": 1},
    "pose": {"jitter_px": 5, "distance_m": 0.25, "tilt_deg": {"uniform": [0, 50]},
             "azimuth_deg": {"uniform": [0, 360]}},
    "board": {"rows": 2, "columns": 2, "gap_m": 0.006,
              "squares_x": 3, "squares_y": 3, "square_m": 0.032},
    "scene": {"noise_grey": 2, "black": 40, "white": 200, "background": 120},
    "axes": {
        "target": {"zip": {"kind": ["none", "charuco", "grid"], "size_m": [0.08, 0.024, 0.04]}},
        "solver": ["iterative", "sqpnp"], "trial": 5,
    },
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    url = tmp_path_factory.mktemp("boards") / "mixed.zarr"
    sweep.run(BOARDS, store=url, workers=1)
    return url


REFUSED = {"calibration": "expected at least", "error-model": "needs 200 or more"}
"""Command -> what stands in the line in which it refuses this store."""

COMMANDS = {
    "status": [], "plan": [], "verify": ["--sample", "2"], "error-model": [], "calibration": [],
    "tradeoff": ["--seconds", "0.02"], "require": ["detection >= 0.5", "--per", ""],
    "report": ["-o", "report.md"], "export": ["images"], "compare": ["mixed.zarr"],
    "show": ["--at", "trial=0", "-o", "scene.png"],
    "repro": ["--at", "trial=0"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_answers_of_boards_or_refuses_in_a_line(command, store, monkeypatch, capfd):
    monkeypatch.chdir(store.parent)
    if command == "report":
        monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)  # drawn, and not written
    status = main([command, "mixed.zarr", *COMMANDS[command]])
    error = capfd.readouterr().err
    assert "Traceback" not in error
    if command in REFUSED:
        assert status == 2
        assert REFUSED[command] in error
        assert len(error.strip().splitlines()) == 1
    else:
        assert status in ({0, 1, 3} if command == "require" else {0}), error
