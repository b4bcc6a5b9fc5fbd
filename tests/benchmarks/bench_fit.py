"""How often intervals of `sweep fit` hold the truth, and how often it finds what is not there.

    python -m tests.benchmarks fit [repetitions] [photographs] [first seed]

Photographs are rendered with known effects, first with all of them, then with blur and white noise
alone. An interval of 95 % should hold the truth in 93-97 % of 200 repetitions; effects that are
absent should be found in 5 % at most.
"""

import contextlib
import io
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.fitted_photographs import EFFECTS, PLAIN, TRUTH, fitted, terms_of

ABSENT = ("sharpening", "bloom", "geometry_px", "edge_px", "marker_scale")


def repeated(effects, repetitions, photographs, first):
    """Yield the terms of repetitions by parameter, noise on black and on white apart."""
    for seed in range(first, first + repetitions):
        with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stderr(io.StringIO()):
            found = fitted(Path(folder), effects, seed, photographs, 6)
        terms = terms_of(found)
        yield terms | {each.name: each for each in found.found.terms if "noise on" in each.name}


def cover(repetitions=200, photographs=8, first=1000):
    truth = {name: value for name, value in TRUTH.items() if name != "background"}
    truth |= {"noise on black": 2.0, "noise on white": 2.0}
    held, values = defaultdict(int), defaultdict(list)
    for count, terms in enumerate(repeated(EFFECTS, repetitions, photographs, first), 1):
        for name, value in truth.items():
            one = terms[name].estimate
            held[name] += terms[name].kept and one.low <= value <= one.high
            values[name].append((one.value, one.high - one.low))
        if count % 20 == 0 or count == repetitions:
            print(f"{count} repetitions of {photographs} photographs with all effects", flush=True)
            for name, value in truth.items():
                mean, width = np.mean(values[name], axis=0)
                spread = np.std([each for each, _ in values[name]])
                print(f"  {name:24} truth {value:8.4g}  mean {mean:8.4g} ± {spread:.2g}  "
                      f"half-width {width / 2:.2g}  held {held[name] / count:.3f}", flush=True)
    alarms = defaultdict(int)
    for count, terms in enumerate(repeated(PLAIN, repetitions, photographs, first), 1):
        for name in ABSENT:
            alarms[name] += terms[name].kept
        if count % 20 == 0 or count == repetitions:
            print(f"{count} repetitions with blur and white noise alone: found "
                  + ", ".join(f"{name} {alarms[name] / count:.3f}" for name in ABSENT), flush=True)


def main():
    """Run with the numbers of the command line."""
    cover(*map(int, sys.argv[1:]))


if __name__ == "__main__":
    main()
