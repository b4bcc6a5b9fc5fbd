"""Photographs against simulations: NumPy's and SciPy's numbers, pairing, coverage of intervals."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.photograph_results import PHOTOGRAPHS, REFINEMENTS, results_of, twins
from support.small_datasets import perfect
from sweep.analysis import detection_rate, flip_rate, simulation_gap
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus


def errors(results, name, refinement):
    """Return the errors of the solved poses as NumPy has them: rotation in deg, depth in %."""
    each = results.sel(cornerRefinementMethod=refinement)
    solved = each.estimate.values == EstimateStatus.solved
    if name.startswith("rotation"):
        return np.degrees(np.linalg.norm(each.rotation_error_rad.values, axis=-1))[solved]
    depth = 100 * (each.translation_error_m / each.true_tvec_m).values[..., 2][solved]
    return depth if "bias" in name else np.abs(depth)


def test_values_are_numpys_and_gaps_their_differences_and_ratios():
    rng = np.random.default_rng(1)
    first, second = results_of(rng), twins(rng, repeats=2, scale=0.7)
    gap = simulation_gap(first, second)
    assert gap.attrs["paired"] == 1
    for refinement in REFINEMENTS:
        at = gap.sel(cornerRefinementMethod=refinement)
        for name, share, ratio in (
            ("range_bias_median_percent", 0.5, False), ("rotation_median_deg", 0.5, True),
            ("rotation_p90_deg", 0.9, True), ("range_median_percent", 0.5, True),
            ("range_p90_percent", 0.9, True),
        ):
            real, simulated = (
                np.quantile(errors(each, name, refinement), share, method="inverted_cdf")
                for each in (first, second)
            )
            assert at[name].values == pytest.approx([real, simulated])
            expected = simulated / real if ratio else simulated - real
            assert at[f"{name}_gap"].item() == pytest.approx(expected)
            assert at[f"{name}_gap_low"] < expected < at[f"{name}_gap_high"]
    for k, results in enumerate((first, second)):
        looked_for = (results.detection != DetectionStatus.not_in_photograph)
        assert (gap.looked_for[k] == looked_for.sum(["trial", "marker_id"])).all()
    assert (gap.units == PHOTOGRAPHS).all()


def test_rates_are_those_of_the_photographs_alone_and_their_difference_newcombes():
    rng = np.random.default_rng(2)
    first, second = results_of(rng), twins(rng)
    gap = simulation_gap(first, second)
    for analysis, name in ((detection_rate, "detection_rate"), (flip_rate, "flip_rate")):
        tables = [analysis(each, per="cornerRefinementMethod") for each in (first, second)]
        rate, low, high = (np.stack([table[f"{name}{end}"].values for table in tables])
                           for end in ("", "_low", "_high"))
        for end, both in (("", rate), ("_low", low), ("_high", high)):
            assert np.array_equal(gap[f"{name}{end}"].values, both)
        reach = np.sqrt((rate[1] - low[1]) ** 2 + (high[0] - rate[0]) ** 2)
        assert np.allclose(gap[f"{name}_gap_low"], rate[1] - rate[0] - reach)


def test_twins_are_paired_by_their_photographs():
    rng = np.random.default_rng(3)
    first = results_of(rng)
    same = first.assign_coords(simulated=True)
    shuffled = same.isel(trial=rng.permutation(PHOTOGRAPHS))
    for second in (same, shuffled.assign_coords(trial=range(PHOTOGRAPHS))):
        gap = simulation_gap(first, second)
        for name, low, high in (
                ("rotation_median_deg", 0.85, 1.18), ("range_bias_median_percent", -0.11, 0.11)):
            assert (gap[f"{name}_gap"] == (low > 0)).all()
            assert (gap[f"{name}_gap_low"] > low).all()  # of others it is 0.4 and -0.8
            assert (gap[f"{name}_gap_high"] < high).all()
    # Of half of the photographs, the other half is not compared.
    half = simulation_gap(first, same.isel(trial=range(0, PHOTOGRAPHS, 2)))
    assert (half.units == PHOTOGRAPHS // 2).all()
    assert (half.looked_for[0] == half.looked_for[1]).all()


def test_errors_of_twins_are_of_a_truth_as_uncertain_as_the_photographs():
    rng = np.random.default_rng(12)
    first = results_of(rng, 150)
    exact = first.copy()
    for name in ("rotation_error_rad", "translation_error_m"):
        exact[name] = first[name] * 0.0
    sd = np.array([0.01, 0.01, 0.01, 0.0, 0.0, 0.03])
    std = (("trial", "marker_id", "pose_parameter"), np.broadcast_to(sd, (150, 9, 6)))
    gap = simulation_gap(
        first.assign(truth_std=std), exact.assign(truth_std=std).assign_coords(simulated=True)
    ).sel(source="simulated", cornerRefinementMethod="none")
    # Lengths of three normal components, and absolute values of one: within four standard errors.
    assert gap.rotation_median_deg.item() == pytest.approx(
        np.degrees(0.01) * stats.chi.ppf(0.5, 3), rel=0.06)
    assert gap.range_p90_percent.item() == pytest.approx(1.5 * stats.norm.ppf(0.95), rel=0.1)
    unknown = exact.assign(truth_std=(std[0], np.full((150, 9, 6), np.nan)))
    gap = simulation_gap(first, unknown.assign_coords(simulated=True))
    assert (gap.rotation_median_deg.sel(source="simulated") == 0).all()


def test_another_simulation_is_compared_in_bins():
    rng = np.random.default_rng(4)
    first = results_of(rng)
    scenes = results_of(rng, 40, files=False).isel(cornerRefinementMethod=1)
    edges = [20, 35, 50]
    gap = simulation_gap(first, scenes, bins={"side_px": edges})
    assert gap.attrs["paired"] == 0
    assert gap.rotation_median_deg.dims == ("source", "cornerRefinementMethod", "side_px")
    assert gap.cornerRefinementMethod.values.tolist() == ["subpix"]
    inside = (first.side_px >= 35) & (first.side_px < 50)
    expected = np.median(errors(first.where(inside), "rotation", "subpix"))
    found = gap.rotation_median_deg.sel(source="photographs")[0, 1].item()
    assert found == pytest.approx(expected, rel=0.1)
    assert simulation_gap(first, scenes).side_px_low.values[0] <= 20


def test_axes_that_twins_alone_have_are_kept():
    rng = np.random.default_rng(5)
    first = results_of(rng)
    second = xr.concat([twins(rng, scale=s) for s in (0.3, 1.0)], dim="blur_px").assign_coords(
        blur_px=("blur_px", [0.3, 1.0], {"units": "px"}))
    gap = simulation_gap(first, second)
    assert gap.rotation_median_deg.dims == ("source", "cornerRefinementMethod", "blur_px")
    real, simulated = gap.rotation_median_deg
    assert (real[:, 0] == real[:, 1]).all()
    assert (simulated[:, 0] < simulated[:, 1]).all()


RNG = np.random.default_rng(6)
FIRST, TWINS, SIMULATION = results_of(RNG), twins(RNG), results_of(RNG, files=False)


@pytest.mark.parametrize(("first", "second", "bins", "error", "words"), [
    (SIMULATION, FIRST, {}, DatasetError, "expected photographs"),
    (FIRST, TWINS.assign_coords(sha256=("trial", ["another"] * PHOTOGRAPHS)), {}, DatasetError,
     "twin of other photographs"),
    (FIRST, TWINS.assign_coords(cornerRefinementMethod=["contour", "apriltag"]), {}, DatasetError,
     "no common cornerRefinementMethod"),
    (FIRST, SIMULATION, {"side_px": [3]}, ArgumentError, "increasing edges"),
    (FIRST.assign(sharpness=FIRST.side_px), SIMULATION, {"sharpness": [1, 2]}, DatasetError,
     "both datasets need it"),
])
def test_what_cannot_be_compared_is_told_in_a_line(first, second, bins, error, words):
    with pytest.raises(error, match=words):
        simulation_gap(first, second, bins=bins)


@pytest.mark.evidence
@pytest.mark.parametrize(("photographs", "correlation", "shared"), [
    (13, 0.5, False), (13, 0.1, False), (22, 0.5, False), (13, 0.5, True)])
def test_intervals_hold_what_is_true(photographs, correlation, shared, claim):
    """Errors of a photograph are correlated, as real ones; ``shared``: with those of its twin."""
    rng = np.random.default_rng(9)
    sizes = {"trial": photographs, "marker_id": 25, "cornerRefinementMethod": 1000}
    common = [rng.normal(size=(photographs, 1, 1000)) for _ in range(2)]
    sides = []
    for k in range(2):
        values = np.sqrt(correlation) * common[0 if shared else k] + np.sqrt(
            1 - correlation) * rng.normal(size=tuple(sizes.values()))
        errors = np.zeros((2, *values.shape, 3))
        errors[0, ..., 0], errors[1, ..., 2] = np.radians(np.exp(values)), values / 100
        found = perfect(rng, sizes, rotation=errors[0], position=errors[1])
        found = found.assign(true_tvec_m=xr.ones_like(found.true_tvec_m))
        names = ("trial", [f"{n}" for n in range(photographs)])
        sides.append(found.assign_coords(photographs="shots", photograph=names, sha256=names))
    gap = simulation_gap(sides[0], sides[1].assign_coords(simulated=True))
    for name, true, none in (("range_bias_median_percent", 0.0, 0.0),
                             ("rotation_median_deg", 1.0, 1.0),
                             ("rotation_p90_deg", np.exp(stats.norm.ppf(0.9)), 1.0)):
        for ending, value, least in (("", true, 0.90), ("_gap", none, 0.93)):
            low, high = (gap[f"{name}{ending}{end}"] for end in ("_low", "_high"))
            covered = float(((low <= value) & (value <= high)).mean())
            claim("95 % intervals of photographs, and of their gap to simulations",
                  "1,000 simulated sets of 13 or 22", max(0.0, 95 - 100 * covered), "% below 95 %")
            assert covered > least
