"""Searches by `sweep size` against a grid of fixed trials with ten times their poses.

    python -m tests.benchmarks size

Each file of pipelines/sizes is searched, then run as a grid of equally many trials, with another
seed. By the grid's own decisions (`sweep require`, 95 %) the answer and all values on its safe side
must be met at all conditions, and the next value must not be.
"""

import math
import tempfile
import tomllib
from pathlib import Path

import numpy as np

import sweep
from sweep.analysis.requirements import Decision, check_requirements
from sweep.experiment.pipeline import Pipeline
from sweep.report.findings import headline
from sweep.tradeoff.choice_search import size

SIZES = Path(__file__).parents[2] / "pipelines" / "sizes"
NAMES = ("dip", "cheapest", "smallest_marker", "farthest", "dictionary")
SETTINGS = ()
TIMES = 10
QUICK = {
    "NAMES": ("smallest_marker",), "TIMES": 1,
    "SETTINGS": ("size_m=[0.02, 0.08]", "tilt_deg=[0]", "search.max_trials=300"),
}


def brute_force(pipeline, choice, place):
    """Return the decisions of a grid with ten times the poses of a search, and its poses."""
    document = tomllib.loads(pipeline.text)
    del document["search"], document["require"]
    document["seed"] += 1000
    document["axes"]["trial"] = math.ceil(TIMES * choice.poses / choice.cells)
    results = sweep.run(document, store=place, workers=1)
    rule = choice.rule
    kept = [*rule.among, *([rule.along] if rule.along else []), *rule.per]
    decisions = check_requirements(results, rule.requirements, per=kept)["decision"]
    return decisions, math.prod(
        results.sizes[dim] for dim in results["true_tvec_m"].dims if dim != "xyz")


def compared(name, folder):
    """Search, run the grid, and print whether they agree; return whether they do."""
    pipeline = Pipeline.from_toml(SIZES / f"{name}.toml", SETTINGS)
    choice = size(pipeline, store=f"{folder}/{name}.zarr", workers=1)
    print(f"\n{name}", headline(choice), sep="\n  ", flush=True)
    table, poses = brute_force(pipeline, choice, f"{folder}/{name}_grid.zarr")
    rule, agreed = choice.rule, True
    for answer in choice.answers:
        one = table.sel(answer.alternative)
        label = ", ".join(map(str, answer.alternative.values())) or "answer"
        if rule.along:
            good = None
            if answer.value is not None:
                values = one[rule.along].values
                safe = values <= answer.value if rule.largest else values >= answer.value
                good = one.isel({rule.along: np.flatnonzero(safe)})
            after = None if answer.next is None else one.sel({rule.along: answer.next})
        else:
            good, after = (one, None) if answer.met else (None, one)
        met = good is None or not (good == Decision.not_met).any()
        fails = after is None or bool((after == Decision.not_met).any())
        agreed &= bool(met) and fails
        print(f"  grid: {label}: {answer.value} meets all: {bool(met)}; next {answer.next} fails: "
              f"{fails}")
    print(f"  {choice.poses:,} poses; grid {poses:,}; equally many trials as the hardest cell: "
          f"{choice.grid_poses:,}; agreed: {agreed}", flush=True)
    return agreed


def main():
    """Compare the files."""
    with tempfile.TemporaryDirectory() as folder:
        agreed = [compared(name, folder) for name in NAMES]
    print(f"\n{sum(agreed)} of {len(agreed)} agree")
