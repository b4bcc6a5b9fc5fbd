"""Imports run one way: the contract in pyproject.toml holds."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("importlinter")  # CI runs this file in the environment of the linters

TOP = Path(__file__).parent.parent


@pytest.mark.system
def test_rooms_import_one_way():
    ran = subprocess.run(
        [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()",
         "--no-cache"],
        cwd=TOP, env={"PYTHONPATH": str(TOP)}, capture_output=True, text=True, check=False,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
