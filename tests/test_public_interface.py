"""The package as a user's script has it: its types, its arguments, its import."""

import ast
import doctest
import inspect
import re
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

import sweep
from support.board_photographs import POSES, write_set
from support.here import calls_here
from sweep import library
from sweep.errors import ArgumentError, PipelineError, SweepError
from sweep.execution.progress import progress_report

TOP = Path(__file__).parent.parent

FEW = {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 3}}
TEXT = "pose = { side_px = 40, jitter_px = 0.5 }\naxes.trial = 3\n"


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished store; running its pipeline again computes nothing and starts no cluster."""
    store = tmp_path_factory.mktemp("finished") / "few.zarr"
    with calls_here():
        sweep.run(FEW, store=store)
    return store


def test_importing_the_package_imports_nothing_heavy():
    heavy = {"numpy", "numba", "cv2", "dask", "distributed", "xarray", "zarr", "tomlkit", "rich"}
    ran = subprocess.run(
        [sys.executable, "-c", "import sys, sweep; print(*sys.modules)"],
        capture_output=True, text=True, check=True,
    )
    modules = {name.partition(".")[0] for name in ran.stdout.split()}
    assert "sweep" in modules
    assert not modules & heavy


def test_every_public_name_exists_and_is_listed():
    for name in sweep.__all__:
        assert getattr(sweep, name) is not None
        assert name in dir(sweep)
    with pytest.raises(AttributeError, match="no attribute 'runs'"):
        sweep.runs  # noqa: B018


FUNCTIONS = {name: function for name in dir(sweep)
             if inspect.isfunction(function := getattr(sweep, name))}

FIRST = ("run", "photos", "twins")
"""Functions whose examples make the stores that examples of others read."""


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_says_what_it_takes_returns_and_raises(name):
    described = inspect.getdoc(FUNCTIONS[name])
    for heading in ("Parameters", "Returns", "Raises", "Examples"):
        assert f"\n{heading}\n{'-' * len(heading)}\n" in described
    parameters = described.partition("Parameters\n---")[2].partition("Returns\n---")[0]
    named = re.findall(r"^(\w+(?:, \w+)*)$", parameters, re.MULTILINE)
    taken = inspect.signature(FUNCTIONS[name]).parameters
    several = re.fullmatch(r"Unpack\[(\w+)\]", str(taken["options"].annotation)) if (
        "options" in taken) else None
    options = getattr(sweep, several[1]).__annotations__ if several else {}
    assert sorted(", ".join(named).split(", ")) == sorted({*taken, *options} - {"options"})


@pytest.mark.usefixtures("no_child")
def test_the_example_of_every_public_function_runs(tmp_path):
    """All in one folder: below half a minute."""
    write_set(tmp_path, POSES[:3])
    runner = doctest.DocTestRunner()
    finder = doctest.DocTestFinder(recurse=False)
    for name in (*FIRST, *(name for name in FUNCTIONS if name not in FIRST)):
        function = FUNCTIONS[name]
        inside = vars(sys.modules[function.__module__])
        (test,) = finder.find(function, globs=inside | {"sweep": sweep, "folder": tmp_path})
        assert test.examples
        assert runner.run(test).failed == 0, name


@pytest.mark.long
def test_pipeline_is_given_as_a_mapping_a_path_or_a_pipeline(finished, tmp_path):
    path = tmp_path / "pipeline.toml"
    path.write_text(TEXT)
    expected = sweep.open(finished)
    for given in (FEW, path, str(path), sweep.Pipeline.from_toml(path)):
        with sweep.run(given, store=finished) as results:
            assert results.identical(expected)
    with pytest.raises(PipelineError, match="side_pxx"):
        sweep.run({"pose": {"side_pxx": 40}}, store=finished)


@pytest.mark.usefixtures("no_child")
def test_progress_is_reported_to_a_function_or_in_lines(tmp_path, capsys):
    seen = []

    def report(progress):
        seen.append(progress)
        lines(progress)

    with progress_report(progress=True) as lines:
        sweep.run(FEW, store=tmp_path / "seen.zarr", progress=report)
    assert [progress.done for progress in seen] == [0, 3]
    assert {progress.total for progress in seen} == {3}
    assert capsys.readouterr().err == "0 of 3 poses\n3 of 3 poses\n"
    with progress_report(progress=False) as nothing:
        assert nothing is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"workers": 0}, "workers = 0: expected at least 1"),
        ({"time_limit_s": 0}, "time_limit_s = 0: expected seconds above 0"),
        ({"time_limit_s": float("nan")}, "time_limit_s = nan: expected seconds above 0"),
        ({"scheduler": "nowhere"}, "scheduler = nowhere: expected an address such as tcp://"),
        ({"client": "tcp://a:1"}, "client = tcp://a:1: expected a distributed.Client or a cluster"),
        ({"client": 3}, "client = 3: expected a distributed.Client or a cluster object"),
        ({"scheduler": "tcp://a:1", "client": 3}, "scheduler = tcp://a:1: expected no client"),
        ({"progress": "yes"}, "progress = yes: expected True, False, None or a function"),
    ],
)
def test_arguments_that_cannot_be_are_value_errors_that_name_them(options, message, tmp_path):
    with pytest.raises(ArgumentError) as raised:
        sweep.run(FEW, store=tmp_path / "none.zarr", **options)
    assert str(raised.value).startswith(message)
    assert isinstance(raised.value, ValueError)
    assert isinstance(raised.value, SweepError)
    assert not (tmp_path / "none.zarr").exists()


def test_what_is_no_pipeline_is_an_argument_error():
    with pytest.raises(ArgumentError, match="pipeline = 3: expected a Pipeline, the path of"):
        sweep.run(3)


RIGHT = """
from pathlib import Path

import sweep


def report(progress: sweep.Progress) -> None:
    print(progress.done, progress.total)


results = sweep.run(
    {"axes": {"trial": 3}}, store=Path("few.zarr"), workers=2, reuse=["old.zarr"], progress=report
)
reveal_type(results)
reveal_type(sweep.open("few.zarr"))
reveal_type(sweep.Pipeline.from_text("axes.trial = 3"))
reveal_type(sweep.__version__)
try:
    sweep.run("pipeline.toml", overwrite=True, progress=True, time_limit_s=60)
except sweep.ArgumentError as error:
    reveal_type(error.argument)
"""

WRONG = """
import sweep

sweep.run("pipeline.toml", "few.zarr")
sweep.run("pipeline.toml", worker=2)
sweep.run("pipeline.toml", workers="2")
sweep.run(3)
"""


@pytest.mark.long
def test_mypy_sees_the_types_of_the_installed_package_in_a_users_script(tmp_path):
    pytest.importorskip("mypy")
    # An environment of its own, in which the package lies as pip would install it.
    venv.create(tmp_path / "environment", with_pip=False)
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    site = tmp_path / "environment" / "lib" / version / "site-packages"
    shutil.copytree(
        TOP / "sweep", site / "sweep", ignore=shutil.ignore_patterns("__pycache__")
    )
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    for name, text in (("right.py", RIGHT), ("wrong.py", WRONG)):
        (tmp_path / name).write_text(text)
    ran = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--config-file", "", "--no-color-output",
         "--python-executable", str(tmp_path / "environment" / "bin" / "python"),
         "right.py", "wrong.py"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={"PATH": "", "MYPY_CACHE_DIR": str(TOP / ".mypy_cache" / "user")},
    )
    lines = ran.stdout.splitlines()
    revealed = [line.partition("Revealed type is ")[2] for line in lines if "Revealed" in line]
    assert revealed == [
        '"xarray.core.dataset.Dataset"', '"xarray.core.dataset.Dataset"',
        '"sweep.experiment.pipeline.Pipeline"', '"str"', '"str"',
    ], ran.stdout + ran.stderr
    errors = [line for line in lines if ": error:" in line]
    assert all(line.startswith("wrong.py:") for line in errors), ran.stdout
    assert [int(line.split(":")[1]) for line in errors] == [4, 5, 6, 7], ran.stdout


def test_every_module_that_mypy_sees_in_the_library_is_imported_on_use():
    tree = ast.parse(Path(library.__file__).read_text(encoding="utf-8"))
    seen = {
        alias.name: f"{node.module}.{alias.name}" for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.startswith("sweep")
        for alias in node.names
    }
    assert len(seen) > 40
    assert {name: getattr(library, name).__name__ for name in seen} == seen
