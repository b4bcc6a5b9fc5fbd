"""The scripts that show faults of OpenCV are short, need nothing of ours, and find them."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

FOLDER = Path(__file__).parent.parent / "pipelines" / "opencv_findings"
SCRIPTS = sorted(path for path in FOLDER.glob("*.py") if path.name != "table.py")
GUIDE = (FOLDER / "README.md").read_text()
FOUND = (FOLDER / "found.txt").read_text()
VARIES = "apriltag_deglitch"


def imported(tree):
    return {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import)
            for alias in node.names} | {
        node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_finding_is_short_and_needs_opencv_and_numpy_alone(path):
    text = path.read_text()
    assert text.count("\n") <= 40
    assert imported(ast.parse(text)) == {"cv2", "numpy"}


def test_the_guide_and_the_stored_table_have_every_finding():
    for path in SCRIPTS:
        assert f"| [`{path.stem}`]({path.name}) |" in GUIDE
        assert f"| [`{path.stem}`]({path.name}) |" in FOUND


@pytest.mark.long
def test_findings_are_those_of_the_stored_table():
    """The table's rows of the installed OpenCV come out again."""
    done = subprocess.run([sys.executable, FOLDER / "table.py"], capture_output=True, text=True,
                          check=True)
    rows = [line.split(" | ")[2] for line in done.stdout.splitlines()[2:] if VARIES not in line]
    assert len(rows) == len(SCRIPTS) - 1
    version = re.escape(cv2.__version__)
    known = re.findall(rf"\| [^|]*\b{version}\b[^|]*\| ([^|]* \|)", FOUND)
    assert set(rows) <= set(known)
