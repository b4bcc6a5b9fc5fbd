"""Searches by `sweep size` against a grid of fixed trials with ten times their poses.

    python tests/benchmarks/bench_size.py [FOLDER [NAME ...]]

Each file of pipelines/sizes is searched, then run as a grid of equally many trials, with another
seed. By the grid's own decisions (`sweep require`, 95 %) the answer and all values on its safe side
must be met at all conditions, and the next value must not be. Stores are made in FOLDER (a
temporary one) and found again there.
"""

import math
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import numpy as np

import sweep
from sweep.analysis.requirements import Decision, check_requirements
from sweep.experiment.pipeline import Pipeline
from sweep.report.decisions import headline
from sweep.tradeoff.choice_search import search_choice

SIZES = Path(__file__).parents[2] / "pipelines" / "sizes"
TIMES = 10


def searched(name, folder):
    """Return what a search found, and its seconds."""
    started = time.perf_counter()
    pipeline = Pipeline.from_toml(SIZES / f"{name}.toml")
    choice = search_choice(pipeline, str(folder / f"{name}.zarr"), workers=1)
    return choice, time.perf_counter() - started


def brute_force(name, choice, folder):
    """Return the results of a grid with ten times the poses of a search, and its seconds."""
    document = tomllib.loads((SIZES / f"{name}.toml").read_text())
    del document["search"], document["require"]
    document["seed"] += 1000
    document["axes"]["trial"] = math.ceil(TIMES * choice.poses / choice.cells)
    started = time.perf_counter()
    results = sweep.run(document, store=folder / f"{name}_grid.zarr", workers=1)
    return results, time.perf_counter() - started


def decisions(results, rule):
    """Return whether each requirement is met, and values; conditions side by side."""
    kept = [*rule.among, *([rule.along] if rule.along else []), *rule.per]
    table = check_requirements(results, rule.requirements, per=kept)
    return table[["decision", "value"]]


def compared(name, folder):
    """Search, run the grid, and print whether they agree; return whether they do."""
    choice, seconds = searched(name, folder)
    print(f"\n{name}: {seconds:.0f} s", headline(choice), sep="\n  ", flush=True)
    results, grid_seconds = brute_force(name, choice, folder)
    table, rule, agreed = decisions(results, choice.rule), choice.rule, True
    poses = math.prod(results.sizes[dim] for dim in results["true_tvec_m"].dims if dim != "xyz")
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
        met = good is None or not (good["decision"] == Decision.not_met).any()
        surely = good is None or bool((good["decision"] == Decision.met).all())
        fails = after is None or bool((after["decision"] == Decision.not_met).any())
        agreed &= bool(met) and fails
        print(f"  grid: {label}: {answer.value} meets all: {surely}"
              f"{'' if surely or not met else ' (undecided, none fails)'}; "
              f"next {answer.next} fails: {fails}")
    print(f"  {choice.poses:,} poses in {seconds:.0f} s; grid {poses:,} poses in "
          f"{grid_seconds:.0f} s ({poses / choice.poses:.1f} times as many); equally many trials "
          f"as the hardest cell: {choice.grid_poses:,}; agreed: {agreed}", flush=True)
    return agreed


def compare(folder, *names):
    """Compare the files."""
    agreed = [compared(name, folder) for name in names or (
        "dip", "cheapest", "smallest_marker", "farthest", "dictionary")]
    print(f"\n{sum(agreed)} of {len(agreed)} agree")
    return int(not all(agreed))


def main():
    """Compare the files that the command line names; return 1 if one disagrees."""
    given = sys.argv[1:]
    if given:
        Path(given[0]).mkdir(parents=True, exist_ok=True)
        return compare(Path(given[0]), *given[1:])
    with tempfile.TemporaryDirectory() as made:
        return compare(Path(made))


if __name__ == "__main__":
    sys.exit(main())
