"""Limits at rates of 0.9 and 0.99 on 24 conditions: searches against a dense scan.

`python -m tests.benchmarks limit [TRIALS] [REPETITIONS]` runs the dense scan, 24 conditions
(dictionary, tilt, noise) of 10 sides, into runs/limit-dense.zarr, and both searches. The rates of
the dense scan are then the truth of simulated searches, whose coverage and cost it prints, beside
equally many trials everywhere of the same mean width of the interval.
"""

import sys

import numpy as np

import sweep
from support.searches import is_covered, searched, true_limits
from sweep.analysis import detection_rate
from sweep.analysis.intervals import clopper_pearson

EXPERIMENT = {
    "camera": {"width_px": 320, "height_px": 240, "hfov_deg": 60},
    "pose": {"jitter_px": 0.5, "roll_deg": {"uniform": [-180, 180]}},
    "scene": {"black": 40, "white": 200, "background": 120},
    "axes": {
        "dictionary": ["DICT_4X4_50", "DICT_6X6_250"], "tilt_deg": [0, 30, 60],
        "noise_grey": [2, 8, 14, 20], "side_px": {"geom": [10, 50, 10]},
    },
}
CONDITIONS = ("dictionary", "tilt_deg", "noise_grey")
RATES = (0.9, 0.99)


def full_scan(curves, values, rate, trials, rng):
    """Return low and high of each curve from equally many trials of all values."""
    order = np.argsort(values)[::-1]
    hits = rng.binomial(trials, curves[:, order])
    surely = clopper_pearson(hits, trials)[0] >= rate
    possibly = clopper_pearson(hits, trials, 1 - 0.05 / len(values))[1] >= rate
    near, far = (np.logical_and.accumulate(each, axis=1).sum(axis=1)
                 for each in (surely, possibly))
    return near, far


def compare(trials=2400, repetitions=20, most=2400):
    dense = sweep.run(
        {**EXPERIMENT, "axes": {**EXPERIMENT["axes"], "trial": trials}},
        store="runs/limit-dense.zarr", yes=True)
    values = dense["side_px"].values
    rates = detection_rate(dense, [*CONDITIONS, "side_px"])["detection_rate"]
    curves = rates.transpose(*CONDITIONS, "side_px").values.reshape(-1, len(values))
    for rate in RATES:
        text = f"detection >= {rate}"
        found = sweep.limit(EXPERIMENT, require=[text], along="side_px", max_trials=trials,
                            reuse=["runs/limit-dense.zarr"], store=f"runs/limit-{rate}.zarr")
        truth = true_limits(curves, values, rate)
        real = found.transpose(*CONDITIONS, ...)
        low, high = (real[name].values.reshape(-1) for name in ("low", "high"))
        inside = (low <= truth) & (truth <= high)
        print(f"{text}: run on {len(curves)} conditions: {int(real['poses'].sum()):,} poses of "
              f"{curves.size * trials:,}, {inside.sum()} intervals cover the dense scan's limit, "
              f"{int(real['settled'].sum())} are one value")
        poses, covered, widths = [], [], []
        for seed in range(repetitions):
            limits = searched(curves, values, text, most, seed)
            poses.append(int(limits["poses"].sum()))
            covered.append(is_covered(limits, truth))
            ends = [np.searchsorted(np.sort(values), limits[name].values) for name in
                    ("low", "high")]
            widths.append((ends[1] - ends[0]).mean())
        width = float(np.mean(widths))
        rng = np.random.default_rng(1)
        fixed = next((count for count in (*range(50, most, 50), most) if np.mean([
            np.subtract(*full_scan(curves, values, rate, count, rng)[::-1]).mean()
            for _ in range(20)]) <= width), None)
        print(f"  simulated {repetitions} times: coverage {np.mean(covered):.4f}, lowest of a "
              f"condition {np.mean(covered, axis=0).min():.2f}, {np.mean(poses):,.0f} poses, mean "
              f"width {width:.2f} values; equal trials of that width: "
              f"{fixed or f'more than {most}'} each, "
              f"{(fixed or most) * curves.size / np.mean(poses):.1f} times as many poses")


def main():
    """Run with the numbers of the command line."""
    compare(*map(int, sys.argv[1:]))


if __name__ == "__main__":
    main()
