"""The scripts that show faults of OpenCV are short, need nothing of ours, and find them."""

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


def test_the_guide_and_the_stored_table_have_every_finding():
    for path in SCRIPTS:
        assert f"| [`{path.stem}`]({path.name}) |" in GUIDE
        assert f"| [`{path.stem}`]({path.name}) |" in FOUND


@pytest.mark.evidence
def test_findings_are_those_of_the_stored_table():
    """The table's rows of the installed OpenCV come out again."""
    done = subprocess.run([sys.executable, FOLDER / "table.py"], capture_output=True, text=True,
                          check=True)
    rows = [line.split(" | ")[2] for line in done.stdout.splitlines()[2:] if VARIES not in line]
    assert len(rows) == len(SCRIPTS) - 1
    version = re.escape(cv2.__version__)
    known = re.findall(rf"\| [^|]*\b{version}\b[^|]*\| ([^|]* \|)", FOUND)
    assert set(rows) <= set(known)
