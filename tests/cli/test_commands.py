"""The command line: help, version, flags in messages, JSON, and installations that cannot work."""

import argparse
import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from support.reports import command
from sweep import cli, installation
from sweep.cli.command import print_error
from sweep.cli.parser import COMMANDS, build_parser
from sweep.cli.reference import TABLES
from sweep.errors import ArgumentError, PipelineError, RunError, StoreError
from sweep.experiment.parameters import PARAMETERS, SECTIONS
from sweep.experiment.schema import VARIABLES
from sweep.measure.flags import DetectionStatus
from sweep.report.table import to_json

TOP = Path(__file__).parents[2]
HEAVY = ("numpy", "dask", "xarray", "numba", "cv2", "zarr", "matplotlib", "jinja2", "rich.console")


def python(code):
    return subprocess.run(
        [sys.executable, "-c", code], cwd=TOP, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("named", COMMANDS, ids=lambda named: named.name)
def test_each_help_has_two_examples_that_are_commands_and_a_text_for_each_argument(named):
    code, out, _ = command(named.name, "--help")
    assert code == 0
    examples = out.split("examples:\n")[1]
    assert re.findall(r"^  (sweep .*)$", examples, re.MULTILINE) == [*named.examples]
    assert len(named.examples) == 2
    assert out.endswith(f"\nguide: {named.guide}\n")
    for example in named.examples:
        _, *arguments = shlex.split(example)
        assert build_parser()[0].parse_args(arguments).command is named
        assert all((TOP / value).is_file() for value in arguments
                   if value.startswith("pipelines/"))
    parser = argparse.ArgumentParser()
    named.add_arguments(parser)
    assert all(action.help for action in parser._actions)


@pytest.mark.system
def test_help_and_version_import_nothing_heavy():
    done = python(
        f"import sys\nfrom sweep.cli import main\n"
        f"for words in ([], ['--help'], ['--version'], ['run', '--help']):\n"
        f"    try:\n        main(words)\n    except SystemExit:\n        pass\n"
        f"print('imported:', *(name for name in {HEAVY!r} if name in sys.modules))"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("imported:\n")


@pytest.mark.parametrize(
    ("error", "status"),
    [(ArgumentError("workers", 0, "expected at least 1"), 2), (PipelineError(["a", "b"]), 2),
     (StoreError("s\x1b[2J"), 2), (RunError("r"), 1)],
)
def test_exit_status_says_whether_a_command_was_refused(error, status, capsys):
    assert print_error(error) == status
    err = capsys.readouterr().err
    assert err.count("\n") == len(getattr(error, "faults", ["one"]))
    assert "\x1b" not in err  # it would reach the terminal


@pytest.mark.parametrize("distributions", [
    {"opencv_contrib_python_headless": "5.0.0", "opencv_python_headless": "4.11.0"},
    {},
])
def test_another_distribution_of_opencv_is_warned_of_once(distributions, monkeypatch):
    monkeypatch.setattr(installation, "distributions", lambda name: [
        SimpleNamespace(version=version) for known, version in distributions.items()
        if known == name.replace("-", "_")])
    installation.check_installation.cache_clear()
    warning, _ = command("status", "none.zarr")[2].splitlines()
    assert warning.startswith("warning: ")
    assert f"OpenCV {cv2.__version__} is loaded" in warning
    for name, version in distributions.items():
        assert name.replace("_", "-") in warning
        assert version in warning
    assert "warning" not in command("status", "none.zarr")[2]


@pytest.mark.parametrize(("loaded", "words"), [
    (None, ["OpenCV cannot be used: ",
            "`pip install --force-reinstall opencv-contrib-python-headless`"]),
    (SimpleNamespace(__version__="4.6.0", aruco=SimpleNamespace()),
     ["OpenCV cannot be used: ", "has no attribute 'ArucoDetector'"]),
], ids=["no OpenCV", "old OpenCV"])
def test_an_installation_that_cannot_work_is_refused_in_one_line(loaded, words, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", loaded)
    installation.check_installation.cache_clear()
    code, out, err = command("status", "none.zarr")
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert all(each in err for each in words)


@pytest.mark.system
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_script_is_one_of_its_shell_and_has_every_command_and_option(shell, capsys, tmp_path):
    pytest.importorskip("shtab")
    assert cli.main(["completion", shell]) == 0
    text = capsys.readouterr().out
    for parser in build_parser()[1]:
        assert parser.prog.removeprefix("sweep ") in text
        for option in parser._option_string_actions:
            assert option.lstrip("-") in text
    if shutil.which(shell) is not None:
        (tmp_path / "script").write_text(text)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)


def strict(text):
    """Return parsed JSON; a constant that the standard lacks is an error."""
    def refuse(name):
        raise AssertionError(name)

    return json.loads(text, parse_constant=refuse)


def test_each_kind_of_value_has_one_form():
    found = strict(to_json({
        "array": np.array([[1.0, np.inf], [np.nan, 2.0]]), "path": Path("a"), "many": (1, True),
        "flag": DetectionStatus.detected, "number": np.float32(0.5), "low": -math.inf,
    }))
    assert found == {
        "array": [[1.0, None], [None, 2.0]], "array_flag": [[None, "infinite"], None],
        "path": "a", "many": [1, True], "flag": "detected", "number": 0.5,
        "low": None, "low_flag": "-infinite",
    }


def test_every_parameter_and_variable_stands_in_the_table_of_its_subject():
    for section in SECTIONS:
        names = [row[0] for row in TABLES[section]().rows]
        assert names == [p.name for p in PARAMETERS.values() if p.section == section]
    assert [row[0] for row in TABLES["variables"]().rows] == [*VARIABLES]
    assert all(all(row[-1:]) for name in TABLES for row in TABLES[name]().rows
               if name != "variables")
