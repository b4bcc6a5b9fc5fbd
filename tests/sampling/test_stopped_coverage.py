"""Coverage of the intervals with which sampling stops, over simulated conditions of known truth.

Each repetition is a condition of a pipeline, and the rule itself decides wave by wave which of them
need more trials. Of a coverage of 0.95 a test fails with a probability below 1e-6.
"""

import numpy as np
import pytest
from scipy import optimize, stats

from sweep.analysis.estimator import Columns, Design
from sweep.analysis.intervals import LEVEL
from sweep.analysis.poses import Poses
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.sampling.rules import GroupResults, make_rule

REPETITIONS = 2000
FEWEST = int(stats.binom.ppf(1e-6, REPETITIONS, 0.95))
"""Intervals that hold the truth, below which a coverage of 0.95 is refuted."""


def pipeline_of(name, width, most, repetitions):
    """Return a pipeline with a condition for each repetition."""
    return Pipeline.from_text(f"""
        seed = 1
        pose = {{ jitter_px = 0.5, side_px = 30 }}
        axes = {{ azimuth_deg = {{ linspace = [0, 300, {repetitions}] }} }}
        search = {{ precision = {{ {name} = {width} }}, max_trials = {most} }}
    """, name="simulated")


def simulated(name, truth, width, most, draw, repetitions=REPETITIONS):
    """Return coverage, mean relative deviation in half-widths, and mean number of trials."""
    pipeline = pipeline_of(name, width, most, repetitions)
    rule = make_rule(pipeline)
    left = np.arange(repetitions)
    values = {"true_tvec_m": np.broadcast_to([0.0, 0.0, 1.0], (repetitions, most, 3)),
              **draw(np.random.default_rng(20), (repetitions, most))}
    held, deviations, used = 0, [], []
    for wave, end in enumerate(rule.ends, 1):
        now = {key: array[left, :end] for key, array in values.items()}
        results = GroupResults(pipeline, (0,), (len(left),), wave, end, now)
        stop = (np.ones(len(left), bool) if end == most else ~rule.needed(results))
        held_now, deviation = of_stopped(
            rule.wanted[0], {key: array[stop] for key, array in now.items()}, truth, width)
        held += held_now
        deviations.append(deviation)
        used.append(np.full(stop.sum(), end))
        left = left[~stop]
        if not len(left):
            break
    return held / repetitions, float(np.nanmean(np.concatenate(deviations))), np.concatenate(
        used).mean()


def evaluate(statistics, arrays):
    """Return the variables (groups,) of poses, as they are where sampling was stopped."""
    columns = Columns(arrays, Poses)
    return {name: values for statistic in statistics
            for name, values in statistic.variables(columns, Design(stopped=True)).items()}


def of_stopped(wanted, values, truth, width):
    """Return how many intervals of conditions hold the truth, and how far their values lie off."""
    if not len(values["detection"]):
        return 0, np.zeros(0)
    arrays = {key: array[:, None, :, None] for key, array in values.items()}
    arrays["true_depth_m"] = arrays["true_tvec_m"][..., 2]
    table = evaluate(wanted.requirable.computed("", LEVEL), arrays)
    value, low, high = (table[f"{wanted.name}{end}"] for end in ("", "_low", "_high"))
    scale = 1.0 if wanted.requirable.is_rate else abs(truth) or 1.0
    return int(((low <= truth) & (truth <= high)).sum()), (value - truth) / scale / width


def detections(rate):
    def draw(rng, shape):
        flags = np.where(rng.random(shape) < rate, DetectionStatus.detected,
                         DetectionStatus.no_candidate).astype(np.uint8)
        return {"detection": flags, **poses_of(flags == 1, np.zeros((*shape, 3)))}
    return draw


def poses_of(solved, error, flipped=False):
    """Return the variables of solved poses with errors (..., 3), in radians and metres."""
    error = np.where(solved[..., None], error, np.nan)
    return {
        "detection": np.where(solved, DetectionStatus.detected,
                              DetectionStatus.no_candidate).astype(np.uint8),
        "estimate": np.where(solved, EstimateStatus.solved,
                             EstimateStatus.no_detection).astype(np.uint8),
        "flipped": np.where(~solved, Flipped.no_estimate, np.where(
            flipped, Flipped.flipped, Flipped.not_flipped)).astype(np.uint8),
        "rotation_error_rad": error, "translation_error_m": error,
    }


def depth_errors(sample):
    """Return what draws errors of the depth in percent, all poses being solved."""
    def draw(rng, shape):
        error = np.zeros((*shape, 3))
        error[..., 2] = sample(rng, shape) / 100
        return poses_of(np.ones(shape, bool), error)
    return draw


def flipping(rate):
    """Return what draws rotation errors of 0.5 degrees, flips of 60 degrees among them."""
    def draw(rng, shape):
        flips = rng.random(shape) < rate
        error = np.zeros((*shape, 3))
        error[..., 0] = np.radians(np.where(flips, 60.0, 0.5 * rng.normal(size=shape)))
        return poses_of(np.ones(shape, bool), error, flips)
    return draw


def normal(rng, shape):
    return rng.normal(size=shape)


def biased(rng, shape):
    return 0.5 + rng.normal(size=shape)


def laplace(rng, shape):
    return rng.laplace(size=shape)


def outliers(share, spread):
    """Return what draws normal errors, a share of which has another spread."""
    def sample(rng, shape):
        return rng.normal(size=shape) * np.where(rng.random(shape) < share, spread, 1.0)
    return sample


def rms(share, spread):
    return float(np.sqrt(1.0 + share * (spread**2 - 1.0)))


def quantile(share, spread, p):
    """Return the quantile of the absolute errors of `outliers`."""
    return optimize.brentq(lambda x: (1 - share) * (2 * stats.norm.cdf(x) - 1)
                           + share * (2 * stats.norm.cdf(x / spread) - 1) - p, 0.0, 100.0)


def check(result, label):
    coverage, bias, trials = result
    print(f"{label}: coverage {coverage:.4f}, bias {bias:+.3f} half-widths, {trials:.0f} trials")
    assert coverage * REPETITIONS >= FEWEST


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.0, 0.001, 0.01, 0.1, 0.5, 0.9, 0.99, 1.0])
def test_rates_are_covered(rate):
    check(simulated("detection_rate", rate, 0.04, 800, detections(rate)), f"rate {rate}")


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.001, 0.01, 0.1])
def test_flip_rates_and_rotations_with_flips_are_covered(rate):
    check(simulated("flip_rate", rate, 0.05, 600, flipping(rate)), f"flips {rate}")
    truth = float(np.sqrt(rate * 60**2 + (1 - rate) * 0.25))
    check(simulated("rotation_rmse_deg", truth, 0.3, 1000, flipping(rate)), f"rmse, flips {rate}")
    check(simulated("rotation_rmse_unflipped_deg", 0.5, 0.1, 1000, flipping(rate)),
          f"unflipped, flips {rate}")


@pytest.mark.long
@pytest.mark.parametrize("width", [0.05, 0.1, 0.2])
@pytest.mark.parametrize(("label", "sample", "truth"), [
    ("normal", normal, 1.0), ("Laplace", laplace, np.sqrt(2.0)),
    ("10 % of 3", outliers(0.1, 3), rms(0.1, 3)), ("3 % of 3", outliers(0.03, 3), rms(0.03, 3)),
])
def test_root_mean_squares_are_covered(label, sample, truth, width):
    most = 3000 if width == 0.05 else 2000
    check(simulated("range_rmse_percent", truth, width, most, depth_errors(sample)),
          f"rmse {label} {width}")


@pytest.mark.long
@pytest.mark.parametrize("width", [0.05, 0.1, 0.2])
@pytest.mark.parametrize(("label", "sample", "truth"), [
    ("normal", normal, 0.0), ("biased", biased, 0.5), ("10 % of 3", outliers(0.1, 3), 0.0)])
def test_biases_are_covered(label, sample, truth, width):
    check(simulated("range_bias_percent", truth, width, 1500, depth_errors(sample)),
          f"bias {label} {width}")


@pytest.mark.long
@pytest.mark.parametrize("width", [0.1, 0.2])
@pytest.mark.parametrize(("name", "p"), [("median", 0.5), ("p95", 0.95), ("p99", 0.99)])
@pytest.mark.parametrize("share", [0.0, 0.1])
def test_quantiles_are_covered(name, p, share, width):
    check(simulated(f"range_{name}_percent", quantile(share, 3, p), width, 1500,
                    depth_errors(outliers(share, 3))), f"{name} {share} {width}")


@pytest.mark.long
def test_strata_are_covered_more():
    """Pooled cells of unlike rates: the interval of their rate is a little wide."""
    rates = np.array([0.02, 0.3, 0.9])

    def draw(rng, shape):
        flags = detections(rates[np.arange(shape[1]) % 3])(rng, shape)
        return {name: values[:, : shape[1]] for name, values in flags.items()}

    check(simulated("detection_rate", rates.mean(), 0.05, 900, draw), "strata")
