"""What accuracy costs: front, advice, tables, figure; equal configurations, rarely told apart."""

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from scipy.stats import binom

from support.pose_errors import poses_with_law, power_law
from sweep.measure.flags import EstimateStatus
from sweep.report.figure import panels_file
from sweep.report.findings import headlines, trade_figure, tradeoff_table
from sweep.report.report_data import differences_of, draws_to_decide, more_draws, overall
from sweep.report.table import MAX_WIDTH
from sweep.tradeoff.pareto import UNITS, mark_front, pareto_front
from sweep.tradeoff.verdicts import BETTER, NOT_DECIDED, WORSE

P95 = "rotation_p95_deg"
TREATMENTS = [" \u00b7 ".join(pair) for pair in itertools.product(
    ("none", "subpix", "contour", "apriltag"), ("ippe_square", "ippe", "iterative", "sqpnp"))]


def synthetic(sides=(20, 50, 150), treatments=16):
    """Return a `trade` of drawn costs and errors, by side_px, with all that may be in it."""
    rng = np.random.default_rng(5)
    dims, shape = ("side_px", "treatment"), (len(sides), treatments)
    trade = {"looked_for": (dims, np.full(shape, 4000)), "nees_count": (dims, np.full(shape, 3900)),
             "covariance_trusted": (dims, rng.random(shape) < 0.7),
             "covariance_coverage": ((*dims, "level"), rng.random((*shape, 3))),
             "nees_mean": (dims, 6 * rng.random(shape))}
    errors = [f"{quantity}_{name}_{unit}" for quantity, unit in UNITS.items()
              for name in ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99")]
    for name in ("cost_ms", "cost_ratio", "detection_ms", "estimation_ms", "detection_rate",
                 "solved_rate", "flip_rate", *errors):
        values = rng.random(shape) + 1e-3
        for end, factor in (("", 1.0), ("_low", 0.9), ("_high", 1.1)):
            trade[f"{name}{end}"] = dims, factor * values
    return xr.Dataset(
        trade, {"side_px": list(sides), "treatment": TREATMENTS[:treatments],
                "level": [0.5, 0.9, 0.99]},
        {"title": "What accuracy costs", "poses": 4000, "window": "auto", "criterion": P95,
         "baseline": TREATMENTS[0]})


# Few different values, so that ties are common.
VALUES = st.sampled_from([0.1, 0.12, 0.25, 0.5, 1.0, 2.0, 3.0, np.inf, np.nan]) | st.floats(
    1e-3, 1e3
)
POINTS = st.lists(st.tuples(VALUES, VALUES), min_size=1, max_size=12)


@given(POINTS)
def test_the_front_is_what_no_other_point_beats(points):
    def beats(a, b):
        return all(np.isfinite(a)) and a[0] <= b[0] and a[1] <= b[1] and a != b

    expected = [
        all(np.isfinite(one)) and not any(beats(other, one) for other in points) for one in points
    ]
    assert pareto_front(*zip(*points, strict=True)).tolist() == expected


def spoilt():
    """Return a `trade` whose criterion is infinite or NaN throughout the first regime."""
    trade = synthetic([20, 50], treatments=8)
    for end in ("", "_low", "_high"):
        trade[f"{P95}{end}"][0] = np.inf
        trade[f"{P95}{end}"][0, ::2] = np.nan
    return trade


def bare():
    """Return a `trade` without what may be absent, and without intervals."""
    trade = synthetic().isel(side_px=1)
    for name in trade.data_vars:
        if name.endswith(("_low", "_high")):
            trade[name] = trade[name] * np.nan
    return trade.drop_vars([
        "nees_mean", "nees_count", "covariance_trusted", "covariance_coverage", "level"])


@pytest.mark.parametrize(("trade", "conditions"), [
    (synthetic(), 3), (synthetic([20], treatments=1), 1), (spoilt(), 1), (bare(), 1)],
    ids=["three regimes", "one treatment", "spoilt", "bare"])
def test_tables_and_figures_have_every_treatment_of_every_condition(trade, conditions):
    table = tradeoff_table(trade, P95)
    text = table.text()
    assert max(map(len, text.splitlines())) <= MAX_WIDTH
    assert len(table.frame) == trade.sizes.get("side_px", 1) * trade.sizes["treatment"]
    assert table.frame["on the front"].sum() == mark_front(trade, P95).on_front.sum()
    assert ("side of the marker" in table.frame) == (trade["cost_ms"].ndim > 1)
    assert "nan" not in text + table.markdown() + "".join(headlines(trade, P95))
    figure = trade_figure(trade, P95)
    assert len(figure.panels) == conditions
    front = mark_front(trade, P95)
    for k, panel in enumerate(figure.panels):
        axes = Figure().add_subplot()
        panel.draw(axes)
        part = front.isel(side_px=k) if "side_px" in front.dims else front
        named = {text.get_text() for text in axes.texts}
        assert set(part["treatment"].values[part["on_front"].values]) <= named
        assert named <= set(part["treatment"].values)
    assert panels_file(figure.panels[:1], ".svg").startswith(b"<?xml")


DRAWS = {
    "normal": None,
    "Student's t, 4": lambda rng, size: rng.standard_t(4, size),
    "lognormal": lambda rng, size: rng.choice([-1.0, 1.0], size) * rng.lognormal(0, 0.8, size),
}
AXES = {"distance_m": [1.0], "tilt_deg": [10.0, 40.0], "solver": ["ippe", "sqpnp"]}


def compared(seed, trials, normal=None, ratio=1.0):
    """Return the differences of two solvers, one with larger errors, of 5 % failures each."""
    results = poses_with_law(seed, {**AXES, "trial": range(trials)}, power_law, normal=normal)
    for name in ("rotation_error_rad", "translation_error_m"):
        results[name].loc[{"solver": "sqpnp"}] *= ratio
    failed = np.random.default_rng(seed).random(results.estimate.shape) < 0.05
    results["estimate"] = results.estimate.where(~failed, EstimateStatus.solver_failed)
    first, second = (results.sel(solver=name) for name in AXES["solver"])
    return differences_of(first, second)


def told_apart(*arguments):
    """Return whether one of two solvers with equal errors is called better."""
    return overall(compared(*arguments)) in {BETTER, WORSE}


@pytest.mark.evidence
def test_about_as_many_draws_as_are_said_decide_a_comparison():
    """At least 9 in 10 did so in simulations: of ten, fewer than three do with p < 4e-7."""
    open_ones = [found for seed in range(40) if not np.isnan(
        draws_to_decide(found := compared(seed, 50, ratio=1.1)))][:10]
    assert f", about {draws_to_decide(open_ones[0]):,.0f} would decide" in more_draws(open_ones[0])
    decided = [overall(compared(1000 + k, int(min(draws_to_decide(found), 8000)) // 2, ratio=1.1))
               != NOT_DECIDED for k, found in enumerate(open_ones)]
    assert sum(decided) >= 3


@pytest.mark.evidence
@pytest.mark.parametrize("trials", [30, 100, 400])
@pytest.mark.parametrize("law", DRAWS)
def test_two_equal_configurations_are_seldom_told_apart(law, trials, claim):
    """2,000 simulations; a sound rule is refused with a probability below 1e-6."""
    count = 2000
    told = sum(told_apart(seed, trials, DRAWS[law]) for seed in range(count))
    claim("equal configurations that are told apart", "2,000 simulated stores; 5 % are allowed",
          100 * told / count, "%")
    assert told <= binom.ppf(1 - 1e-6, count, 0.05)


def test_no_fewer_draws_would_decide_than_there_are():
    open_one = compared(0, 50)[0]._replace(deciding=(-70.0, -92.6, 1.5), draws=10)
    assert min(open_one.draws_needed) > 10


def test_a_difference_that_four_quantities_may_show_by_chance_is_not_decided():
    """Of 40 pairs of equal ones at most 12 are told apart: chance alone exceeds that in 4e-8."""
    assert sum(told_apart(seed, 50, None) for seed in range(40)) <= 12
