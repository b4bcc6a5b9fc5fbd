"""Stores whose sampling stopped at different trials: pooled values and intervals that hold."""

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.small_datasets import perfect, with_detected
from sweep.analysis import (
    ambiguity,
    compare,
    detection_rate,
    error_statistics,
    failure_composition,
    precision_reached,
)
from sweep.analysis.comparisons import regressions
from sweep.analysis.dataset import sampling_text
from sweep.analysis.requirements import Reached
from sweep.errors import DatasetError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

TRIALS = 200
STOPPED_AT = np.array([50, 200, 100])
"""Trials of three sides: the hard one has most."""

RATES = np.array([0.9, 0.3, 1.0])

PIPELINE = """
seed = 1
marker = { size_m = 0.05 }
pose = { jitter_px = 0.5 }
search = { precision = { detection_rate = 0.08 }, max_trials = 200 }
axes = { side_px = [10, 20, 30], solver = ["ippe", "iterative"] }
"""


@pytest.fixture(scope="module")
def full():
    """Return the store of all trials, with errors that grow with the side."""
    rng = np.random.default_rng(5)
    seen = rng.random((3, TRIALS)) < RATES[:, None]
    error = rng.normal(size=(3, TRIALS, 2, 3)) * 0.01 * np.array([1, 2, 3])[:, None, None, None]
    results = with_detected(perfect(
        rng, {"side_px": 3, "trial": TRIALS, "solver": 2}, rotation=error, position=error), seen)
    results["true_tvec_m"].values[...] = 1.0
    flips = (rng.random((3, TRIALS, 2)) < 0.1) & (results["flipped"] == Flipped.not_flipped)
    results["flipped"] = results["flipped"].where(~flips, Flipped.flipped)
    solved = results["estimate"] == EstimateStatus.solved
    return results.assign(
        reprojection_error_px=solved * 0.1, alternative_reprojection_error_px=solved * 0.4,
    ).assign_coords(side_px=[10, 20, 30]).drop_attrs()


@pytest.fixture(scope="module")
def stopped(full):
    """Return the store of the trials that were needed, as `sweep.open` has it."""
    run = xr.DataArray(np.arange(TRIALS) < STOPPED_AT[:, None], dims=("side_px", "trial"))
    flags = {name: full[name].where(run, kind.not_needed).astype(np.uint8) for name, kind in (
        ("detection", DetectionStatus), ("estimate", EstimateStatus), ("flipped", Flipped))}
    return full.where(run).assign(flags).assign_attrs(pipeline=PIPELINE)


def test_conditions_have_all_their_trials_and_clopper_and_pearsons_interval(stopped, full):
    table = detection_rate(stopped, ["side_px"])
    assert table.looked_for.values.tolist() == STOPPED_AT.tolist()
    for k, n in enumerate(STOPPED_AT.tolist()):
        hits = int((full.detection.values[k, :n] == 1).sum())
        ends = stats.binomtest(hits, n).proportion_ci(0.97, method="exact")
        found = [table[f"detection_rate{end}"].values[k] for end in ("", "_low", "_high")]
        assert found == pytest.approx([hits / n, *ends], rel=1e-9)


def test_what_is_pooled_is_pooled_over_the_trials_that_all_have(stopped, full):
    """Else the side of which most trials were run would weigh most."""
    common = full.isel(trial=slice(0, 50))
    for analysis in (detection_rate, failure_composition, ambiguity, error_statistics):
        ours, expected = analysis(stopped), analysis(common)
        for name in expected.data_vars:
            exact = name.endswith(("_low", "_high", "_interval", "count")) or (
                name.startswith("chosen") or name == "choice")
            if not exact:
                np.testing.assert_allclose(ours[name].values, expected[name].values)
    plain = (stopped.detection == 1).sum() / stopped.detection.isin(range(1, 5)).sum()
    assert abs(plain - detection_rate(stopped).detection_rate) > 0.05  # the trap


def test_a_dataset_says_which_rule_stopped_its_sampling(stopped, full):
    assert sampling_text(stopped) == (
        "stopped by [search]: precision = {detection_rate = 0.08}, max_trials = 200")
    assert not sampling_text(full)


def test_cells_in_which_nothing_was_looked_for_do_not_lessen_the_trials(stopped):
    flags = stopped.detection.copy()
    flags[0, :50] = DetectionStatus.not_visible
    assert detection_rate(stopped.assign(detection=flags)).looked_for == 2 * 100


def test_stores_that_stopped_at_other_trials_are_compared_on_the_common_ones(stopped, full):
    other = full.isel(trial=slice(0, 150))
    for pair in ((stopped, other), (other, stopped)):
        table = compare(*(side.sel(solver="ippe") for side in pair), ["side_px"])
        assert table.compared.values.tolist() == [50, 150, 100]
        assert table.run_in_one.values.tolist() == [100, 0, 50]
        assert (table.only_first_detected == 0).all()
        assert (table.different_scenes == 0).all()
    pooled = compare(*(side.sel(solver="ippe") for side in (stopped, other)))
    assert pooled.compared == 3 * 50


def test_what_was_reached_is_told_by_condition(stopped):
    table = precision_reached(stopped)
    assert table.wanted.values.tolist() == [0.08]
    assert table.run.isel(solver=0).values.tolist() == STOPPED_AT.tolist()
    assert (table.poses == TRIALS).all()
    named = [Reached(each).name for each in table.reached.isel(solver=0, quantity=0).values]
    assert named == ["not_reached", "reached", "reached"]
    assert table.settled.values.tolist() == [each == "reached" for each in named]
    half = detection_rate(stopped, ["side_px"])
    np.testing.assert_allclose(
        table.half_width.isel(solver=0, quantity=0),
        (half.detection_rate_high - half.detection_rate_low) / 2)


def test_stores_without_a_common_trial_are_not_paired(stopped):
    with pytest.raises(DatasetError, match="there are no poses: trial has no values"):
        compare(stopped.isel(trial=slice(9)), stopped.isel(trial=slice(9, None)))


def test_an_attribute_of_another_program_and_a_missing_variable_are_told_apart(full):
    assert detection_rate(full.assign_attrs(sweep="of another program")).equals(
        detection_rate(full))
    with pytest.raises(DatasetError, match="no variable rotation_error_rad; there are"):
        regressions(full.drop_vars("rotation_error_rad"), full)
