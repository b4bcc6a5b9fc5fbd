"""The command line: help, version, flags in messages, and installations that cannot work."""

import argparse
import ast
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

from sweep import cli, installation
from sweep.cli.command import SESSION, findings, print_error
from sweep.cli.command import answer as printed
from sweep.cli.parser import COMMANDS, build_parser
from sweep.errors import ArgumentError, PipelineError, RunError, StoreError
from sweep.execution.progress import Progress

TOP = Path(__file__).parents[2]
HEAVY = ("numpy", "dask", "xarray", "numba", "cv2", "zarr", "matplotlib", "jinja2", "rich")


def python(code):
    return subprocess.run(
        [sys.executable, "-c", code], cwd=TOP, capture_output=True, text=True, check=False)


def told(capsys, *arguments):
    """Run a command in this process; return its exit status, output and error output."""
    try:
        code = cli.main(list(arguments))
    except SystemExit as stopped:
        code = stopped.code
    return code, *capsys.readouterr()


# Ctrl-C.

@pytest.mark.parametrize(("flags", "begun", "line"), [
    ([], False, "stopped; the same command continues"),
    (["--overwrite"], False, "stopped before anything was computed"),
    (["--overwrite"], True, "stopped; the same command without --overwrite continues"),
])
def test_stopped_run_says_what_is_left_of_it(flags, begun, line, tmp_path, monkeypatch, capsys):
    def execute(*_, progress, **__):
        if begun:
            progress(Progress(0, 1, 0))
        raise KeyboardInterrupt

    monkeypatch.setattr("sweep.execution.runner.execute", execute)
    pipeline = tmp_path / "one.toml"
    pipeline.write_text("pose = { side_px = 40 }\n")
    code, out, err = told(capsys, "run", str(pipeline), *flags)
    assert (code, out) == (130, "")
    assert err.splitlines()[-1] == line


def test_stopped_command_that_does_not_continue_does_not_say_so(monkeypatch, capsys):
    def stopped(_):
        raise KeyboardInterrupt

    monkeypatch.setattr("sweep.execution.status.status", stopped)
    assert told(capsys, "status", "any.zarr") == (130, "", "stopped\n")


# Help and version.


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_each_help_ends_with_two_examples_and_the_guide(command, capsys):
    code, out, _ = told(capsys, command.name, "--help")
    assert code == 0
    examples = out.split("examples:\n")[1]
    assert re.findall(r"^  (sweep .*)$", examples, re.MULTILINE) == [
        *command.examples]
    assert len(command.examples) == 2
    assert out.endswith(f"\nguide: {command.guide}\n")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_example_is_a_command_that_the_parser_takes(command):
    for example in command.examples:
        program, *arguments = shlex.split(example)
        assert program == "sweep"
        options = build_parser()[0].parse_args(arguments)
        assert options.command is command
        for value in arguments:
            if value.startswith("pipelines/"):
                assert (TOP / value).is_file()


def test_every_argument_has_a_help_text():
    for command in COMMANDS:
        parser = argparse.ArgumentParser()
        command.add_arguments(parser)
        for action in parser._actions:
            assert action.help, (command.name, action.dest)


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


def test_the_example_is_the_pipeline_of_the_guides_and_is_packaged():
    example = TOP / "sweep" / "examples" / "smoke.toml"
    assert example.read_bytes() == (TOP / "pipelines" / "smoke.toml").read_bytes()
    project = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))
    assert "examples/*.toml" in project["tool"]["setuptools"]["package-data"]["sweep"]


@pytest.mark.parametrize("arguments", [[], ["some.toml", "--example", "smoke"]])
def test_a_run_is_of_a_file_or_of_an_example(arguments, capsys):
    code, out, err = told(capsys, "run", *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "--example smoke" in err


# Messages.

@pytest.fixture
def parsed(monkeypatch):
    """Return a function that parses arguments as the session's command."""
    return lambda *arguments: monkeypatch.setattr(
        SESSION, "flags", build_parser()[0].parse_args(arguments).flags)


def test_an_argument_is_named_by_its_flag(capsys, parsed):
    flags = {
        ("run", "workers"): "--workers", ("run", "time_limit_s"): "--time-limit",
        ("run", "settings"): "--set", ("tradeoff", "limit_s"): "--seconds",
        ("report", "form"): "--format", ("report", "output"): "--output",
        ("report", "store"): "STORE", ("verify", "sample"): "--sample",
        ("fit", "folders"): "FOLDER", ("photos", "folders"): "FOLDER",
        ("verify", "some_other"): "--some-other",
    }
    for (name, argument), flag in flags.items():
        parsed(name, "x")
        for value, shown in ((0, " 0"), ("", "")):
            assert print_error(ArgumentError(argument, value, "expected a number")) == 2
            assert capsys.readouterr().err == f"{flag}{shown}: expected a number\n"


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


@pytest.mark.parametrize("form", ["text", "markdown", "json"])
def test_names_and_texts_of_a_store_steer_no_terminal(form, capsys, monkeypatch):
    monkeypatch.setattr(SESSION, "form", form)
    clear = "name\x1b[2J\x07\x9b"
    assert printed(findings([clear], {"name": clear}, 0, f"sweep report {clear}")) == 0
    said = capsys.readouterr().out
    assert "name" in said
    assert all(line.isprintable() for line in said.splitlines())


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["repro", "x", "--time-limit", "0"], "--time-limit 0.0: expected seconds above 0\n"),
        (["repro", "x", "--time-limit", "inf"], "--time-limit inf: expected seconds above 0\n"),
        (["tradeoff", "x", "--seconds", "nan"],
         "--seconds nan: expected a finite number above 0\n"),
        (["tradeoff", "x", "--criterion", "speed"],
         "--criterion speed: expected one of rotation_rmse_deg, "),
    ],
)
def test_a_value_that_cannot_be_is_refused_before_any_work(arguments, line, capsys):
    code, out, err = told(capsys, *arguments)
    assert (code, out) == (2, "")
    assert err.startswith(line)
    assert len(err.splitlines()) == 1


# Installations.

class Installed:
    """A distribution as `importlib.metadata` describes it."""

    def __init__(self, version, commands=()):
        self.version = version
        self.entry_points = [type("Entry", (), {"value": value}) for value in commands]


def installed(monkeypatch, **distributions):
    def distribution(name):
        if name.replace("-", "_") not in distributions:
            raise PackageNotFoundError(name)
        return distributions[name.replace("-", "_")]

    monkeypatch.setattr(installation, "distribution", distribution)


def refused(capsys):
    code, out, err = told(capsys, "status", "none.zarr")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    return err


@pytest.mark.parametrize("distributions", [
    {"opencv_python": "4.14.0"},
    {"opencv_contrib_python_headless": "5.0.0", "opencv_python_headless": "4.11.0"},
    {"opencv_contrib_python_headless": "5.0.0", "opencv_contrib_python": "5.0.0",
     "opencv_python": "5.0.0"},
    {},
])
def test_another_distribution_of_opencv_is_warned_of_once(distributions, capsys, monkeypatch):
    installed(monkeypatch, **{name: Installed(each) for name, each in distributions.items()})
    installation._warn_of_other_opencv.cache_clear()
    _, _, err = told(capsys, "status", "none.zarr")
    warning, _ = err.splitlines()
    assert warning.startswith("warning: ")
    assert f"OpenCV {cv2.__version__} is loaded" in warning
    for name, version in distributions.items():
        assert name.replace("_", "-") in warning
        assert version in warning
    assert "warning" not in refused(capsys)


@pytest.mark.parametrize(("loaded", "named"), [
    (None, "OpenCV cannot be imported: "),
    (SimpleNamespace(__version__="4.14.0"), "OpenCV 4.14.0 is loaded, which has no cv2.aruco"),
    (SimpleNamespace(__version__="4.6.0", aruco=SimpleNamespace()),
     "OpenCV 4.6.0 is loaded, which has no cv2.aruco.ArucoDetector"),
    (SimpleNamespace(), "which has no cv2.aruco"),
])
def test_an_opencv_without_aruco_is_refused_in_one_line(loaded, named, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", loaded)
    line = refused(capsys)
    assert line.startswith(named) or named in line
    assert "`pip install --force-reinstall opencv-contrib-python-headless`" in line


@pytest.mark.system
def test_an_opencv_without_aruco_is_refused_in_one_line_by_the_library():
    done = python(
        "import sys, types\nsys.modules['cv2'] = types.SimpleNamespace(__version__='4.14.0')\n"
        "import sweep\ntry:\n    sweep.Pipeline\n"
        "except sweep.StoreError as error:\n    print(error)"
    )
    assert "OpenCV 4.14.0 is loaded, which has no cv2.aruco.ArucoDetector" in done.stdout


def test_the_other_project_s_package_is_refused_and_an_older_one_of_ours_is_not(
    capsys, monkeypatch
):
    installed(monkeypatch, sweep=Installed("0.1.0", ["sweep.main:run"]))
    assert refused(capsys) == (
        "another project's package `sweep` (0.1.0) is installed, and its files overwrite those of "
        "fiducial-sweep: `pip uninstall sweep`, then "
        "`pip install --force-reinstall fiducial-sweep`\n"
    )
    installed(monkeypatch, sweep=Installed("0.5.0", ["sweep.cli:main"]))
    assert "another project" not in refused(capsys)


@pytest.mark.system
def test_python_3_10_is_refused_in_one_line():
    source = (TOP / "sweep" / "__init__.py").read_text(encoding="utf-8")
    ast.parse(source, feature_version=(3, 10))
    problem = "sweep needs Python 3.11 or newer; this is Python 3.10"
    old = "import sys; sys.version_info = (3, 10, 4); "
    done = python(f"{old}import sweep")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"ImportError: {problem}"
    done = python(f"{old}sys.argv[0] = '/usr/bin/sweep'; import sweep")
    assert (done.returncode, done.stderr) == (1, f"{problem}\n")
