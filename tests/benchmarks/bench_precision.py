"""How much of the time of a run to a precision is spent on deciding which trials are needed.

Blocks are computed in this process, in the order of a run; processor seconds are measured, so that
other load on the machine does not count.

    python tests/benchmarks/bench_precision.py [--sides 24] [--max-trials 2400] [--width 0.02]
"""

import argparse
import tempfile
import time
from pathlib import Path

from sweep.execution.block_task import compute_blocks
from sweep.execution.forecast import blocks_of, seconds_of
from sweep.execution.progress import InWaves
from sweep.plan.pipeline import Pipeline
from sweep.sampling.rules import Decider, make_rule
from sweep.store.lifecycle import create_store

TEXT = """
seed = 1
pose = {{ jitter_px = 0.5 }}
axes = {{ tilt_deg = [0, 45], side_px = {{ geom = [8, 40, {sides}] }} }}
precision = {{ {wanted}, max_trials = {most} }}
"""

WANTED = {
    "rate": "detection_rate = {width}",
    "rate and spread": 'detection_rate = {width}, position_rmse_m = "10 %"',
}


def measure(wanted, options):
    """Compute a store in waves; return poses that were needed, and seconds by what took them."""
    pipeline = Pipeline.from_text(TEXT.format(
        sides=options.sides, most=options.max_trials, wanted=wanted.format(width=options.width)))
    rule = make_rule(pipeline)
    (spent_s,), sampled = seconds_of([pipeline], 1536)
    extents = blocks_of(pipeline, spent_s / sampled, 2).extents
    spent = {"deciding": 0.0, "scheduling": 0.0}
    decide = Decider.needed

    def timed(self, block, decision):
        start = time.process_time()
        try:
            return decide(self, block, decision)
        finally:
            spent["deciding"] += time.process_time() - start

    Decider.needed = timed
    try:
        with tempfile.TemporaryDirectory() as folder:
            store = create_store(str(Path(folder) / "run.zarr"), pipeline, extents)
            waiting = InWaves(store, pipeline.stopping, rule)
            begun, needed, empty_s = time.process_time(), 0, 0.0
            while True:
                start = time.process_time()
                work = waiting.next()
                spent["scheduling"] += time.process_time() - start
                if work is None:
                    break
                blocks = [store.blocks[number] for number in work.numbers]
                start, before = time.process_time(), spent["deciding"]
                done = compute_blocks(store.url, store.run_id, blocks, work.decision)
                if not any(receipt.any_needed for receipt in done):
                    empty_s += time.process_time() - start - (spent["deciding"] - before)
                start = time.process_time()
                for number, receipt in zip(work.numbers, done, strict=True):
                    needed += receipt.scenes_needed
                    waiting.committed(number, receipt)
                spent["scheduling"] += time.process_time() - start
            return len(store.blocks), needed, time.process_time() - begun, empty_s, spent
    finally:
        Decider.needed = decide


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sides", type=int, default=24)
    parser.add_argument("--max-trials", type=int, default=2400)
    parser.add_argument("--width", type=float, default=0.02)
    options = parser.parse_args()
    for name, wanted in WANTED.items():
        blocks, needed, total_s, empty_s, spent = measure(wanted, options)
        deciding = ", ".join(f"{what} {100 * s / total_s:.2g} %" for what, s in spent.items())
        print(
            f"{name}: {needed:,} of {2 * options.sides * options.max_trials:,} poses in {blocks:,} "
            f"blocks, {total_s:.1f} s: {deciding}, blocks of which nothing was needed "
            f"{100 * empty_s / total_s:.2g} %"
        )


if __name__ == "__main__":
    main()
