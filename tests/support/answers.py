"""Tables of truth and answers, and the answers of the program that an export's README shows."""

import contextlib
import csv
import re
import runpy

TEXT = """
title = "Exchanged"
seed = 11
camera = { width_px = 200, height_px = 160, fx_px = 180, distortion = [0.05, -0.02, 0.001, 0.001] }
marker = { size_m = 0.05 }
pose = { jitter_px = 0.5 }
scene = { background = 128, noise_grey = 4 }
estimator = { solver = "ippe" }
[axes]
tilt_deg = [0, 50]
distance_m = [0.1, 0.25]
trial = 3
"""
"""A pipeline of markers that is exported."""


def answer(folder):
    """Run the README's script, which knows nothing of sweep, in an export's folder."""
    script = re.search(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)[1]
    assert "sweep" not in script
    file = folder.parent / "program.py"
    file.write_text(script)
    with contextlib.chdir(folder):
        runpy.run_path(str(file))


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path, rows):
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path
