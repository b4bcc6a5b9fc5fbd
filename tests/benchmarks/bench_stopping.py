"""Poses and time of runs to a precision, against the fixed number that gives the same worst width.

    python -m tests.benchmarks stopping

Of the paper's figure 4 (`pipelines/paper_fig4.toml`, its own renderer) to +-0.02; of
`pipelines/tradeoff.toml` in windows, three refinements and five solvers, to 5 % of the range's root
mean square error. About an hour on two idle cores.

The fixed number is that at which the widest interval that the analysis gives of fixed trials
(Wilson's; Student's of the logarithm, 95 %) is as wide as the widest that was reached; its time is
that of as many poses at the speed of the same run.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

import sweep
from sweep.analysis import error_statistics, precision_reached
from sweep.analysis.estimator import wilson
from sweep.experiment.pipeline import Pipeline

PIPELINES = Path(__file__).parents[2] / "pipelines"
CASES = {
    "paper_fig4": (
        ["search.precision={ detection_rate = 0.02 }", 'search.per=["tilt_deg", "distance_m"]',
         "search.max_trials=320"],
        "detection_rate"),
    "tradeoff": (
        ['window="auto"', 'bound="none"', 'cornerRefinementMethod=["none", "subpix", "contour"]',
         'solver=["ippe_square", "ippe", "iterative", "sqpnp", "ap3p"]',
         "search.precision={ range_rmse_percent = 0.05 }", "search.max_trials=40000"],
        "range_rmse_percent"),
}

QUICK = {"CASES": {"paper_fig4": (
    ["distance_m=[0.1, 0.3]", "tilt_deg=[0]", "search.precision={ detection_rate = 0.2 }",
     "search.max_trials=40"], "detection_rate")}}


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


def main():
    """Print what the two runs took."""
    for case, (settings, name) in CASES.items():
        pipeline = Pipeline.from_toml(PIPELINES / f"{case}.toml", settings)
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            results = sweep.run(pipeline, store=f"{folder}/{case}.zarr")
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
