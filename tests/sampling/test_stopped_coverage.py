"""Coverage of the intervals with which sampling stops, over simulated conditions of known truth.

Each repetition is a condition of a pipeline, and the rule itself decides wave by wave which of them
need more trials. Of a coverage of 0.95 a test fails with a probability below 1e-6.
"""

import numpy as np
import pytest
from scipy import stats

from support.searches import flags_of, needed_by
from sweep.analysis.dataset import Poses
from sweep.analysis.estimator import LEVEL, Columns, Design
from sweep.analysis.requirements import wanted_precisions
from sweep.experiment.pipeline import Pipeline
from sweep.measure.flags import DetectionStatus, Flipped
from sweep.sampling.rules import make_rule

REPETITIONS = 2000
FEWEST = int(stats.binom.ppf(1e-6, REPETITIONS, 0.95))
"""Intervals that hold the truth, below which a coverage of 0.95 is refuted."""


def poses(found, error=0.0, flipped=False, axis=2):
    """Return the variables of poses, errors (radians and metres) along one axis of those found."""
    errors = np.zeros((*found.shape, 3))
    errors[..., axis] = error
    errors[~found] = np.nan
    flags = flags_of(np.where(found, DetectionStatus.detected, DetectionStatus.no_candidate))
    flags["flipped"][found & flipped] = Flipped.flipped
    return {**flags, "rotation_error_rad": errors, "translation_error_m": errors}


def depths(sample):
    """Return what draws errors of the depth in percent, all poses being solved."""
    return lambda rng, shape: poses(np.ones(shape, bool), sample(rng, shape) / 100)


def flipping(rate):
    """Return what draws rotation errors of 0.5 degrees, flips of 60 degrees among them."""
    def draw(rng, shape):
        flips = rng.random(shape) < rate
        errors = np.radians(np.where(flips, 60.0, 0.5 * rng.normal(size=shape)))
        return poses(np.ones(shape, bool), errors, flips, 0)
    return draw


def normal(mean=0.0, share=0.0, spread=3.0):
    """Return what draws normal numbers, a share of which has another spread."""
    def sample(rng, shape):
        return mean + rng.normal(size=shape) * np.where(rng.random(shape) < share, spread, 1.0)
    return sample


def rms(share, spread=3.0):
    return float(np.sqrt(1.0 + share * (spread**2 - 1.0)))


def intervals(wanted, values):
    """Return low and high ends (groups,) of poses, as they are where sampling stopped."""
    arrays = {key: array[:, None, :, None] for key, array in values.items()}
    columns, table = Columns(arrays, Poses), {}
    for statistic in wanted.what.statistics(LEVEL):
        table |= zip((each.name for each in statistic.outputs()),
                     statistic.arrays(columns, Design(stopped=True)), strict=True)
    return [table[f"{wanted.what.name}_{end}"] for end in ("low", "high")]


STRATA = np.array([0.02, 0.3, 0.9])


def strata(rng, shape):
    """Draw pooled cells of unlike rates: the interval of their rate is a little wide."""
    return poses(rng.random(shape) < STRATA[np.arange(shape[1]) % 3])


CASES = [
    ("detection_rate", STRATA.mean(), 0.05, 900, strata),
    *(case for rate in (0.01, 0.1) for case in (
        ("flip_rate", rate, 0.05, 600, flipping(rate)),
        ("rotation_rmse_deg", float(np.sqrt(rate * 60**2 + (1 - rate) * 0.25)), 0.3, 1000,
         flipping(rate)))),
    ("rotation_rmse_unflipped_deg", 0.5, 0.1, 1000, flipping(0.1)),
    ("range_rmse_percent", 1.0, 0.1, 2000, depths(normal())),
    ("range_rmse_percent", rms(0.03), 0.2, 2000, depths(normal(share=0.03))),
    ("range_bias_percent", 0.5, 0.1, 1500, depths(normal(0.5))),
    ("range_bias_percent", 0.0, 0.2, 1500, depths(normal(share=0.1))),
    *((f"range_{name}_percent", stats.norm.isf((1 - p) / 2), 0.1, 1500, depths(normal()))
      for name, p in (("median", 0.5), ("p95", 0.95), ("p99", 0.99))),
]
"""Quantity, truth, half-width, most trials, and what draws poses."""


@pytest.mark.long
@pytest.mark.parametrize(("name", "truth", "width", "most", "draw"), CASES)
def test_intervals_with_which_sampling_stops_cover_the_truth(
    name, truth, width, most, draw, claim
):
    pipeline = Pipeline.from_text(f"""
        seed = 1
        pose = {{ jitter_px = 0.5, side_px = 30 }}
        axes = {{ azimuth_deg = {{ linspace = [0, 300, {REPETITIONS}] }} }}
        search = {{ precision = {{ {name} = {width} }}, max_trials = {most} }}
    """)
    rule, wanted = make_rule(pipeline), wanted_precisions({name: width})[0][0]
    values = {"true_tvec_m": np.broadcast_to([0.0, 0.0, 1.0], (REPETITIONS, most, 3)),
              **draw(np.random.default_rng(20), (REPETITIONS, most))}
    left, held = np.arange(REPETITIONS), 0
    for end in rule.ends:
        now = {key: array[left, :end] for key, array in values.items()}
        stop = np.ones(len(left), bool) if end == most else ~needed_by(rule, now)
        if stop.any():
            low, high = intervals(wanted, {key: array[stop] for key, array in now.items()})
            held += int(((low <= truth) & (truth <= high)).sum())
        left = left[~stop]
        if not len(left):
            break
    claim("95 % intervals of quantities whose sampling stops", "2,000 simulations each",
          max(0.0, 95 - 100 * held / REPETITIONS), "% below 95 %")
    assert held >= FEWEST
