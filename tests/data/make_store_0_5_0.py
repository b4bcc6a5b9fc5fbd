"""Make ``store-0.5.0.zip`` with the ``sweep`` command of version 0.5.0, given as the argument.

    python tests/data/make_store_0_5_0.py .venv-0.5.0/bin/sweep

It holds the pipeline's file ``old.toml``, its finished store ``finished.zarr``, and
``unfinished.zarr``, of the same pipeline with more trials, whose run was killed (SIGKILL to all
its processes) after the first of its blocks.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

PIPELINE = """\
title = "A store of sweep 0.5.0"
seed = 50

[camera]
width_px = 640
height_px = 480

[marker]
size_m = 0.05

[pose]
jitter_px = 0.5
azimuth_deg = { uniform = [0, 360] }
roll_deg = { uniform = [0, 360] }

[scene]
black = 40
white = 220
background = 120
bound = "known_blur"

[estimator]
corner_noise_px = 0.3

[axes]
side_px = [6, 24, 40]
tilt_deg = [10, 50]
noise_grey = [2, 8]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe_square", "photometric"]
trial = 3
"""


def main():
    sweep = Path(sys.argv[1]).absolute()
    target = Path(__file__).with_name("store-0.5.0.zip")
    # The folder is recorded in the stores; this one is likely to exist nowhere.
    folder = Path("/srv/sweep-0.5.0")
    folder.mkdir()
    try:
        (folder / "old.toml").write_text(PIPELINE)
        run = [sweep, "run", "old.toml", "--workers", "2", "--store"]
        subprocess.run([*run, "finished.zarr"], cwd=folder, check=True)
        with tempfile.TemporaryFile() as output, subprocess.Popen(
            [*run, "unfinished.zarr", "--set", "trial=12"], cwd=folder, start_new_session=True,
            stdout=output, stderr=output,
        ) as running:
            receipts = folder / "unfinished.zarr/commits/receipt/c"
            while running.poll() is None and not (receipts.exists() and any(receipts.iterdir())):
                time.sleep(0.001)
            os.killpg(running.pid, signal.SIGKILL)
        # Long ago, whatever clock the tests see.
        lock = folder / "unfinished.zarr/commits/receipt/lock.json"
        lock.write_text(json.dumps({**json.loads(lock.read_text()), "beat": 0.0}))
        with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as packed:
            for path in sorted(folder.rglob("*")):
                if path.is_file():
                    packed.write(path, path.relative_to(folder))
    finally:
        subprocess.run(["rm", "-r", folder], check=True)


main()
