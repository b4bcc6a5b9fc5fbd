"""Imports run one way: the contract in pyproject.toml holds, and fails on an arrow upwards."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("importlinter")  # CI runs this file in the environment of the linters

TOP = Path(__file__).parent.parent


def contract_of(folder):
    """Return import-linter's exit status and output for the package in a folder."""
    ran = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()",
         "--no-cache"],
        cwd=folder, env={"PYTHONPATH": str(folder)}, capture_output=True, text=True, check=False,
    )
    return ran.returncode, ran.stdout + ran.stderr


@pytest.fixture
def copied(tmp_path):
    shutil.copytree(TOP / "sweep", tmp_path / "sweep", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(TOP / "pyproject.toml", tmp_path)
    return tmp_path


def test_rooms_import_one_way():
    status, output = contract_of(TOP)
    assert status == 0, output


@pytest.mark.parametrize(("lower", "upper"), [
    ("model/pose.py", "sweep.measure.flags"),
    ("store/layout.py", "sweep.evaluation"),      # neighbours are independent, too
    pytest.param("experiment/draws.py", "sweep.report.figure", marks=pytest.mark.long),
])
def test_an_import_upwards_breaks_the_contract(copied, lower, upper):
    with (copied / "sweep" / lower).open("a") as file:
        file.write(f"\nimport {upper}\n")
    status, output = contract_of(copied)
    assert status == 1
    assert "BROKEN" in output
    assert f"sweep.{lower[:-3].replace('/', '.')} -> {upper}" in output


@pytest.mark.parametrize(("imported", "importer"), [
    ("model/pose.py", "sweep.model.scene"),
    pytest.param("experiment/axes.py", "sweep.experiment.pipeline", marks=pytest.mark.long),
])
def test_a_circle_inside_a_room_breaks_the_contract(copied, imported, importer):
    with (copied / "sweep" / imported).open("a") as file:
        file.write(f"\nif False:\n    import {importer}\n")
    status, output = contract_of(copied)
    assert status == 1
    assert "No circle of imports" in output


def test_a_room_that_the_contract_does_not_name_breaks_it(copied):
    (copied / "sweep" / "attic").mkdir()
    (copied / "sweep" / "attic" / "__init__.py").write_text('"""A room without a layer."""\n')
    status, output = contract_of(copied)
    assert status != 0
    assert "attic" in output
