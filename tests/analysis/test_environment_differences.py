"""What changes between environments is what plain NumPy counts, pose by pose."""

import numpy as np
import pytest
import xarray as xr

from support.example_results import example_results
from sweep.analysis.environments import changed_poses, environment_differences
from sweep.errors import ArgumentError, DatasetError
from sweep.measure.flags import DetectionStatus

NAMES = ["old", "new", "installed"]


@pytest.fixture(scope="module")
def results():
    return example_results()


@pytest.fixture(scope="module")
def made(results):
    """Three environments: in the second some poses are lost, in the third corners move."""
    flags = results["detection"].values.copy()
    detected = np.argwhere(flags == DetectionStatus.detected)
    flags[tuple(detected[0])] = DetectionStatus.wrong_id
    flags[tuple(detected[1])] = DetectionStatus.rejected
    second = results.assign(detection=(results["detection"].dims, flags))
    moved = second.assign(corner_error_px=second["corner_error_px"] + np.float32(0.25))
    return xr.concat([results, second, moved], dim="environment").assign_coords(environment=NAMES)


def test_changes_are_those_of_plain_numpy(made):
    table = environment_differences(made).compute()
    assert table["compared_with"].values.tolist() == ["old", "old", "new"]
    flags = made["detection"].transpose("environment", ...).values
    looked = np.isin(flags, [1, 2, 3, 4]).all(axis=0)
    for k in (1, 2):
        here = table.isel(environment=k)
        assert int(here["changed"].sum()) == ((flags[k] != flags[k - 1]) & looked).sum()
        assert int(here["compared"].sum()) == looked.sum()
    assert table["lost"].sum("environment").sum().item() == 2
    assert table["gained"].sum().item() == 0
    assert table["other_id"].sum().item() == 1
    both = int(((flags[1] == 1) & (flags[2] == 1)).sum())
    assert int(table["moved"].sel(environment="installed").sum()) == both
    assert table["corner_shift_rms_px"].sel(environment="installed").values == pytest.approx(0.25)
    assert int(table["moved"].sel(environment="new").sum()) == 0
    assert (table["rotation_shift_deg"].sel(environment="installed") == 0).all()


def test_a_reference_is_compared_with_all(made):
    table = environment_differences(made, "old").compute()
    assert table["compared_with"].values.tolist() == ["old"] * 3
    assert int(table["lost"].sel(environment="installed").sum()) == 2
    with pytest.raises(ArgumentError, match="reference = none: the environments are old, new, in"):
        environment_differences(made, "none")


def test_changed_poses_name_the_environment_that_changed_them(made):
    poses = list(changed_poses(made))
    assert [(pose["environment"], pose["before"], pose["since"]) for pose in poses] == [
        ("new", "detected", "wrong_id"), ("new", "detected", "rejected")]
    for pose in poses:
        at = {name: type(made[name].values[0].item())(text) for name, text in pose.items()
              if name not in ("before", "since", "environment")}
        before, since = made["detection"].sel(at).values[:2]
        assert DetectionStatus(before).name == pose["before"]
        assert DetectionStatus(since).name == pose["since"]
    assert len(list(changed_poses(made, 1))) == 1


def test_a_dataset_without_environments_is_refused(results):
    with pytest.raises(DatasetError):
        environment_differences(results)
