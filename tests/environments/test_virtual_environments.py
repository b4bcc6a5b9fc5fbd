"""Environments by name: made whole or not at all, found by pipelines, listed, removed."""

import json
from pathlib import Path

import pytest

from support.stub_opencv import STUB, stub_python
from sweep.cli import main
from sweep.environments import virtual_environments
from sweep.environments.interpreters import find_python, names
from sweep.errors import EnvironmentFaultError

OPENCV = "opencv-contrib-python-headless==4.5.0"


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "fiducial-sweep" / "environments"


@pytest.fixture
def pip(monkeypatch):
    """Make environments of the stub, without venv and pip; a list of what was to be installed."""
    installed = []

    def run(command, what):
        if what == "venv":
            (Path(command[-1]) / "bin").mkdir()
            return
        requirements = command[command.index("--retries=2") + 1 :]
        installed.append(requirements)
        if "nonsense" in requirements:
            raise EnvironmentFaultError(f"{what}: No matching distribution found for nonsense")
        old = "numpy<2" in requirements or "modern" in requirements
        stub_python(Path(command[0]).parent, STUB if old else "raise ImportError('numpy 1')")

    monkeypatch.setattr(virtual_environments, "_run", run)
    return installed


def test_an_environment_is_made_found_listed_and_removed(cache, pip, capsys):
    assert main(["environments", "list"]) == 0
    assert "next: sweep environments add" in capsys.readouterr().out
    assert main(["environments", "add", "opencv-4.5", OPENCV, "modern"]) == 0
    told = capsys.readouterr().out
    assert "OpenCV 4.5.0" in told
    assert "next: sweep run PIPELINE" in told
    assert (cache / ".gitignore").read_text() == "*\n"
    assert find_python("opencv-4.5", ".") == str(cache / "opencv-4.5" / "bin" / "python")
    assert main(["environments", "list", "--json"]) == 0
    (listed,) = json.loads(capsys.readouterr().out)["environments"]
    assert (listed["name"], listed["opencv"]) == ("opencv-4.5", "4.5.0")
    assert main(["environments", "add", "opencv-4.5", OPENCV]) == 2
    assert "there is one already" in capsys.readouterr().err
    assert main(["environments", "remove", "opencv-4.5"]) == 0
    assert names() == []
    assert len(pip) == 1


def test_numpy_before_2_is_installed_where_opencv_needs_it(cache, pip):
    made = virtual_environments.add("old", [OPENCV])
    assert made.opencv == "4.5.0"
    assert pip == [[OPENCV], [OPENCV, "numpy<2"]]
    assert cache.exists()


def test_what_cannot_be_installed_leaves_nothing(cache, pip, capsys):
    assert main(["environments", "add", "opencv-9", "nonsense"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "No matching distribution" in line
    assert [path.name for path in cache.iterdir()] == [".gitignore"]
    assert pip == [["nonsense"]]


@pytest.mark.parametrize(("words", "expected"), [
    (["add", "installed", "x"], "expected letters, digits"),
    (["add", "../x", "x"], "expected letters, digits"),
    (["add", "x"], "expected what to install"),
    (["add"], "expected the name of what to add"),
    (["remove", "x"], "no such environment"),
    (["remove", "x", "y"], "one environment is removed at a time"),
    (["list", "x"], "list takes no name"),
])
def test_mistakes_are_told_in_a_line(cache, capsys, words, expected):
    assert main(["environments", *words]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert expected in line
    assert not cache.exists()


@pytest.mark.long
def test_a_real_environment_gives_what_pip_says(cache, capsys):
    assert main(["environments", "add", "none", "no-such-package-of-sweep==1"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "pip install no-such-package-of-sweep==1" in line
    assert names() == []
    assert cache.exists()
