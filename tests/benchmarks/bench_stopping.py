"""Poses and time of runs to a precision, against the fixed number that gives the same worst width.

    python tests/benchmarks/bench_stopping.py [--workers N] [--whole]

Of the paper's figure 4 (`pipelines/paper_fig4.toml`, its own renderer) every 16th distance, to
+-0.02; of `pipelines/tradeoff.toml` noise 2, two of the refinements and of the solvers, in windows,
to 5 % of the range's root mean square error. About ten minutes on two idle cores. ``--whole``: all
distances; both noises, three refinements and five solvers. That takes an hour.

The fixed number is that at which the widest interval that the analysis gives of fixed trials
(Wilson's; Student's of the logarithm, 95 %) is as wide as the widest that was reached; its time is
that of as many poses at the speed of the same run. Of rates it is also said how many times as many
as those that suffice if each rate is known beforehand.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

import sweep
from sweep.analysis import error_statistics, precision_reached
from sweep.analysis.intervals import wilson
from sweep.experiment.pipeline import Pipeline

PIPELINES = Path(__file__).parents[2] / "pipelines"
CASES = {
    "paper_fig4": (
        ["distance_m={ linspace = [0.1, 0.5, 11] }", "search.precision={ detection_rate = 0.02 }",
         'search.per=["tilt_deg", "distance_m"]', "search.max_trials=320"],
        "detection_rate"),
    "tradeoff": (
        ["noise_grey=2", 'window="auto"', 'bound="none"',
         'cornerRefinementMethod=["none", "subpix"]', 'solver=["ippe_square", "sqpnp"]',
         "search.precision={ range_rmse_percent = 0.05 }", "search.max_trials=6000"],
        "range_rmse_percent"),
}
WHOLE = {
    "paper_fig4": (CASES["paper_fig4"][0][1:], "detection_rate"),
    "tradeoff": (
        ['window="auto"', 'bound="none"', 'cornerRefinementMethod=["none", "subpix", "contour"]',
         'solver=["ippe_square", "ippe", "iterative", "sqpnp", "ap3p"]',
         "search.precision={ range_rmse_percent = 0.05 }", "search.max_trials=40000"],
        "range_rmse_percent"),
}


def fixed_draws(results, table, name, width):
    """Return the draws of every condition that give the widest interval the wanted half-width."""
    if name == "detection_rate":
        rates = table["value"].values.ravel()
        draws = np.arange(10, 20_000, 10)
        hits = np.round(rates[:, None] * draws)
        low, high = wilson(hits, draws)
        return int(draws[np.argmax(((high - low) / 2 <= width).all(axis=0))])
    dims = [str(dim) for dim in table["run"].dims]
    plain = results.drop_attrs(deep=False)  # as of fixed trials
    errors = error_statistics(plain, dims)
    half = (errors[f"{name}_high"] - errors[f"{name}_low"]) / 2 / errors[name]
    return int(np.ceil(float((table["run"] * (half / width) ** 2).max())))


def known_rates(table, width):
    """Return the poses that suffice if each rate is known, by Wald's interval."""
    rates = table["value"].values
    return max(int((1.96**2 * rates * (1 - rates) / width**2).sum()), 1)


def main():
    """Print what the two runs took."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--whole", action="store_true")
    options = parser.parse_args()
    workers = options.workers
    for case, (settings, name) in (WHOLE if options.whole else CASES).items():
        pipeline = Pipeline.from_toml(PIPELINES / f"{case}.toml", settings)
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            results = sweep.run(pipeline, store=f"{folder}/{case}.zarr", workers=workers)
            seconds = time.perf_counter() - begun
            table = precision_reached(results)
            first = dict.fromkeys(table.attrs["configuration_dims"], 0)
            run = table["run"].isel(first)
            poses, width = int(run.sum()), float(table["wanted"][0])
            widest = max(width, float(table["half_width"].max()))
            fixed = fixed_draws(results, table, name, widest) * run.size
            print(f"{case}: {name} to {width:g}, {run.size} conditions, "
                  f"{int(table['settled'].sum())} settled, widest "
                  f"{float(table['half_width'].max()):.4f}: {poses:,} poses in {seconds:.0f} s; "
                  f"fixed trials {fixed:,} poses, about {seconds * fixed / poses:.0f} s: "
                  f"{fixed / poses:.2f} times as many")
            if name == "detection_rate":
                print(f"  of known rates: {fixed / known_rates(table, width):.2f} times as many")


if __name__ == "__main__":
    main()
