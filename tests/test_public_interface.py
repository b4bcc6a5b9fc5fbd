"""The package as users have it: its types, arguments, import; its workflow, page and citation."""

import ast
import doctest
import inspect
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import yaml

import sweep
from support.board_photographs import POSES, write_set
from support.here import calls_here
from sweep import library
from sweep.errors import ArgumentError, SweepError
from sweep.execution import runner
from sweep.execution.progress import DEFAULTS, progress_report

FEW = {"pose": {"side_px": 40, "jitter_px": 0.5}, "axes": {"trial": 3}}


@pytest.mark.system
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
    assert len(repr(sweep.Pipeline.from_dict(FEW)).splitlines()) == 3
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
    assert sorted(", ".join(named).split(", ")) == sorted(taken)


@pytest.mark.system
def test_the_example_of_every_public_function_runs(tmp_path):
    write_set(tmp_path, POSES[:3])
    runner = doctest.DocTestRunner()
    finder = doctest.DocTestFinder(recurse=False)
    for name in (*FIRST, *(name for name in FUNCTIONS if name not in FIRST)):
        function = FUNCTIONS[name]
        inside = vars(sys.modules[function.__module__])
        (test,) = finder.find(function, globs=inside | {"sweep": sweep, "folder": tmp_path})
        assert test.examples
        with calls_here():
            assert runner.run(test).failed == 0, name


def test_progress_is_reported_to_a_function_or_in_lines(tmp_path, capsys):
    seen = []

    def report(progress):
        seen.append(progress)
        lines(progress)

    with progress_report(progress=True) as lines:
        sweep.run(FEW, store=tmp_path / "seen.zarr", progress=report)
    assert [(progress.done, progress.total) for progress in seen] == [(0, 3), (3, 3)]
    told = r"(compiling, once .*\n)?0 of 3 poses\n3 of 3 poses\n"  # in a fresh environment
    assert re.fullmatch(told, capsys.readouterr().err)
    with progress_report(progress=False) as nothing:
        assert nothing is None


@pytest.mark.parametrize(("function", "given", "expected"), [
    (sweep.run, {"workers": 0}, "workers = 0: expected a whole number, 1 to 1,000"),
    (sweep.run, {"workers": 1.5}, "workers = 1.5: expected a whole number, 1 to 1,000"),
    (sweep.run, {"store": 3}, "store = 3: expected a path or URL"),
    (sweep.run, {"time_limit_s": float("nan")}, "time_limit_s = nan: expected seconds above 0"),
    (sweep.run, {"scheduler": "tcp://a:1", "client": 3}, "scheduler = tcp://a:1: expected no cl"),
    (sweep.run, {"progress": "yes"}, "progress = yes: expected True, False, None or a function"),
    (sweep.run, {0: 3}, "pipeline = 3: expected a Pipeline, the path of"),
    (sweep.run, {0: "x" * 5000}, "xxx"),
    (sweep.run, {"workers": "1\n2"}, r"workers = 1\n2: expected a whole number"),
    (sweep.open, {0: "a\0b"}, r"a\u0000b: cannot be read: embedded null byte"),
    (sweep.limit, {"require": 3}, "require = 3: expected texts"),
    (sweep.limit, {"require": np.array(3)}, "require = array(3): expected texts"),
    (sweep.limit, {"at_all": b"x"}, "at_all = b'x': expected texts"),
    (sweep.limit, {"settings": 3}, "settings = 3: expected texts"),
    (sweep.limit, {"max_trials": b"x"}, "max_trials = b'x': expected a whole"),
    (sweep.limit, {0: {"pose": {"side_px": 40}}, "along": "x_m", "require": "detection >= 0.5"},
     "pipeline: search.along: x_m: no such axis"),
    (sweep.fit, {"markers": "x"}, "markers = x: expected a whole number from 1 to 1000"),
    (sweep.fit, {"settings": None}, "settings = None: expected texts"),
    (sweep.measure_tradeoff, {"limit_s": None}, "limit_s: expected a finite number above 0"),
    (sweep.size, {"limit_s": None}, "limit_s: expected a finite number above 0"),
    (sweep.diagnose, {0: {"image": [1], "tape_m": [1]}, "dictionary": "4x4-50"}, "observations"),
    (sweep.reference, {0: []}, "names = []: expected camera"),
])
def test_arguments_that_cannot_be_are_told_by_name_in_a_line(
    function, given, expected, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SweepError) as raised:
        function(given.get(0, FEW), **{name: value for name, value in given.items() if name})
    (line,) = str(raised.value).splitlines()
    assert line.startswith(expected)
    assert isinstance(raised.value, ValueError) or isinstance(given.get(0), (str, dict))
    assert not [*tmp_path.glob("**/*.zarr")]


@pytest.mark.parametrize(
    "name", ["run", "photos", "twins", "compare", "limit", "size", "execute"])
def test_options_of_a_run_are_in_signatures_and_misspelled_ones_are_refused(name, tmp_path):
    function = getattr(sweep, name, runner.execute)
    shown = {each.name: each.default for each in inspect.signature(function).parameters.values()}
    assert shown | DEFAULTS == shown
    with pytest.raises(ArgumentError) as raised:
        function(tmp_path / "no.zarr", tmp_path / "no.zarr", worker=3)
    assert re.fullmatch(r"worker = 3: unknown; expected one of .*; did you mean workers\?",
                        str(raised.value))


def test_every_module_that_mypy_sees_in_the_library_is_imported_on_use():
    tree = ast.parse(Path(library.__file__).read_text(encoding="utf-8"))
    seen = {
        alias.name: f"{node.module}.{alias.name}" for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module.startswith("sweep")
        for alias in node.names
    }
    assert len(seen) > 25
    assert {name: getattr(library, name).__name__ for name in seen} == seen


TOP = Path(__file__).parent.parent
PROJECT = tomllib.loads((TOP / "pyproject.toml").read_text())["project"]
WORKFLOW = (TOP / ".github" / "workflows" / "ci.yml").read_text()
JOBS = yaml.safe_load(WORKFLOW)["jobs"]
README = (TOP / "README.md").read_text()
LINK = re.compile(r"\]\(([^)\s]*)\)|src=\"([^\"]*)\"")

description = runpy.run_path(str(TOP / "setup.py"))["description"]


def test_every_shard_of_the_long_tests_is_in_the_workflow():
    runs = [step.get("run", "") for step in JOBS["evidence"]["steps"]]
    run, = (each for each in runs if "--shard" in each)
    shards = JOBS["evidence"]["strategy"]["matrix"]["shard"]
    assert shards == list(range(1, len(shards) + 1))
    assert run.endswith(f"/{len(shards)}")


def test_workflow_names_files_and_extras_that_exist():
    runs = [step["run"] for job in JOBS.values() for step in job["steps"] if "run" in step]
    named = {path for run in runs for path in re.findall(r"(?<!\S)(?:\.ci|pipelines)/\S+", run)}
    assert {".ci/run", ".ci/versions", ".ci/wheel"} <= named
    for path in named:
        assert (TOP / path).is_file(), path
    extras = {extra for run in runs for extra in re.findall(r"'\.\[(\w+)\]'", run)}
    assert extras <= set(PROJECT["optional-dependencies"])


def test_pythons_that_are_promised_are_tried():
    tried = JOBS["pythons"]["strategy"]["matrix"]["python"]
    promised = [found[1] for each in PROJECT["classifiers"]
                if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", each))]
    assert PROJECT["requires-python"] == f">={promised[0]}"
    assert set(promised) <= set(tried)
    assert (f"Python {tried[-1]}" in WORKFLOW) == (tried[-1] not in promised)


def links(page):
    return ["".join(found) for found in LINK.findall(page)]


def test_links_of_the_package_page_are_absolute_and_lead_to_files_of_the_tree():
    page = description(README, PROJECT.get("urls", {}).get("Source", ""), sweep.__version__)
    assert [link for link in links(page) if not link.startswith(("https://", "#"))] == []
    page = description(README, "https://host.example/owner/tree/", "1.2.3")
    tree = "https://host.example/owner/tree"
    made = [link for link in links(page) if link.startswith(tree)]
    assert len(made) == len([link for link in links(README) if not link.startswith("https:")])
    for link in made:
        kind, version, path = link.removeprefix(f"{tree}/").split("/", 2)
        assert (kind, version) in {("blob", "v1.2.3"), ("raw", "v1.2.3")}
        assert (TOP / path.partition("#")[0]).exists(), link
