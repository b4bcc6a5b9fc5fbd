"""Draws that are Sobol' points, scrambled."""

import numpy as np
from scipy import stats

import sweep
from sweep.experiment.draws import (
    BITS,
    REPLICATES,
    points,
    scrambled,
    sobol_uniform,
)
from sweep.experiment.pipeline import cell
from sweep.store.provenance import fingerprint


def pipeline(*settings, trials=64, **sections):
    document = {
        "seed": 4, "sampling": "sobol",
        "pose": {"distance_m": 0.5, "tilt_deg": {"uniform": [0, 60]},
                 "roll_deg": {"normal": [0, 30]}, "jitter_px": 1},
        "axes": {"azimuth_deg": [0, 40], "trial": trials},
    }
    return sweep.Pipeline.from_dict(document | sections, list(settings))


def drawn(grid, *indices):
    values = grid.experiment.scene_values([np.asarray(index) for index in indices])
    return {name: values[name].values for name in
            ("tilt_deg", "roll_deg", "shift_u_px", "shift_v_px")}


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


def test_a_draw_depends_on_its_own_cell_and_trial_alone():
    grid, index = pipeline(), (np.repeat([0, 1], 64), np.tile(np.arange(64), 2))
    ours = drawn(grid, *index)
    # A grid that is extended, cut into other blocks, in other order, with a fixed azimuth.
    longer = drawn(pipeline(trials=4096), *index)
    fixed = pipeline(axes={"trial": 64}, pose={
        "distance_m": 0.5, "tilt_deg": {"uniform": [0, 60]}, "roll_deg": {"normal": [0, 30]},
           "jitter_px": 1, "azimuth_deg": 40,
    })
    for name, values in ours.items():
        np.testing.assert_array_equal(longer[name], values)
        np.testing.assert_array_equal(drawn(fixed, np.arange(64))[name], values[64:])
        some = drawn(grid, [1, 0], [33, 2])[name]
        np.testing.assert_array_equal(some, values[[64 + 33, 2]])
    one = cell(grid, "azimuth_deg=40,trial=33")
    assert drawn(one, [0])["tilt_deg"][0] == ours["tilt_deg"][64 + 33]
    assert len(set(ours["tilt_deg"].tolist())) == 128


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
    grid = pipeline()
    assert sweep.Pipeline.from_text(grid.to_toml()) == grid
    assert fingerprint(grid)["sampling"] == "sobol"
    assert fingerprint(pipeline("sampling='Sobol'"))["sampling"] == "sobol"
    plain = pipeline("sampling=independent")
    assert "sampling" not in fingerprint(plain)
    index = np.zeros(3, dtype=int), np.arange(3)
    assert (drawn(plain, *index)["tilt_deg"] != drawn(grid, *index)["tilt_deg"]).all()
