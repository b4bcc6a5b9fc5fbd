"""What accuracy costs: the front, the advice, the tables and the figure."""

import itertools
import re

import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.text import Annotation, Text

from sweep.report.table import MAX_WIDTH
from sweep.report.tradeoff_figure import draw_trade, headlines, tradeoff_table
from sweep.tradeoff.pareto import CRITERIA, UNITS, advice, digits, mark_front, pareto_front

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


def one_regime(costs, errors, low=None, high=None):
    """Return a `trade` of one regime with treatments named 0, 1, ..."""
    low, high = (np.full(len(costs), np.nan) if end is None else end for end in (low, high))
    columns = {"cost_ms": costs, P95: errors, f"{P95}_low": low, f"{P95}_high": high,
               "solved_rate": np.ones(len(costs))}
    return xr.Dataset(
        {name: ("treatment", np.asarray(values, dtype=float)) for name, values in columns.items()},
        coords={"treatment": [str(k) for k in range(len(costs))]},
    )


def named(sentence):
    """Return the budgets (ms) and the treatments that a sentence names."""
    pairs = re.findall(r"within ([\d.]+) ms a frame take (\S+) |wait ([\d.]+) ms, (\S+) ", sentence)
    return [(float(a or c), int(b or d)) for a, b, c, d in pairs]


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


@pytest.mark.parametrize("criterion", CRITERIA)
def test_each_regime_has_its_own_front(criterion):
    trade = mark_front(synthetic(), criterion)
    assert trade.on_front.dtype == bool
    for k in range(3):
        one = trade.isel(side_px=k)
        assert (one.on_front == pareto_front(one.cost_ms, one[criterion])).all()
    assert not (trade.on_front & ~np.isfinite(trade[criterion])).any()


# The advice.

@given(POINTS, st.floats(0, 0.5))
def test_advice_is_true(points, spread):
    costs, errors = np.array(points).T
    low, high = errors * (1 - spread), errors * (1 + spread)
    (sentence,) = advice(one_regime(costs, errors, low, high), P95)
    steps = named(sentence)
    if not (np.isfinite(costs) & np.isfinite(errors)).any():
        assert not steps
        assert sentence.startswith(f"no configuration has a finite {P95}: ")
        return
    assert 1 <= len(steps) <= 3
    front = pareto_front(costs, errors)
    assert all(front[k] and costs[k] <= budget <= 1.11 * costs[k] for budget, k in steps)
    for (budget, k), (next_budget, following) in itertools.pairwise(steps):
        assert budget < next_budget
        assert not high[following] >= low[k]
    last = steps[-1][1]
    if spread == 0:
        assert errors[last] == errors[front].min()


@pytest.mark.parametrize(
    ("costs", "errors", "chosen"),
    [
        ([0.31, 1.05, 4.0], [1.2, 0.3, 0.2], [(0.31, 0), (1.1, 1), (4.0, 2)]),
        ([0.31, 1.05, 4.0], [1.2, 1.1, 0.2], [(0.31, 0), (4.0, 2)]),  # no knee
        ([0.31, 1.05, 4.0], [0.22, 0.205, 0.2], [(0.31, 0), (4.0, 2)]),  # not worth while
        ([0.311, 0.312, 9.9], [1.2, 0.6, 0.7], [(0.32, 1)]),  # the best of one budget
        ([123.0], [0.5], [(130.0, 0)]),
    ],
)
def test_at_most_cheapest_knee_and_best_are_named(costs, errors, chosen):
    assert named(advice(one_regime(costs, errors), P95)[0]) == chosen


def test_overlapping_intervals_are_no_step():
    trade = one_regime([1, 2, 3], [1.0, 0.9, 0.5], [0.9, 0.8, 0.3], [1.1, 1.0, 0.95])
    (sentence,) = advice(trade, P95)
    assert sentence == (
        "within 1.0 ms a frame take 0 (rotation_p95 1.00 deg); "
        "no more expensive one is clearly better"
    )
    # An upper end that is missing is beyond all draws; without any interval the value counts.
    trade[f"{P95}_high"][2] = np.nan
    assert named(advice(trade, P95)[0]) == [(1.0, 0)]
    trade[f"{P95}_low"][2] = np.nan
    assert named(advice(trade, P95)[0]) == [(1.0, 0), (3.0, 2)]


def test_advice_says_why_there_is_none():
    trade = one_regime([1, 2], [np.inf, np.inf]).expand_dims(side_px=[20])
    (sentence,) = advice(trade, P95)
    assert sentence == (
        f"side_px = 20: no configuration has a finite {P95}: "
        "each misses at least 5 % of the poses; another criterion may rank them"
    )
    assert "none solved enough" in advice(one_regime([1, 2], [np.inf, np.nan]), P95)[0]
    nothing = trade.assign(solved_rate=0 * trade.solved_rate)
    assert "none solved any pose" in advice(nothing, P95)[0]


def test_an_rmse_is_not_told_without_what_was_solved():
    (sentence,) = advice(synthetic([20]), "range_rmse_percent")
    assert sentence.startswith("side_px = 20: within 0.25 ms a frame take none")
    assert sentence.count("% solved)") == len(sentence.split("; "))


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
    assert (table.frame["on the front"] == "yes").sum() == mark_front(trade, P95).on_front.sum()
    assert ("condition" in table.frame) == (trade["cost_ms"].ndim > 1)
    assert "nan" not in text + table.markdown() + "".join(headlines(trade))


def test_tables_are_sorted_by_cost_and_show_intervals():
    trade = synthetic([20])
    table = tradeoff_table(trade, P95)
    order = trade.isel(side_px=0).sortby("cost_ms").treatment.values
    assert table.frame["configuration"].tolist() == order.tolist()
    one = trade.isel(side_px=0, treatment=-1)
    for name in ("cost_ms", "cost_ratio", P95):
        low, value, high = (digits(one[f"{name}{end}"]) for end in ("_low", "", "_high"))
        assert f"{value} ({low} to {high})" in table.text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("trade", "suffix", "start"),
    [(synthetic(), "png", b"\x89PNG"), (synthetic([20], treatments=1), "svg", b"<?xml"),
     (spoilt(), "png", b"\x89PNG"), (bare(), "png", b"\x89PNG")],
    ids=["three regimes", "one treatment", "spoilt", "bare"],
)
def test_a_figure_is_written(trade, suffix, start, tmp_path):
    path = tmp_path / f"trade.{suffix}"
    draw_trade(trade, P95, path)
    assert path.read_bytes().startswith(start)


def drawn_figure(monkeypatch, trade, **options):
    """Return the figure of a trade, as it was about to be written."""
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    draw_trade(trade, P95, "unwritten.png", **options)
    return figures[0]


def test_every_point_has_a_label_and_no_two_overlap(monkeypatch):
    trade = synthetic([20])
    figure = drawn_figure(monkeypatch, trade, budget_ms=1.0)
    figure.draw_without_rendering()
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    names = trade["treatment"].values.tolist()
    assert legend[:len(names)] == [f"{k + 1}  {name}" for k, name in enumerate(names)]
    assert "budget 1 ms" in legend
    for panel, side in zip(figure.axes, trade["side_px"].values, strict=True):
        labels = [text for text in panel.texts if isinstance(text, Annotation)]
        error = trade[P95].sel(side_px=side).values
        finite = {str(k + 1) for k in np.flatnonzero(np.isfinite(error))}
        assert {label.get_text().split()[0] for label in labels} == finite
        # Without the room that a line has above and below its letters.
        boxes = [Text.get_window_extent(label).expanded(0.98, 0.7) for label in panel.texts]
        assert all(box.count_overlaps(boxes) == 1 for box in boxes)
        assert any(np.allclose(line.get_xdata(), 1.0) for line in panel.lines)
        unknown = [text.get_text() for text in panel.texts if text not in labels]
        assert bool(unknown) == (len(finite) < len(names))


def test_a_condition_without_a_finite_criterion_is_named_and_has_no_panel(monkeypatch):
    figure = drawn_figure(monkeypatch, spoilt(), budget_ms=1e6)
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["side_px = 50"]
    assert "side_px = 20" in figure.get_supxlabel()
    assert "budget 1e+06 ms (all within)" in [
        text.get_text() for text in figure.legends[0].get_texts()]
    nothing = synthetic([20], treatments=2)
    nothing[P95][:] = np.inf
    assert len(drawn_figure(monkeypatch, nothing).axes) == 1
