"""How often a requirement is falsely met, or not met, if the true value is exactly the limit.

2,000 simulations each: configurations of one dataset, which are never pooled. Each test fails by
chance with a probability below 1e-6: counts are compared with the binomial quantile of the rate
that is promised.
"""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.small_datasets import perfect
from sweep.analysis import requirements
from sweep.analysis.requirements import ERROR_PROBABILITY, Decision, check_requirements
from sweep.experiment.sampling import wave_ends
from sweep.measure.flags import EstimateStatus, Flipped

pytestmark = pytest.mark.evidence

SIMULATIONS = 2000


def errors(draw):
    """Return what draws results with errors along x alone, of the position and of the rotation."""
    def results(rng, draws):
        vectors = np.zeros((1, draws, SIMULATIONS, 3))
        vectors[..., 0] = draw(rng, vectors.shape[:-1])
        sizes = {"side_px": 1, "trial": draws, "solver": SIMULATIONS}
        return perfect(rng, sizes, position=vectors, rotation=0.01 * vectors)
    return results


def solved(rate, conditions=1):
    """Return what draws results of which a share is solved."""
    def results(rng, draws):
        drawn = perfect(rng, {"side_px": conditions, "trial": draws, "solver": SIMULATIONS})
        lost = rng.random(drawn["estimate"].shape) >= rate
        for name, value in (("estimate", EstimateStatus.solver_failed),
                            ("flipped", Flipped.no_estimate),
                            ("rotation_error_rad", np.nan), ("translation_error_m", np.nan)):
            drawn[name].values[lost] = value
        return drawn
    return results


def outliers(rng, shape):
    """Draw normal errors of which 1 % make 46 % of the mean square."""
    size = np.sqrt(0.46 / 0.54 * 0.99 / 0.01)
    return rng.normal(size=shape) * np.where(rng.random(shape) < 0.01, size, 1.0)


def around(distribution):
    """Return errors about 0.5, and what is required of them at its limit."""
    return errors(lambda rng, shape: 0.5 + distribution.rvs(size=shape, random_state=rng)), [
        f"x_sd_m <= {distribution.std():.12g}", "x_bias_m <= 0.5", "position_bias_m <= 0.5",
        f"position_rmse_m <= {np.hypot(0.5, distribution.std()):.12g}"]


def at_rmse(limit):
    return [f"position_rmse_m {relation} {limit:.12g}" for relation in ("<=", ">=")]


P95 = np.degrees(0.01 * stats.expon.ppf(0.95))


@pytest.mark.parametrize(("draw", "required", "draws", "chance"), [
    *((solved(rate), [f"solved >= {rate}", f"solved <= {rate}"], draws, 0.025)
      for rate, draws in ((0.9, 20), (0.95, 50), (0.99, 400), (0.995, 1000))),
    *((errors(lambda rng, shape: rng.exponential(size=shape)),
       [f"rotation_p95_deg <= {P95:.12g}"], draws, 0.025) for draws in (80, 1000)),
    *((*around(distribution), draws, ERROR_PROBABILITY) for distribution, draws in (
        (stats.norm(), 50), (stats.laplace(), 100), (stats.uniform(-1, 2), 400))),
    *((errors(draw), at_rmse(limit), draws, ERROR_PROBABILITY) for draws in (50, 400)
      for draw, limit in (
          (lambda rng, shape: rng.standard_t(4, shape), np.sqrt(2.0)),
          (lambda rng, shape: rng.lognormal(0.0, 0.8, shape), np.exp(0.64)),
          (outliers, np.sqrt(0.99 / 0.54)))),
])
def test_what_is_at_the_limit_is_rarely_met(draw, required, draws, chance, claim):
    results = draw(np.random.default_rng(draws), draws)
    for text in required:
        count = int((check_requirements(results, [text])["decision"] == Decision.met).sum())
        claim("requirements whose limit is the true value, falsely decided",
              "2,000 simulated stores; 5 % are allowed", 100 * count / SIMULATIONS, "%")
        assert count <= stats.binom.isf(1e-6, SIMULATIONS, chance)
        assert count < ERROR_PROBABILITY * SIMULATIONS


@pytest.mark.parametrize(("draw", "text"), [
    *((solved(rate), f"solved >= {rate}") for rate in (0.9, 0.99)),
    (errors(lambda rng, shape: rng.exponential(size=shape)), f"rotation_p95_deg <= {P95:.12g}")])
def test_at_no_look_of_a_search_it_is_falsely_decided(draw, text):
    results, ends = draw(np.random.default_rng(5), 600), wave_ends(600, 40)
    required = requirements.parse_requirements(text)
    shares = requirements.search_shares(required, ends, 1)
    looks = xr.concat([requirements.decide(results.isel(trial=slice(end)), required, shares=shares)
                       ["decision"] for end in ends], "look")
    for decision in (Decision.met, Decision.not_met):
        count = int((looks == decision).any("look").sum())
        assert 0 < count <= stats.binom.isf(1e-6, SIMULATIONS, 0.025)
