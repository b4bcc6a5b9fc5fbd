"""How often 95 % intervals hold the truth, for all tests of analyses."""

import pytest
from scipy import stats

WHAT = "95 % intervals of bias, spread, RMSE, quantiles, rates, differences, limits"


@pytest.fixture
def covered(claim):
    """Fail a coverage within limits with a probability below 1e-6, and record what it lacks."""
    def check(table, name, truth, least=0.93, most=0.97):
        held = (table[f"{name}_low"] <= truth) & (truth <= table[f"{name}_high"])
        count, n = int(held.sum()), held.size
        print(f"{name}: {count / n:.4f} of {n}")
        assert stats.binom.cdf(count, n, least) > 5e-7, name
        assert stats.binom.sf(count - 1, n, most) > 5e-7, name
        claim(WHAT, "simulations, 50 to 400 draws each", max(0.0, 95 - 100 * count / n),
              "% below 95 %")

    return check
