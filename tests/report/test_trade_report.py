"""What accuracy costs: the front, the advice, the tables and the figure."""

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from sweep.report.figure import panels_file
from sweep.report.table import MAX_WIDTH
from sweep.report.tradeoff_figure import headlines, trade_figure, tradeoff_table
from sweep.tradeoff.pareto import UNITS, mark_front, pareto_front

P95 = "rotation_p95_deg"
SOLVERS = ("ippe_square", "ippe", "iterative", "sqpnp", "ap3p")
# Time of detection (ms), error of the corners (px).
REFINEMENTS = {"none": (0.21, 0.5), "subpix": (0.24, 0.12), "contour": (0.27, 0.16),
               "apriltag": (0.9, 0.07)}


def synthetic(sides=(20, 50, 150), treatments=21):
    """Return a plausible `trade`: 4 refinements x 5 solvers and a photometric one, by side_px."""
    rng = np.random.default_rng(5)
    settings = [(r, s) for r in REFINEMENTS for s in SOLVERS] + [("subpix", "photometric")]
    settings = settings[-treatments:]
    side = np.array(sides, dtype=float)[:, None]
    shape = (len(sides), len(settings))
    detection = np.array([REFINEMENTS[r][0] for r, _ in settings]) * (1 + side / 200)
    estimation = np.array([
        2.4 if s == "photometric" else 0.02 + 0.03 * SOLVERS.index(s) for _, s in settings
    ]) * np.exp(rng.normal(0, 0.1, shape))
    pixels = np.array([0.02 if s == "photometric" else REFINEMENTS[r][1] for r, s in settings])
    error = pixels * 60 / side * np.exp(rng.normal(0, 0.25, shape))
    misses = np.where((side < 30) & (pixels > 0.1), 0.08, 0.004) * np.ones(shape)

    coords = {
        "side_px": list(sides),
        "treatment": [" \u00b7 ".join(pair) for pair in settings],
        "cornerRefinementMethod": ("treatment", [r for r, _ in settings]),
        "solver": ("treatment", [s for _, s in settings]),
        "level": [0.5, 0.9, 0.99],
    }
    trade = {}
    dims = ("side_px", "treatment")

    def add(name, values, spread):
        trade[name] = dims, values
        trade[f"{name}_low"] = dims, values / (1 + spread)
        trade[f"{name}_high"] = dims, values * (1 + spread)

    add("cost_ms", detection + estimation, 0.03)
    add("cost_ratio", (detection + estimation) / (detection + estimation)[:, :1], 0.02)
    add("detection_ms", detection, 0.03)
    add("estimation_ms", estimation, 0.03)
    add("detection_rate", 1 - misses, 0.01)
    add("solved_rate", 1 - misses, 0.01)
    add("flip_rate", misses / 4, 0.3)
    trade["looked_for"] = dims, np.full(shape, 4000)
    for quantity, unit in UNITS.items():
        for name, factor, share in (("bias", 0.1, 1), ("rmse", 1, 1), ("rmse_unflipped", 0.9, 1),
                                    ("median", 0.7, 0.5), ("p95", 2, 0.05), ("p99", 3, 0.01)):
            values = np.where(misses > share, np.inf, factor * error)
            add(f"{quantity}_{name}_{unit}", values, 0.08)
        trade[f"{quantity}_efficiency"] = dims, 0.015 * 60 / side / error
        trade[f"bound_{quantity}_{unit}"] = "side_px", 0.03 * 60 / side[:, 0]
    trade["nees_mean"] = dims, 6 * np.exp(rng.normal(0, 0.2, shape))
    trade["nees_count"] = dims, np.full(shape, 3900)
    trade["covariance_trusted"] = dims, rng.random(shape) < 0.7
    trade["covariance_coverage"] = (
        (*dims, "level"), rng.normal([0.48, 0.88, 0.985], 0.004, (*shape, 3))
    )
    return xr.Dataset(trade, coords, {
        "title": "What accuracy costs", "poses": 4000, "window": "auto", "criterion": P95,
        "baseline": coords["treatment"][0],
    })


# Few different values, so that ties are common.
VALUES = st.sampled_from([0.1, 0.12, 0.25, 0.5, 1.0, 2.0, 3.0, np.inf, np.nan]) | st.floats(
    1e-3, 1e3
)
POINTS = st.lists(st.tuples(VALUES, VALUES), min_size=1, max_size=12)


# The front.

@given(POINTS)
def test_the_front_is_what_no_other_point_beats(points):
    def beats(a, b):
        return all(np.isfinite(a)) and a[0] <= b[0] and a[1] <= b[1] and a != b

    expected = [
        all(np.isfinite(one)) and not any(beats(other, one) for other in points) for one in points
    ]
    assert pareto_front(*zip(*points, strict=True)).tolist() == expected


# Tables, JSON and figures, for one, three and no regimes, and for one treatment.

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
        "nees_mean", "nees_count", "covariance_trusted", "covariance_coverage", "level",
        "rotation_efficiency", "range_efficiency", "bound_rotation_deg", "bound_range_percent",
        "cornerRefinementMethod", "solver",
    ])


TRADES = pytest.mark.parametrize(
    "trade",
    [synthetic(), synthetic([20]), synthetic().isel(side_px=2), synthetic([20], treatments=1),
     spoilt(), bare()],
    ids=["three regimes", "one regime", "no regime", "one treatment", "spoilt", "bare"],
)


@TRADES
def test_tables_have_a_row_for_every_treatment(trade):
    table = tradeoff_table(trade, P95)
    text = table.text()
    assert max(map(len, text.splitlines())) <= MAX_WIDTH
    assert len(table.frame) == trade.sizes.get("side_px", 1) * trade.sizes["treatment"]
    assert table.frame["on the front"].sum() == mark_front(trade, P95).on_front.sum()
    assert ("condition" in table.frame) == (trade["cost_ms"].ndim > 1)
    assert "nan" not in text + table.markdown() + "".join(headlines(trade, P95))


@pytest.mark.parametrize(("trade", "conditions"), [
    (synthetic(), 3), (synthetic([20], treatments=1), 1), (spoilt(), 2), (bare(), 1)],
    ids=["three regimes", "one treatment", "spoilt", "bare"])
def test_every_condition_has_a_panel_with_the_numbers_of_its_configurations(trade, conditions):
    figure = trade_figure(trade, P95)
    assert len(figure.panels) == conditions
    front = mark_front(trade, P95)
    for k, panel in enumerate(figure.panels):
        axes = Figure().add_subplot()
        panel.draw(axes)
        part = front.isel(side_px=k) if "side_px" in front.dims else front
        named = {text.get_text() for text in axes.texts} - {"no finite values"}
        assert set(part["treatment"].values[part["on_front"].values]) <= named
        assert named <= set(part["treatment"].values)
    assert panels_file(figure.panels[:1], ".svg").startswith(b"<?xml")
