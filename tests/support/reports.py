"""Stores and commands of the tests of reports."""

import contextlib
import io

from support.stores import by_hand
from sweep import cli
from sweep.execution.status import close
from sweep.experiment.pipeline import Pipeline

CAMERA = """
seed = 7
camera = { width_px = 160, height_px = 120, fx_px = 150 }
marker = { size_m = 0.05 }
"""

FULL = f"""
title = "All <axes> & \\"kinds\\" of $figures$"
{CAMERA}
pose = {{ jitter_px = 0.5, azimuth_deg = {{ uniform = [0, 360] }} }}
scene = {{ black = 40, white = 220, background = 120, noise_grey = 4, bound = "known_blur" }}
[axes]
marker_id = [0, 7]
side_px = [7, 40]
tilt_deg = [0, 50]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe_square", "photometric"]
trial = 4
"""


def made(folder, text, name, settings=()):
    """Compute a store in this process, without a cluster; return its place."""
    url = str(folder / f"{name}.zarr")
    pipeline = Pipeline.from_text(text, settings, name=name)
    halves = tuple(-(-len(axis) // 2) for axis in pipeline.experiment.scene_axes)
    close(by_hand(url, pipeline, halves))
    return url


def command(*arguments):
    """Run a command in this process; return its exit status, output and error output."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(list(map(str, arguments)))
        except SystemExit as stopped:
            code = stopped.code
    return code, out.getvalue(), err.getvalue()
