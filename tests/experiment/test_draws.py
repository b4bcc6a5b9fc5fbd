"""A draw is a function of (seed, quantity, geometry, trial), and of nothing else."""

import numpy as np
import pytest
from scipy import stats

from support.blocks import run_block
from support.lengths import lengths
from sweep.experiment.grid import Block
from sweep.experiment.pipeline import Pipeline

DRAWN = """
seed = 2020
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
tilt_deg = { uniform = [0, 70] }
azimuth_deg = { normal = [10, 5] }
[axes]
marker_id = [3, 0, 8]
distance_m = [0.2, 0.5, 1.0]
bearing_x_deg = [0, 7.5]
trial = 4
"""
ORDER = ("marker_id", "distance_m", "bearing_x_deg", "trial")
QUANTITIES = ("shift_u_px", "shift_v_px", "tilt_deg", "azimuth_deg")


def whole(pipeline):
    shape = tuple(len(axis) for axis in pipeline.experiment.scene_axes)
    return Block((0,) * len(shape), shape)


def drawn(*settings, text=DRAWN, order=ORDER, take=None):
    """Return every quantity's draws over the grid, dimensions in ``order``, cut by ``take``."""
    pipeline = Pipeline.from_text(text, settings)
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


def test_draws_do_not_depend_on_the_order_of_axes():
    head, lines = DRAWN.split("[axes]\n")
    axes = lines.splitlines()
    expected = drawn()
    for order in ([3, 2, 1, 0], [1, 3, 0, 2]):
        text = head + "[axes]\n" + "\n".join(axes[i] for i in order)
        assert_same(drawn(text=text), expected)


def test_draws_do_not_depend_on_fixed_or_axis_nor_on_the_rest_of_the_grid():
    expected = drawn()
    cut = {name: column[1:2, 2:, 0:1] for name, column in expected.items()}
    assert_same(drawn("marker_id=[0]", "distance_m=[1.0]", "bearing_x_deg=[0]"), cut)
    fixed = drawn("marker_id=0", "distance_m=1", "bearing_x_deg=0", order=("trial",))
    assert_same(fixed, {name: column[0, 0, 0] for name, column in cut.items()})
    wider = drawn(
        "marker_id={range=[0, 9]}", "distance_m=[0.1, 1.0, 0.3, 0.5, 0.2]",
        "bearing_x_deg=[-3, 7.5, 0]", "trial=9",
        take=np.ix_([3, 0, 8], [4, 3, 1], [2, 1], range(4)),
    )
    assert_same(wider, expected)


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


MANY = """
seed = 5
[pose]
distance_m = 0.5
jitter_px = 0.5
tilt_deg = { normal = [30, 4] }
[axes]
marker_id = [0, 1]
"""


@lengths(10_000, 200_000)
def test_draws_are_uniform_normal_and_independent(count):
    """Each assertion would fail one generator in a million that is right; the seed is fixed."""
    draws = drawn(f"trial={count}", text=MANY, order=("marker_id", "trial"))
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


@pytest.mark.parametrize("distortion", ["[]", "[-0.3, 0.1, 0.001, -0.002]"])
def test_jitter_moves_the_undistorted_projection_of_the_centre_by_the_shift(distortion):
    settings = [f"distortion={distortion}", "bearing_y_deg=-4", "fx_px=700", "fy_px=650",
                "cx_px=300.25", "cy_px=260"]
    pipeline = Pipeline.from_text(DRAWN, settings)
    block = whole(pipeline)
    values = pipeline.experiment.scene_values(block.indices())
    truth = run_block(pipeline, block).values["true_tvec_m"].reshape(-1, 3)
    bearings = [values["bearing_x_deg"].values, np.full(len(block), -4.0)]
    expected = np.tan(np.radians(np.stack(bearings)))
    shift = np.stack([values["shift_u_px"].values, values["shift_v_px"].values])
    # 1e-10 px: a few roundings of coordinates of some hundred pixels.
    for axis, (focal, centre) in enumerate(((700.0, 300.25), (650.0, 260.0))):
        pixel = focal * truth[:, axis] / truth[:, 2] + centre
        unshifted = focal * expected[axis] + centre
        np.testing.assert_allclose(pixel - unshifted, shift[axis], rtol=0, atol=1e-10)
    np.testing.assert_array_equal(truth[:, 2], values["distance_m"].values)
    assert np.abs(shift).max() <= 0.5
    assert np.abs(shift).max() > 0.4
