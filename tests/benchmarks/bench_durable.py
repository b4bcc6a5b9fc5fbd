"""What `--durable` costs: blocks written with and without it, in turns, into two stores.

Arguments: a folder on the disk in question (default: the current one), and the number of blocks.
"""

import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path

from sweep.execution.block_task import compute_block
from sweep.plan.experiment import Pipeline
from sweep.store.lifecycle import create_store

SCENES = 500
"""Scenes of a block; their time is taken off below."""

TEXT = """
[pose]
distance_m = 0.3
jitter_px = 0.5
[axes]
trial = %d
tilt_deg = [0, 60]
"""


def main():
    where = sys.argv[1] if len(sys.argv) > 1 else "."
    count = int(sys.argv[2]) if len(sys.argv) > 2 else 10
    folder = Path(tempfile.mkdtemp(prefix=".bench-", dir=where))
    pipeline = Pipeline.from_text(TEXT % (SCENES * count), name="durable")
    try:
        stores = {
            durable: create_store(
                str(folder / f"{durable}.zarr"), pipeline, (SCENES, 2), durable=durable
            )
            for durable in (False, True)
        }
        taken = {False: [], True: []}
        for number in range(count):
            for durable, store in stores.items():
                begun = time.perf_counter()
                compute_block(
                    store.url, store.run_id, store.blocks[number], durable=durable
                )
                taken[durable].append(time.perf_counter() - begun)
    finally:
        shutil.rmtree(folder)
    plain, durable = (statistics.median(taken[kind][1:]) for kind in (False, True))
    more = durable - plain
    print(f"a block of {2 * SCENES} scenes: {1e3 * plain:.0f} ms, durable {1e3 * durable:.0f} ms: "
          f"ratio {durable / plain:.2f}")
    print(f"{1e3 * more:.0f} ms a block: {more / 2:.1%} of a block of 2 s")


if __name__ == "__main__":
    main()
