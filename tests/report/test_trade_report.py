"""What accuracy costs: the front, the advice, the tables and the figure."""

import itertools

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from sweep.report.figure import panels_file
from sweep.report.findings import headlines, trade_figure, tradeoff_table
from sweep.report.table import MAX_WIDTH
from sweep.tradeoff.pareto import UNITS, mark_front, pareto_front

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
