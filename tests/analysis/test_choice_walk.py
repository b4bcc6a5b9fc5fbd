"""The search for the smallest choice is right as often as it says, on curves with dips."""

import numpy as np
import pytest
from scipy import stats

from sweep.analysis import requirements
from sweep.analysis.requirements import Decision, combined_decision, course, needed
from sweep.experiment.sampling import wave_ends

ENDS = wave_ends(5000, 50)


def decided(hits, n, limit, shares):
    """Return decisions on ``rate >= limit`` by Clopper and Pearson's ends, from SciPy."""
    tails = 0.025 * shares.met, 0.025 * shares.not_met
    low = np.where(hits > 0, stats.beta.ppf(tails[0], hits, n - hits + 1), 0.0)
    high = np.where(hits < n, stats.beta.isf(tails[1], hits + 1, n - hits), 1.0)
    out = np.full(hits.shape, Decision.undecided, np.uint8)
    out[low >= limit] = Decision.met
    out[high < limit] = Decision.not_met
    return out


def search(rates, limit, generator):
    """Return decisions, whether estimates keep the limit, and trials of a search (A, V, C)."""
    alternatives, values, conditions = rates.shape
    required = requirements.parse_requirements(f"detection >= {limit}")
    shares, = requirements.search_shares(required, ENDS, values * conditions, alternatives)
    n = np.zeros(rates.shape, int)
    hits = np.zeros(rates.shape, int)
    asked = np.ones(rates.shape, bool)
    for before, end in zip((0, *ENDS), ENDS, strict=False):
        n = n + (end - before) * asked
        hits = hits + np.where(asked, generator.binomial(end - before, rates), 0)
        decision = decided(hits, n, limit, shares)
        keeps = hits >= limit * n
        asked = np.stack([needed(*each) for each in zip(decision, keeps, strict=True)])
        if not asked.any():
            break
    return decision, keeps, n


def curve(generator, values, limit):
    """Return rates from the largest size down, with a dip to just below the limit."""
    steepness, middle = generator.uniform(0.5, 4.0), generator.uniform(0.3, 0.9) * values
    rate = 1.0 / (1.0 + np.exp((np.arange(values) - middle) / steepness))
    dip = int(generator.integers(0, values))
    rate[dip] = min(rate[dip], limit - generator.choice([0.001, 0.01, 0.05]))
    return rate


@pytest.mark.parametrize(("limit", "alternatives", "searches"), [
    (0.9, 2, 40), *(pytest.param(*case, 1000, marks=pytest.mark.evidence)
                    for case in ((0.9, 4), (0.99, 2)))])
def test_an_answer_truly_fails_in_at_most_one_of_twenty_searches(
    limit, alternatives, searches, claim
):
    """With an error of 0.05, 1,000 searches have more than 89 wrong ones with p < 1e-7.

    Of the 40 of the default run 14 are allowed (p < 1e-8).
    """
    generator = np.random.default_rng(20)
    allowed = int(stats.binom.isf(1e-7, searches, 0.05))
    wrong = falsely_failing = 0
    trials, hardest = 0, 0
    for _ in range(searches):
        rates = np.array([[curve(generator, 12, limit) for _ in range(3)]
                          for _ in range(alternatives)]).transpose(0, 2, 1)
        decision, keeps, n = search(rates, limit, generator)
        truly = (rates >= limit).all(axis=-1)
        courses = [course(*each) for each in zip(decision, keeps, strict=True)]
        wrong += any(not truth[: found.met + 1].all()
                     for truth, found in zip(truly, courses, strict=True))
        failing = combined_decision(decision, -1) == Decision.not_met
        falsely_failing += bool((truly & failing).any())
        trials, hardest = trials + n.sum(), hardest + n.max() * n.size
    assert max(wrong, falsely_failing) <= allowed
    assert trials < hardest / 2

    claim("answers of searches that truly fail", "1,000 simulated searches; 5 % are allowed",
          100 * wrong / searches, "%")


MET, FAILED, OPEN, NONE = (
    Decision.met, Decision.not_met, Decision.undecided, Decision.not_applicable)


def column(*decisions):
    return np.array([[each] if np.ndim(each) == 0 else each for each in decisions], np.uint8)


@pytest.mark.parametrize(("decisions", "failing", "wanted"), [
    # What lies beyond a failure needs nothing.
    ([[OPEN], [FAILED], [OPEN]], (), [[True], [False], [False]]),
    # Of what seems to fail only that condition is needed.
    ([[OPEN, MET], [OPEN, OPEN], [OPEN, OPEN]], (1, 1),
     [[True, False], [False, True], [False, False]]),
    # A condition that fails spares the others.
    ([[FAILED, OPEN, OPEN]], (), [[False, False, False]]),
])
def test_only_what_may_move_the_answer_is_needed(decisions, failing, wanted):
    keeps = np.ones(np.shape(decisions), bool)
    if failing:
        keeps[failing] = False
    assert needed(column(*decisions), keeps).tolist() == wanted


def test_what_cannot_be_judged_is_left_out():
    """Of conditions, and of values: sizes that do not fit into the image end no search."""
    decision = column([NONE, NONE], [MET, NONE], [NONE, NONE], [MET, MET], [OPEN, NONE])
    assert combined_decision(decision, -1).tolist() == [NONE, MET, NONE, MET, OPEN]
    keeps = decision == MET
    assert (course(decision, keeps).met, course(decision, keeps).unmet) == (3, 4)
    assert needed(decision, keeps).nonzero()[0].tolist() == [4]
    nothing = column([NONE], [NONE])
    assert course(nothing, nothing == MET)[::3] == (-1, 2)
