"""Whether intervals hold the truth as often as they say, by simulation.

In simulations each repetition is a regime, a dimension that is kept: one call gives the intervals
of all. Statistical assertions fail with a probability below 1e-6 where the coverage is within its
limits; they print their figures.
"""

import math

import numpy as np
import pytest
from scipy import stats

from support.lengths import lengths
from support.small_datasets import holm, perfect, with_detected
from sweep.analysis import compare, error_statistics, marker_ranking, requirement_limits
from sweep.measure.flags import Flipped


def simulated(rng, sizes, vectors):
    """Return a dataset of regimes; rotation in 0.01 rad, z in percent of 1 m, x and y in cm."""
    results = perfect(rng, sizes, rotation=0.01 * vectors, position=0.01 * vectors)
    results["true_tvec_m"].values[...] = 1.0
    return results


TAILS = {
    "normal": (lambda rng, shape: rng.normal(size=shape), 1.0),
    "uniform": (lambda rng, shape: rng.uniform(-1, 1, shape), 1 / 3),
    "t4": (lambda rng, shape: rng.standard_t(4, shape), 2.0),
}
SCALES = {"rotation": ("deg", math.degrees(0.01)), "range": ("percent", 1.0),
          "position": ("m", 0.01)}


@lengths(300, 10_000)
@pytest.mark.parametrize(("tails", "cells", "trials"), [
    ("normal", 1, 50), ("normal", 25, 2), ("uniform", 5, 10), ("t4", 1, 50)])
def test_bias_spread_and_rmse_are_covered(tails, cells, trials, count, covered):
    # Chance of a false alarm: below 1e-6 for each, for coverages of a mean within 0.93 ... 0.97, of
    # what is of squares within 0.94 ... 0.995 (the largest of a cell's two draws says much of it),
    # and of the length of a mean vector within 0.95 ... 0.995, which is wide by design.
    rng = np.random.default_rng([21, cells])
    draw, variance = TAILS[tails]
    offsets = np.zeros((cells, 1, 3))  # the cells differ, as on a grid
    offsets[:, 0] = [2.0, 0.0, 0.5]
    offsets[:, 0, 2] += np.linspace(-1, 1, cells) if cells > 1 else 0.0
    vectors = draw(rng, (count, cells, trials, 3)) + offsets
    results = simulated(rng, {"regime": count, "marker_id": cells, "trial": trials}, vectors)
    answer = error_statistics(results, ["regime"]).compute()
    mean, between = offsets.mean(axis=(0, 1)), offsets[..., 2].var()
    for name, (unit, scale) in SCALES.items():
        parts = slice(2, 3) if name == "range" else slice(None)
        components = 1 if name == "range" else 3
        square = components * variance + between
        truth = {
            "bias": mean[2] if name == "range" else np.linalg.norm(mean),
            "sd": math.sqrt(square), "rmse": math.sqrt(square + (mean[parts] ** 2).sum()),
        }
        truth["rmse_unflipped"] = truth["rmse"]
        for statistic, value in truth.items():
            limits = (0.93, 0.97) if statistic == "bias" else (0.94, 0.995)
            if statistic == "bias" and name != "range":
                limits = (0.95, 0.995)
            elif (statistic, name) == ("rmse", "rotation"):  # which counts flips that are not there
                limits = (0.95, 1.0)
            label = f"{name}_{statistic}_{unit}"
            covered(answer, label, scale * value, *limits)


@pytest.mark.evidence
@pytest.mark.parametrize("alike", [0.1, 0.4, 0.7])
@pytest.mark.parametrize(("photographs", "markers"), [(13, 24), (54, 17)])
def test_errors_of_photographs_are_covered(photographs, markers, alike, covered):
    # Errors of a photograph's markers have the intraclass correlation `alike`. Chance of a false
    # alarm below 1e-6, for coverages within 0.93 ... 0.985.
    count, rng = 2000, np.random.default_rng([29, photographs])
    sizes = {"regime": count, "marker_id": markers, "trial": photographs}
    together, alone = (rng.normal(size=(count, some, photographs, 3)) for some in (1, markers))
    vectors = 0.5 + math.sqrt(alike) * together + math.sqrt(1 - alike) * alone
    results = simulated(rng, sizes, vectors).assign_coords(photographs="photographs.npz")
    answer = error_statistics(results, ["regime"]).compute()
    for label, truth in (("range_bias_percent", 0.5), ("range_sd_percent", 1.0),
                         ("range_rmse_percent", math.sqrt(1.25)), ("position_sd_m", 0.01 * 3**0.5),
                         ("position_rmse_m", 0.01 * math.sqrt(3.75))):
        covered(answer, label, truth, 0.93, 0.985)


@lengths(1000, 10_000)
@pytest.mark.parametrize(("share", "trials"), [(0.02, 50), (0.01, 200)])
def test_rmse_of_rare_flips_is_covered(share, trials, count, covered):
    # Flips of 60 degrees about any axis among errors of half a degree. Chance of a false alarm
    # below 1e-6, for coverages above 0.93; 50 of 2 % are covered with 0.64 if what is not in the
    # sample does not count.
    rng = np.random.default_rng([27, trials])
    sizes = {"regime": count, "marker_id": 1, "trial": trials}
    directions = rng.normal(size=(*sizes.values(), 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    flipped = rng.random(tuple(sizes.values())) < share
    errors = rng.normal(size=(*sizes.values(), 3)) * 0.5 / math.sqrt(3)
    degrees = np.where(flipped[..., None], 60 * directions, errors)
    results = perfect(rng, sizes, rotation=np.radians(degrees), position=0.01 * errors)
    results["flipped"] = results["flipped"].copy(data=np.where(
        flipped, Flipped.flipped, Flipped.not_flipped).reshape(results["flipped"].shape))
    answer = error_statistics(results, ["regime"]).compute()
    truth = math.sqrt((1 - share) * 0.25 + share * 3600)
    covered(answer, "rotation_rmse_deg", truth, 0.93, 1.0)
    # What flips do not touch.
    for name, value in (("rotation_rmse_unflipped_deg", 0.5), ("rotation_sd_deg", 0.5)):
        covered(answer, name, value, 0.93, 0.99)
    squares = stats.chi2(3)
    median = math.sqrt(squares.ppf(0.5 / (1 - share)) / 12)
    covered(answer, "rotation_median_deg", median, 0.93, 0.99)


@lengths(300, 10_000)
@pytest.mark.parametrize(("first", "second", "cells", "trials"), [
    (0.5, 0.5, 5, 20), (0.8, 0.9, 1, 50), (0.97, 0.9, 1, 50)])
def test_differences_of_paired_rates_are_covered(first, second, cells, trials, count, covered):
    # Chance of a false alarm below 1e-6, for coverages within 0.93 ... 0.975; method 10 covers more
    # where 50 draws have rates near 1: exactly (by the reference, over all tables) 0.983.
    rng = np.random.default_rng([23, cells, int(100 * first)])
    sizes = {"regime": count, "marker_id": cells, "trial": trials}
    shape = tuple(sizes.values())
    common = rng.random(shape)
    own = np.where(rng.random(shape) < 0.5, common, rng.random(shape))  # half of them alike
    results = perfect(rng, sizes)
    answer = compare(with_detected(results, common < first), with_detected(results, own < second),
                   ["regime"]).compute()
    covered(answer, "detection_difference", second - first, 0.93,
            0.99 if (cells, first) == (1, 0.97) else 0.975)
    if first == second:
        false_alarms = int((answer["detection_p_value"] < 0.05).sum())
        assert stats.binom.sf(false_alarms - 1, count, 0.05) > 1e-6


@lengths(300, 10_000)
@pytest.mark.parametrize(("cells", "trials"), [(1, 50), (25, 2)])
def test_differences_and_ratios_of_paired_errors_are_covered(cells, trials, count, covered):
    # Chance of a false alarm below 1e-6, for coverages within 0.93 ... 0.97.
    rng = np.random.default_rng([24, cells])
    sizes = {"regime": count, "marker_id": cells, "trial": trials}
    shared, *own = rng.normal(size=(3, *sizes.values()))
    widths = np.linspace(1, 1.5, cells)[:, None]
    deviations = {"first": 1.0, "second": 0.7}
    sides = []
    for scale, alone in zip(deviations.values(), own, strict=True):
        vectors = np.zeros((*sizes.values(), 3))
        vectors[..., 2] = scale * widths * (0.8 * shared + 0.6 * alone)  # correlated by 0.64
        sides.append(simulated(rng, sizes, vectors))
    answer = compare(*sides, ["regime"]).compute()
    mean_size = math.sqrt(2 / math.pi) * widths.mean()
    for name, (unit, scale) in SCALES.items():
        covered(answer, f"{name}_difference_{unit}", scale * (0.7 - 1.0) * mean_size)
        covered(answer, f"{name}_rmse_ratio", 0.7)


@lengths(60, 1000)
@pytest.mark.parametrize(("rates", "cells", "trials"), [
    ([0.3, 0.7, 0.9, 0.93, 0.96, 0.99], 1, 50),   # at the rate
    ([0.5, 0.8, 0.89, 0.92, 0.95, 0.97], 4, 25),  # just below it
    ([0.2, 0.95, 0.85, 0.95, 0.99, 1.0], 1, 50),  # a dip
    ([0.1, 0.2, 0.4, 0.6, 0.8, 0.85], 1, 50),     # never
    ([0.92, 0.95, 0.97, 0.99, 1.0, 1.0], 4, 25),  # always
])
def test_limits_of_detection_are_covered_at_least_as_often_as_they_say(
    rates, cells, trials, count, covered
):
    # Chance of a false alarm below 1e-6, for coverages within 0.95 ... 1.
    rng = np.random.default_rng([25, cells])
    sizes = {"regime": count, "marker_id": cells, "side_px": 6, "trial": trials}
    rates = np.array(rates)
    results = perfect(rng, sizes)
    sides = results["side_px"].values
    results = with_detected(results, rng.random(tuple(sizes.values())) < rates[:, None])
    answer = requirement_limits(results, ["detection >= 0.9"], "side_px", per=["regime"])
    good = np.minimum.accumulate((rates >= 0.9)[::-1])[::-1]
    truth = sides[good][0] if good.any() else math.inf  # beyond the grid
    covered(answer.rename(low="side_px_low", high="side_px_high"), "side_px", truth, 0.95, 1.0)


@lengths(60, 2000)
@pytest.mark.parametrize(("ids", "rate"), [(10, 0.5), (50, 0.95), (10, 0.999)])
def test_alike_ids_are_called_weak_in_five_per_cent_of_the_tables_at_most(ids, rate, count):
    # Chance of a false alarm below 1e-6: a table has a weak ID with a chance of 5 % at most.
    rng = np.random.default_rng([26, ids, int(1000 * rate)])
    odds = rate / (1 - rate) * np.array([2.0, 1.0, 0.5])  # the three cells differ
    sizes = {"regime": count, "marker_id": ids, "tilt_deg": 3, "trial": 20}
    hits = rng.random(tuple(sizes.values())) < (odds / (1 + odds))[:, None]
    answer = marker_ranking(with_detected(perfect(rng, sizes), hits), ["regime"]).compute()
    p_values = answer["p_value"].transpose("regime", "marker_id").fillna(1.0).values
    below = (answer["detection_rate"] < answer["expected_rate"]).transpose("regime", "marker_id")
    adjusted = np.array([holm(row.tolist()) for row in p_values])
    any_odd = int((adjusted < 0.05).any(axis=1).sum())
    any_weak = int(((adjusted < 0.05) & below.values).any(axis=1).sum())

    assert stats.binom.sf(any_weak - 1, count, 0.05) > 1e-6
    assert stats.binom.sf(any_odd - 1, count, 0.05) > 1e-6
