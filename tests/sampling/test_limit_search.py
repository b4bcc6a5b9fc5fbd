"""The search for a limit: its error by enumeration, its coverage by simulation, its faults."""

import itertools

import numpy as np
import pytest
from scipy import special, stats

from support.searches import searched, true_limits
from sweep.analysis.estimator import looks_factor
from sweep.analysis.requirements import Decision
from sweep.experiment.sampling import wave_ends
from sweep.report.findings import limit_table, limits_as_json
from sweep.sampling.searches import BEYOND, wanted_values

SIDES = np.geomspace(60, 8, 20)


def ever_met(rate, tail, ends):
    """Return the probability that any look says "at least ``rate``" where it is that exactly.

    A look says it of k of n if P(X >= k) is at most ``tail``: Clopper and Pearson's lower end.
    """
    paths, seen, error = np.array([1.0]), 0, 0.0
    for end in ends:
        step = stats.binom.pmf(np.arange(end - seen + 1), end - seen, rate)
        paths, seen = np.convolve(paths, step), end
        least = int(stats.binom.isf(tail, end, rate)) + 1
        error += paths[least:].sum()
        paths[least:] = 0.0
    return error


@pytest.mark.parametrize(("units", "most", "errors", "rates"), [
    ([40], [40, 240, 600], [0.025, 1e-3], [0.5, 0.9]),
    pytest.param([5, 50], [40, 120, 500, 2400], [0.025, 0.025 / 250],
                 [0.01, 0.1, 0.5, 0.8, 0.9, 0.95, 0.99], marks=pytest.mark.long),
])
def test_several_looks_err_no_more_than_one(units, most, errors, rates, claim):
    parts = [1.0, *np.random.default_rng(3).uniform(0.3, 1.0, 3)]  # of the draws, that count
    ratios = []
    for unit, trials, error, rate in itertools.product(units, most, errors, rates):
        ends = wave_ends(trials, unit)
        tail = error / looks_factor(ends, rate, error)
        ratios.append([ever_met(rate, tail, [int(part * end) for end in ends]) / error
                       for part in parts])
    whole, part = np.max(ratios, axis=0)[0], np.max(ratios)
    claim("error of decisions at several waves, of that of one", "exact enumeration", part)
    assert 0.9 < whole <= 1.0
    assert part <= 1.3


def test_values_are_wanted_that_may_move_the_limit():
    rng = np.random.default_rng(5)
    for _ in range(300):
        n = int(rng.integers(1, 12))
        keeps = rng.random(n) < 0.6
        decided = rng.random(n) < 0.5
        judged = rng.random(n) < 0.9
        met, not_met = keeps & decided, ~keeps & decided
        wanted = wanted_values(keeps, met, not_met, judged)
        assert not (wanted & (decided | ~judged)).any()
        at = np.flatnonzero(judged)
        if len(at) and keeps[at[0]]:  # the run begins at the easy end: plain loop over it
            end = next((k for k in at if not_met[k]), n)
            last = max(k for k in at if keeps[k] and k < end)
            beyond = [k for k in at if last < k < end][:BEYOND]
            expected = {k for k in at if (k <= last or k in beyond) and not decided[k]}
            assert set(np.flatnonzero(wanted).tolist()) == expected


@pytest.mark.long
@pytest.mark.parametrize(("rate", "shape"), [
    (0.9, "slow"), (0.9, "dip"), (0.9, "at the limit"), (0.99, "at the limit")])
def test_intervals_cover_the_limit(rate, shape, claim):
    rng = np.random.default_rng(11)
    count = 600
    width = 4.0 if shape == "slow" else 2.0
    curves = 0.9995 * special.expit((SIDES - rng.uniform(14, 30, (count, 1))) / width)
    if shape == "dip":
        curves[np.arange(count), rng.integers(1, 6, count)] *= rng.uniform(0.8, 0.99, count)
    if shape == "at the limit":  # where an error is most likely: the first failing one all but is
        first = (curves < rate).argmax(axis=1)
        curves[np.arange(count), first] = rate - 1e-9
        curves[np.arange(count), np.minimum(first + 1, 19)] = 0.5 * rate
    limits = searched(curves, SIDES, f"detection >= {rate}", 2400, seed=4)
    truth = true_limits(curves, SIDES, rate)
    covered = int(((limits["low"] <= truth) & (truth <= limits["high"])).sum())
    claim("95 % intervals of limits that are searched for", "600 simulated searches each",
          max(0.0, 95 - 100 * covered / count), "% below 95 %")
    assert covered / count >= 0.95
    assert float(limits["poses"].mean()) < len(SIDES) * 2400 / 3


def test_a_limit_that_is_not_decided_is_never_told_as_met():
    rng = np.random.default_rng(4)
    told = {False: 0, True: 0}
    for curve in rng.uniform(0.8, 1.0, (4, 1, 1)) * special.expit((SIDES - 12.0) / 2):
        limits = searched(curve, SIDES, "detection >= 0.9", 80, seed=6)
        (listed,) = limits_as_json(limits)["limits"]
        (row,) = limit_table(limits).shown_rows
        decision = limits["decision"].isel(tilt_deg=0)
        met = {name: isinstance(listed[name], float) and bool(
            (decision[listed[name] <= SIDES] == Decision.met).all())
            for name in ("value", "met_to")}
        told[met["value"]] += 1
        assert met["value"] or "not decided" in row[1] or listed["decided"]
        assert met["met_to"] or not isinstance(listed["met_to"], float)
    assert told[False]
