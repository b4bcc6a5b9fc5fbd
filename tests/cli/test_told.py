"""What commands tell of a bound that no pose has."""

import pytest

from support.stores import by_hand
from sweep import Pipeline, cli
from sweep.evaluation.block import bound_notes
from sweep.execution.status import close
from sweep.report.report_data import read_report_data

TEXT = """
[scene]
noise_grey = 2
bound = "known_blur"
[pose]
jitter_px = 0.5
[axes]
side_px = [8, 40]
tilt_deg = [0, 89.9]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe", "sqpnp", "iterative"]
trial = 2
"""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("told") / "two.zarr")
    close(by_hand(url, Pipeline.from_text(TEXT, name="two")))
    return url


def test_a_bound_that_no_pose_has_is_a_line_of_every_command_and_of_the_report(store, capsys):
    wanted = "no pose has a bound: clipped"
    for command in ("run", "status", "plan"):
        assert cli.main([command, store]) == 0
        assert wanted in capsys.readouterr().out
    assert any(wanted in line for line in read_report_data(store).warnings)


@pytest.mark.parametrize(("settings", "reasons"), [
    (["black=[0, 30]", "white=220", "background=200"], []), (["bound=none"], []),
    (["black=30", "white={ uniform = [254, 255] }"], ["clipped"]),
    (["noise_grey=[0.1, 4]"], ["no_noise", "clipped"]),
    (["gain=2", "black=30", "white=220"], ["clipped"]), (["vignetting=0.3"], ["not_in_model"]),
    (["bound=['none', 'known_blur']"], ["clipped"]),
])
def test_why_no_pose_has_a_bound_is_told(settings, reasons):
    line = "".join(bound_notes(Pipeline.from_text(TEXT, settings)))
    assert [name for name in ("no_noise", "clipped", "not_in_model") if f"{name}: " in line] == (
        reasons)
