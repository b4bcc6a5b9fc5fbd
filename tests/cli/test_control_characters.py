"""Names and texts of a store steer no terminal, whichever command prints them."""

import shutil

import pytest

from support.stores import by_hand
from sweep.cli import main
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline

CLEAR = "\x1b[2J\x07\x9b"

TEXT = """
[camera]
width_px = 64
height_px = 48
sensor_width_mm = 4.8
sensor_height_mm = 3.6
focal_length_mm = 4.0
[pose]
side_px = 24
jitter_px = 0.5
[axes]
tilt_deg = [0, 30]
trial = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a pipeline and its store, of names that clear a terminal."""
    folder = tmp_path_factory.mktemp("names")
    path = folder / f"name{CLEAR}.toml"
    path.write_text(TEXT)
    pipeline = Pipeline.from_toml(path)
    close(by_hand(str(folder / f"store{CLEAR}.zarr"), pipeline, (1, 2)))
    return folder


LONG = {"plan", "repro", "report", "show", "tradeoff"}


@pytest.mark.long
@pytest.mark.parametrize("command", [
    pytest.param(name, marks=pytest.mark.long if name in LONG else ())
    for name in ("status", "verify", "run", "damaged", "none", *sorted(LONG))
])
def test_no_command_prints_control_characters_of_names(command, folder, tmp_path, capsys):
    file, store = folder / f"name{CLEAR}.toml", folder / f"store{CLEAR}.zarr"
    output = tmp_path / f"output{CLEAR}"
    if command == "damaged":
        store = shutil.copytree(store, tmp_path / store.name)
        (store / f"left{CLEAR}").write_text("mine")
        (store / "true_rvec/c/0/0/0").unlink()
    arguments = {
        "status": ["status", store], "verify": ["verify", store, "--sample", "1"],
        "run": ["run", file, "--store", store], "none": ["status", output],
        "damaged": ["verify", store, "--sample", "0"],
        "plan": ["plan", file], "show": ["show", file, "-o", f"{output}.png"],
        "repro": ["repro", store, "-o", f"{output}.png"],
        "report": ["report", store, "-o", f"{output}.html"],
        "tradeoff": ["tradeoff", store, "--seconds", "0.2", "-o", f"{output}.png"],
    }[command]
    code = main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    assert code == {"none": 2, "damaged": 1}.get(command, 0), said.err
    lines = (said.out + said.err).splitlines()
    assert lines
    assert all(line.isprintable() for line in lines), lines
