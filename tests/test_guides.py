"""What guides, notebooks and the README show is what the project does.

Blocks run, links lead somewhere, tables hold. A comment before a block says what is done with it:
``<!-- not run: why -->`` (its syntax and its flags are checked), ``<!-- file: NAME -->`` (it is
written, for the blocks that follow), any other or none (it runs).
"""

import ast
import contextlib
import io
import os
import re
import runpy
import shlex
import subprocess
from pathlib import Path
from typing import NamedTuple

import pytest

from support.here import calls_here
from sweep.cli import main
from sweep.experiment.parameters import Stage
from sweep.experiment.photographs import read_board
from sweep.experiment.pipeline import Pipeline
from sweep.photographs.prepare import read_scene

TOP = Path(__file__).parent.parent
FOLDERS = ("pipelines", "sweep", "tests", "notebooks")
GUIDES = [TOP / "README.md", TOP / "CONTRIBUTING.md", *sorted(
    path for folder in FOLDERS for path in (TOP / folder).rglob("README.md"))]
NAMES = [str(path.relative_to(TOP)) for path in GUIDES]
BLOCK = re.compile(r"(?:<!-- ([^\n]*?) -->\n)?```(\w*)\n(.*?)```", re.DOTALL)

FIRST_READ = ("README.md", "pipelines/README.md")
"""Guides whose blocks are run by default; those of all guides are run by the long tests."""

RESULTLESS = {"plan", "show"}
"""Commands without which the blocks that follow run: by default each is run once for all guides."""

SLOW = {"report"}
"""Commands that by default are left to tests of their own."""

REST = """
[estimator]
solver = "iterative"
[axes]
distance_m = [0.5, 0.6]
"""
"""What a part of a pipeline lacks."""

SHOWN = {
    "analysis": ["tilt_deg", "distance_m"],
    "answers": ["detection_rate_low", "rotation_p95_deg", "distance_m", "p_adjusted"],
    "tutorial": ["tilt_deg", "subpix", "range_rmse_ratio_low"],
}
"""What the block with a comment prints, among other things."""


class Block(NamedTuple):
    guide: str
    comment: str
    language: str
    text: str

    @property
    def runs(self):
        """Whether it is run here; CI runs the README's two commands in a fresh clone."""
        return not self.comment.startswith(("not run", "run", "test"))


def blocks_of(path):
    return [Block(str(path.relative_to(TOP)), *match.groups(default=""))
            for match in BLOCK.finditer(path.read_text())]


BLOCKS = [block for path in GUIDES for block in blocks_of(path)]


def commands_of(block):
    """Return the commands of a shell block, as lists of words."""
    lines = block.text.replace("\\\n", " ").splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [[Path(line[0]).name, *line[1:]] for line in words if line]


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """A folder as a clone is, in which the main job has been run."""
    folder = tmp_path_factory.mktemp("clone")
    for name in FOLDERS:
        (folder / name).symlink_to(TOP / name)
    with (
        calls_here(), contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()) as output
    ):
        assert main(["run", "pipelines/smoke.toml"]) == 0
    assert 'xarray.open_zarr("runs/smoke.zarr")' in output.getvalue()
    return folder


@pytest.fixture(scope="module")
def commands_run():
    """The commands that have been run in the workspace; several guides show the same."""
    return set()


@pytest.mark.parametrize(("name", "every"), [
    *(pytest.param(name, False, id=f"{name}-each command once") for name in FIRST_READ),
    *(pytest.param(name, True, id=name, marks=pytest.mark.evidence) for name in NAMES),
])
def test_blocks_of_a_guide_run_in_their_order(
    name, every, workspace, commands_run, monkeypatch, capsys
):
    monkeypatch.chdir(workspace)
    for block in blocks_of(TOP / name):
        if block.comment == "file: board.toml":
            Path("board.toml").write_text(block.text)
            assert len(read_board("board.toml").marker_ids)
        elif block.comment == "file: scene.toml":
            Path("scene.toml").write_text(block.text)
            document = {"pose": {"distance_m": 1}, "scene": read_scene("scene.toml")}
            assert Pipeline.from_dict(document)
        elif block.language == "toml":
            rest = REST if block.comment == "part of a pipeline" else ""
            assert Pipeline.from_text(block.text + rest).size(*Stage) > 1
        if block.comment.startswith("file: "):
            few = re.sub(r"^trial = \d+", "trial = 10", block.text, flags=re.MULTILINE)
            Path(block.comment.removeprefix("file: ")).write_text(few)
        elif block.runs and block.language == "python":
            capsys.readouterr()
            exec(compile(block.text, name, "exec"), {"__name__": "__main__"})  # noqa: S102
            output = capsys.readouterr().out
            for shown in SHOWN.get(block.comment, ()):
                assert shown in output
        elif block.runs and block.language == "sh":
            for command, *arguments in commands_of(block):
                assert command == "sweep", "other commands are not run: say why"
                known = {run[0] for run in commands_run}
                if not every and arguments[0] in (RESULTLESS & known) | SLOW:
                    continue
                if tuple(arguments) not in commands_run:
                    assert main(arguments) == 0, (arguments, capsys.readouterr().err)
                commands_run.add(tuple(arguments))


@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.language == "python" and not block.runs],
    ids=lambda block: block.guide)
def test_python_that_is_not_run_has_the_right_syntax(block):
    ast.parse(block.text)


@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.language == "sh"],
    ids=lambda block: block.guide)
def test_flags_of_commands_exist(block, capsys):
    for arguments in (words[1:] for words in commands_of(block) if words[0] == "sweep"):
        with pytest.raises(SystemExit, match="0"):
            main([arguments[0], "--help"])
        helped = capsys.readouterr().out
        for argument in arguments[1:]:
            if re.fullmatch(r"--?[a-z][a-z-]*", argument):
                assert re.search(rf"(?<![\w-]){argument}\b", helped), argument


@pytest.mark.system
def test_blocks_for_a_shell_have_its_syntax():
    blocks = "\n".join(block.text for block in BLOCKS if block.language == "sh")
    subprocess.run(["bash", "-n"], input=blocks, text=True, check=True)


def cells(row):
    return len(re.split(r"(?<!\\)\|", row.strip().strip("|")))


@pytest.mark.parametrize("name", NAMES)
def test_tables_are_whole(name):
    """A renderer ends a table at the first line that is no row."""
    text = BLOCK.sub("", (TOP / name).read_text())
    for table in re.findall(r"(?:^\|[^\n]*\n)+", text, re.MULTILINE):
        heading, rule, *rows = table.splitlines()
        assert re.fullmatch(r"\|( -+:? \|)+", rule), table
        assert rows, heading
        assert {cells(row) for row in rows} == {cells(heading)} == {cells(rule)}, heading


def anchors(text):
    """Return the anchors of a page's headings, as code hosts make them."""
    headings = re.findall(r"^#+ (.*)$", BLOCK.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", [*NAMES, "CHANGELOG.md"])
def test_links_lead_somewhere(name):
    text = (TOP / name).read_text()
    links = re.findall(r"\]\((?!https?:)([^)\s]+)\)|src=\"(?!https?:)([^\"]+)\"", text)
    for link in links:
        path, _, anchor = "".join(link).partition("#")
        target = (TOP / name).parent / path if path else TOP / name
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target.read_text()), link


@pytest.mark.parametrize("name", NAMES)
def test_files_and_tests_that_are_named_exist(name):
    """Commands behind measured figures can be run, and name tests that there are."""
    text = (TOP / name).read_text()
    for path in re.findall(r"(?<![\w/.])(?:tests|notebooks|pipelines)/[\w/]+\.(?:py|toml)", text):
        assert (TOP / path).exists(), path
    for path, words in re.findall(r"(tests/[\w/]+\.py) -k (\"[^\"]+\"|\w+)", text):
        tests = " ".join(re.findall(r"def (test_\w+)", (TOP / path).read_text()))
        assert any(word in tests for word in words.strip('"').split(" or ")), (path, words)


def test_files_and_names_of_the_architecture_exist():
    text = (TOP / "sweep" / "README.md").read_text()
    rooms = {path.name for path in (TOP / "sweep").iterdir()}
    paths = re.findall(r"`((?:\w+/)*\w*\.py|\w+/)`", text)
    assert len(paths) > 20
    for path in paths:
        assert (TOP / "sweep" / path).exists() or (TOP / path).exists() or (
            "/" not in path and list((TOP / "sweep").glob(f"*/{path}"))), path
    assert {path.partition("/")[0] for path in paths if path.endswith("/")} <= rooms
    sources = "".join(path.read_text() for folder in ("sweep", "tests")
                      for path in (TOP / folder).rglob("*.py"))
    for name in re.findall(r"`([A-Za-z]+_\w+|[A-Z][a-z]+[A-Z]\w+)`", text):
        assert re.search(rf"\b{name}\b", sources), name


@pytest.mark.parametrize("path", sorted((TOP / "pipelines").glob("*.toml")), ids=lambda p: p.stem)
def test_every_pipeline_is_sound(path):
    pipeline = Pipeline.from_toml(path)
    assert pipeline.title
    assert pipeline.size(*Stage) > 1


def test_plan_says_what_a_run_takes(capsys):
    smoke = str(TOP / "pipelines" / "smoke.toml")
    assert main(["plan", smoke, "--set", "distance_m=[0.2, 0.3]"]) == 0
    told = capsys.readouterr().out
    assert re.search(r"distance_m +2 +scene +0.2 ... 0.3 m", told)
    assert re.search(r"poses +240", told)
    assert re.search(r"time +(over )?\S+ (s|min|h)", told)


NOTEBOOKS = TOP / "notebooks"
FIGURES = {"choosing_a_marker": 6, "paper_reproduced": 4, "first_analysis": 5}
TIMEOUT_S = 300  # a cell, on a busy machine
COSTS = {"choosing_a_marker": "## The recommendation"}
"""The heading from which on a notebook prints times, which no two runs have alike."""


def read(name):
    return pytest.importorskip("nbformat").read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def code_cells(notebook):
    return [each for each in notebook.cells if each.cell_type == "code"]


@pytest.mark.parametrize("name", [path.stem for path in NOTEBOOKS.glob("*.ipynb")])
def test_notebook_is_stored_with_the_outputs_of_its_sources(name):
    notebook = read(name)
    pytest.importorskip("nbformat").validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.metadata.kernelspec.name == "python3"
    assert all(each.metadata == {} for each in notebook.cells)
    source_digest = runpy.run_path(str(NOTEBOOKS / "make.py"))["source_digest"]
    assert notebook.metadata.sweep.source_digest == source_digest(notebook), (
        f"python notebooks/make.py {name}")
    numbers = [each.execution_count for each in code_cells(notebook)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert figures_of(notebook) == FIGURES[name]


def figures_of(notebook):
    """Return the number of figures, after checks of a notebook's outputs."""
    shown = 0
    for each in code_cells(notebook):
        kinds = {output.output_type for output in each.outputs}
        complaints = [output.text for output in each.outputs
                      if output.output_type == "stream" and output.name == "stderr"
                      and "pipelines/half_pixel" not in output.text]  # a note on the pipeline
        images = [output for output in each.outputs
                  if output.output_type == "display_data" and "image/png" in output.data]
        assert "error" not in kinds
        assert not complaints
        assert len(images) == each.source.count("plt.show()"), each.source
        shown += len(images)
    return shown


def printed(notebook, until):
    """Return what the cells before the one that starts with ``until`` print."""
    texts = []
    for each in notebook.cells:
        if until and each.source.startswith(until):
            break
        if each.cell_type == "code" and 'group="cost"' not in each.source:
            texts += [output.text for output in each.outputs if output.output_type == "stream"]
            texts += [output.data["text/plain"] for output in each.outputs
                      if output.output_type == "execute_result"
                      and "xarray.Dataset" not in output.data["text/plain"]]
    return texts


@pytest.mark.evidence
@pytest.mark.parametrize("name", FIGURES)
def test_notebook_runs_shows_its_figures_and_prints_again_what_is_stored(name, tmp_path):
    """With the same versions and processor features; times are left out."""
    notebook = read(name)
    client = pytest.importorskip("nbclient").NotebookClient(
        notebook, timeout=TIMEOUT_S, kernel_name="python3",
        resources={"metadata": {"path": str(NOTEBOOKS)}})
    client.execute(env=os.environ | {"SWEEP_RUNS": str(tmp_path)})
    assert figures_of(notebook) == FIGURES[name]
    assert list(tmp_path.glob("*.zarr")), "stores go where SWEEP_RUNS says"
    until = COSTS.get(name)
    assert printed(notebook, until) == printed(read(name), until)
