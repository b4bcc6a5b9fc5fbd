"""What the guides show is what the project does: blocks run, links lead somewhere, tables hold.

A comment before a block says what is done with it: ``<!-- not run: why -->`` (its syntax and its
flags are checked), ``<!-- file: NAME -->`` (it is written, for the blocks that follow), any other
or none (it runs).
"""

import ast
import contextlib
import io
import re
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
from sweep.photographs.twins import read_scene

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
    "answers": ["detection_rate_low", "rotation_p95_deg", "per_module", "p_adjusted"],
    "tutorial": ["side_px_high", "subpix", "range_rmse_ratio_low"],
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
    for command, *arguments in commands_of(block):
        if command == "sweep":
            flags_exist(arguments, capsys)


@pytest.mark.system
def test_blocks_for_a_shell_have_its_syntax():
    blocks = "\n".join(block.text for block in BLOCKS if block.language == "sh")
    subprocess.run(["bash", "-n"], input=blocks, text=True, check=True)


def flags_exist(arguments, capsys):
    with pytest.raises(SystemExit, match="0"):
        main([arguments[0], "--help"])
    helped = capsys.readouterr().out
    for argument in arguments[1:]:
        if re.fullmatch(r"--?[a-z][a-z-]*", argument):
            assert re.search(rf"(?<![\w-]){argument}\b", helped), argument


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
