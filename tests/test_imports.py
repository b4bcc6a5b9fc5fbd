"""Imports run one way: the contract in pyproject.toml holds, and fails on an arrow upwards."""

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


@pytest.mark.system
def test_rooms_import_one_way():
    status, output = contract_of(TOP)
    assert status == 0, output
