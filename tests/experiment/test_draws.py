"""Draws: independent ones and Sobol' points, scrambled, and what these gain."""

import numpy as np
import pytest
from scipy import stats

import sweep
from support.blocks import run_cells, whole
from support.lengths import lengths
from sweep.experiment.draws import BITS, REPLICATES, points, scrambled, sobol_uniform
from sweep.experiment.pipeline import Pipeline, cell
from sweep.store.provenance import fingerprint

# A draw is a function of (seed, quantity, geometry, trial), and of nothing else.

DRAWN = {
    "seed": 2020, "marker": {"size_m": 0.04},
    "pose": {"jitter_px": 0.5, "tilt_deg": {"uniform": [0, 70]},
             "azimuth_deg": {"normal": [10, 5]}},
    "axes": {"marker_id": [3, 0, 8], "distance_m": [0.2, 0.5, 1.0], "bearing_x_deg": [0, 7.5],
             "trial": 4},
}
ORDER = ("marker_id", "distance_m", "bearing_x_deg", "trial")
QUANTITIES = ("shift_u_px", "shift_v_px", "tilt_deg", "azimuth_deg")


def drawn(*settings, document=DRAWN, order=ORDER, take=None):
    """Return every quantity's draws over the grid, dimensions in ``order``, cut by ``take``."""
    pipeline = Pipeline.from_dict(document, settings)
    axes = {axis.name: axis for axis in pipeline.experiment.scene_axes}
    block = whole(pipeline)
    values = pipeline.experiment.scene_values(block.indices())
    kept = [name for name in axes if name in order]
    others = tuple(0 if name not in order else slice(None) for name in axes)
    table = {}
    for name in QUANTITIES:
        grid = values[name].broadcast(len(block)).reshape(block.shape)[others]
        grid = np.moveaxis(grid, range(len(kept)), [order.index(name) for name in kept])
        table[name] = grid[take] if take else grid
    return table


def assert_same(table, expected):
    for name in QUANTITIES:
        np.testing.assert_array_equal(table[name], expected[name], err_msg=name)


@pytest.mark.parametrize("sampling", ["independent", "sobol"])
def test_draws_do_not_depend_on_fixed_or_axis_nor_on_the_rest_of_the_grid(sampling):
    own = f"sampling={sampling}", "trial=32"
    expected = drawn(*own)
    assert len(set(expected["tilt_deg"].ravel().tolist())) == 3 * 3 * 2 * 32
    cut = {name: column[1:2, 2:, 0:1] for name, column in expected.items()}
    assert_same(drawn(*own, "marker_id=[0]", "distance_m=[1.0]", "bearing_x_deg=[0]"), cut)
    fixed = drawn(*own, "marker_id=0", "distance_m=1", "bearing_x_deg=0", order=("trial",))
    assert_same(fixed, {name: column[0, 0, 0] for name, column in cut.items()})
    wider = drawn(
        own[0], "marker_id={range=[0, 9]}", "distance_m=[0.1, 1.0, 0.3, 0.5, 0.2]",
        "bearing_x_deg=[-3, 7.5, 0]", "trial=64",
        take=np.ix_([3, 0, 8], [4, 3, 1], [2, 1], range(32)),
    )
    assert_same(wider, expected)
    one = cell(Pipeline.from_dict(DRAWN, own), "marker_id=0,distance_m=1,bearing_x_deg=0,trial=29")
    alone = one.experiment.scene_values([np.array([0])])
    assert_same({name: alone[name].values for name in QUANTITIES},
                {name: column[0, 0, 0, 29:30] for name, column in cut.items()})


@pytest.mark.parametrize("settings", [
    ["bearing_y_deg=0", "roll_deg=0.0", "quiet_zone_modules=1", "dictionary=DICT_5X5_50",
     "cx_px=319.5", "cy_px=239.5", "distortion=[0, 0, 0, 0]"],  # the defaults
    ["fx_px=533.3333333333334"],  # the default in pixels
    ["renderer=warp"],
    ["window=full"],
    ["black=40", "white=220", "background=128"],
    ["background=[0, 128]"],
    ["black={uniform=[0, 40]}"],
    ["cornerRefinementMethod=subpix", "adaptiveThreshWinSizeMax=[23, 61]"],
    ["solver=['p3p', 'ippe']", "guarded=false", "believed_fx_px=500"],
    ["believed_cx_px={normal=[319.5, 2]}"],
], ids=",".join)
def test_draws_do_not_depend_on_defaults_renderer_levels_detector_or_estimator(settings):
    assert_same(drawn(*settings), drawn())


@pytest.mark.parametrize(
    "settings",
    [["seed=2021"], ["size_m=0.05"], ["dictionary=DICT_4X4_50"], ["roll_deg=1"], ["fx_px=534"],
     ["width_px=641"], ["distortion=[-0.1, 0, 0, 0]"], ["quiet_zone_modules=2"],
     ["bearing_y_deg=0.001"], ["cx_px=320"]],
    ids=",".join,
)
def test_draws_depend_on_seed_and_geometry(settings):
    changed, expected = drawn(*settings), drawn()
    for name in QUANTITIES:
        assert (changed[name] != expected[name]).all(), name


MANY = {
    "seed": 5, "axes": {"marker_id": [0, 1]},
    "pose": {"distance_m": 0.5, "jitter_px": 0.5, "tilt_deg": {"normal": [30, 4]}},
}


@lengths(10_000, 200_000)
def test_draws_are_uniform_normal_and_independent(count):
    """Each assertion would fail one generator in a million that is right; the seed is fixed."""
    draws = drawn(f"trial={count}", document=MANY, order=("marker_id", "trial"))
    u, v, tilt = (draws[name][0] for name in ("shift_u_px", "shift_v_px", "tilt_deg"))
    other = draws["shift_u_px"][1]
    for column in (u, v, other):
        assert stats.kstest(column, stats.uniform(-0.5, 1.0).cdf).pvalue > 1e-6
    assert stats.kstest(tilt, stats.norm(30, 4).cdf).pvalue > 1e-6
    pairs = {
        "u and v": (u, v), "u and tilt": (u, tilt), "u of two markers": (u, other),
        "consecutive u": (u[1:], u[:-1]), "consecutive tilts": (tilt[1:], tilt[:-1]),
        "every other u": (u[2:], u[:-2]), "squares": ((u[1:]) ** 2, (u[:-1]) ** 2),
    }
    for name, (a, b) in pairs.items():
        # The correlation of n independent pairs is normal with standard deviation 1/sqrt(n).
        score = stats.pearsonr(a, b).statistic * np.sqrt(len(a))
        assert abs(score) < stats.norm.isf(0.5e-6), name


def test_points_are_sobols_wherever_they_are_asked_for():
    # Of the first dimension they are van der Corput's, in the order of the Gray code.
    index = np.array([0, 1, 2, 3, 70_000, 70_001, 5, 3])
    gray = index ^ (index >> 1)
    reversed_digits = [int(f"{number:0{BITS}b}"[::-1], 2) for number in gray.tolist()]
    np.testing.assert_array_equal(points(0, index), np.array(reversed_digits, dtype=np.uint64))
    # Joe and Kuo 2008: the first points of the second and third dimension.
    np.testing.assert_array_equal(points(1, np.arange(5)) * 2.0**-BITS, [0, .5, .25, .75, .375])
    np.testing.assert_array_equal(points(2, np.arange(5)) * 2.0**-BITS, [0, .5, .25, .75, .625])


def test_scrambling_is_nested_and_uniform():
    # Owen: of any digits of a point, the first k of its scramble depend on the first k only, and
    # every interval of 2^-k of the scramble has one interval of the points.
    digits = points(3, np.arange(1024))
    keys = np.full(1024, 99, dtype=np.uint64)
    numbers = scrambled(digits, keys)
    for k in (1, 4, 9, 10):
        before, after = (digits >> np.uint64(BITS - k)).astype(int), np.floor(numbers * 2**k)
        pairs = set(zip(before.tolist(), after.tolist(), strict=True))
        assert len(pairs) == len(set(before.tolist())) == 2**k
    # A point's scrambles by different keys are uniform and independent of the point.
    keys = np.arange(20_000, dtype=np.uint64)
    for point in (0, 1, 2**31):
        numbers = scrambled(np.full(20_000, point, dtype=np.uint64), keys)
        assert stats.kstest(numbers, "uniform").pvalue > 1e-6
        low = np.floor(numbers * 2**40) % 2**10 / 2**10  # the digits beyond the 30th
        assert stats.kstest(low, "uniform").pvalue > 1e-6
    assert ((numbers > 0) & (numbers < 1)).all()


def test_pairs_of_quantities_fill_their_square_evenly():
    # Of 256 points of a replicate every elementary interval of area 1/256 of dimensions 0 and 1
    # has exactly one: a (0, 8, 2)-net, which scrambling keeps.
    trials = np.arange(256) * REPLICATES + 5
    u, v = (sobol_uniform(d, np.full(256, 7 + d, dtype=np.uint64), trials) for d in (0, 1))
    for k in range(9):
        cells = np.floor(u * 2**k) * 2 ** (8 - k) + np.floor(v * 2 ** (8 - k))
        assert len(set(cells.tolist())) == 256


def test_replicates_are_independent():
    # The correlation of the means of two replicates over 4,000 cells is 0 to 0.08 but for a chance
    # below 1e-6 (normal, 1 / sqrt(4000) = 0.016).
    keys = np.repeat(np.arange(4000, dtype=np.uint64) * np.uint64(97), 4)
    means = [
        sobol_uniform(2, keys, np.tile(np.arange(4) * REPLICATES + r, 4000)).reshape(-1, 4).mean(1)
        for r in (0, 1)
    ]
    assert abs(np.corrcoef(*means)[0, 1]) < 0.08
    assert means[0].var() < 1 / 12 / 4 / 3


def test_sampling_is_part_of_what_stores_must_share():
    grid, same, plain = (
        Pipeline.from_dict(DRAWN, [f"sampling='{sampling}'", "trial=32"])
        for sampling in ("sobol", "Sobol", "independent")
    )
    assert Pipeline.from_text(grid.to_toml()) == grid
    assert fingerprint(grid)["sampling"] == fingerprint(same)["sampling"] == "sobol"
    assert "sampling" not in fingerprint(plain)
    ours, others = (
        each.experiment.scene_values(whole(each).indices())["tilt_deg"].values
        for each in (grid, plain)
    )
    assert (ours != others).all()


VARIED = {
    "camera": {"fx_px": 600},
    "marker": {"size_m": 0.05},
    "pose": {
        "side_px": {"uniform": [14, 40]}, "tilt_deg": {"uniform": [0, 70]},
        "azimuth_deg": {"uniform": [0, 360]}, "jitter_px": 0.5,
    },
    "scene": {"background": 120, "black": 40, "white": 220, "noise_grey": 2},
    "detector": {"cornerRefinementMethod": "subpix"},
}


def quantities(seed, points, sampling):
    """Return the means of five quantities over each group of points, (groups, 5)."""
    trials = points * REPLICATES
    pipeline = sweep.Pipeline.from_dict(
        VARIED | {"seed": seed, "sampling": sampling, "axes": {"trial": trials}})
    columns = run_cells(pipeline, [np.arange(trials)]).columns
    angle = np.minimum(columns["rotation_error_deg"][0].astype(float), 30)
    # Both samplings in groups of as many draws: replicates, or trials in a row.
    order = np.arange(trials)
    if sampling == "sobol":
        order = np.argsort(order % REPLICATES, kind="stable")
    values = np.stack([
        columns["detection"][0] == 1, angle, columns["translation_error_m"][0][:, 2], angle**2,
        np.linalg.norm(columns["corner_error_px"][0], axis=2).mean(axis=1),
    ], axis=1).astype(float)
    means = np.nanmean(values[order.reshape(-1, points)], axis=1)
    means[:, 3] = np.sqrt(means[:, 3])
    return means


GAINED = ("detection rate", "mean rotation error", "bias of z", "RMSE of rotation", "corner error")


@pytest.mark.evidence
def test_variances_of_means_are_no_larger():
    # The ratio of two sample variances of equal normal means is Fisher's F: with 383 and 383
    # degrees of freedom below 0.61 with a chance of 1e-6.
    seeds, points = 24, 64
    means = {
        sampling: np.concatenate([
            quantities(seed, points, sampling) for seed in range(seeds)
        ]) for sampling in ("sobol", "independent")
    }
    ratios = means["independent"].var(axis=0, ddof=1) / means["sobol"].var(axis=0, ddof=1)
    print({name: round(float(ratio), 2) for name, ratio in zip(GAINED, ratios, strict=True)})
    groups = seeds * REPLICATES - 1
    assert (ratios > stats.f.ppf(1e-6, groups, groups)).all()
    # The same is estimated.
    error = np.sqrt(sum(each.var(axis=0, ddof=1) / len(each) for each in means.values()))
    difference = means["sobol"].mean(axis=0) - means["independent"].mean(axis=0)
    assert (abs(difference) < 6 * error).all()
