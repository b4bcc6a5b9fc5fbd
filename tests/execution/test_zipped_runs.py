"""Runs over axes of parameters that go together: the same cells, however they are declared."""

import numpy as np
import pytest

import sweep
from sweep.analysis import compare, detection_rate
from sweep.errors import DatasetError, StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.reuse import match
from sweep.execution.status import close
from sweep.store.lifecycle import create_store, open_dataset, open_store
from sweep.store.provenance import differences

BASE = {
    "seed": 3,
    "pose": {"jitter_px": 0.5, "distance_m": 0.4, "tilt_deg": {"uniform": [0, 50]}},
    "scene": {"background": 255},
}
ZIPPED = {
    "lens": {"zip": {"fx_px": [600, 800], "fy_px": [600, 805]}},
    "trial": 3,
    "how": {"zip": {"solver": ["ippe", "iterative", "ippe"], "guarded": [True, True, False]}},
}
APART = {
    "fy_px": [700, 600, 805], "trial": 4, "solver": ["iterative", "ippe"],
    "fx_px": [600, 800], "guarded": [True, False],
}


def computed(path, axes, extents, reuse=()):
    """Return a closed store's dataset, and how many estimates were computed for it."""
    pipeline = sweep.Pipeline.from_dict(BASE | {"axes": axes})
    url = str(path)
    store = create_store(url, pipeline, extents)
    receipts = [compute_block(url, store.run_id, block, reuse) for block in store.blocks]
    close(store)
    return open_dataset(url), sum(receipt.computed["estimates"] for receipt in receipts)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("zipped")


@pytest.fixture(scope="module")
def zipped(folder):
    return computed(folder / "zipped.zarr", ZIPPED, (1, 3))[0].load()


@pytest.fixture(scope="module")
def apart(folder):
    return computed(folder / "apart.zarr", APART, (3, 2, 2))[0].load()


def cells(zipped, apart):
    """Yield the same cells of both grids."""
    for k, (fx, fy) in enumerate(((600, 600), (800, 805))):
        for j, (solver, guarded) in enumerate(
            (("ippe", True), ("iterative", True), ("ippe", False))
        ):
            yield zipped.isel(lens=k, how=j), apart.sel(
                fx_px=fx, fy_px=fy, solver=solver, guarded=guarded, trial=slice(0, 2)
            )


def test_each_member_is_a_coordinate_over_the_dimension(zipped):
    assert zipped["lens"].values.tolist() == ["600, 600", "800, 805"]
    assert zipped["fy_px"].dims == ("lens",)
    # Lenses are other scenes with draws of their own; settings see the same draws.
    assert detection_rate(zipped).draws.item() == 2 * 3
    with pytest.raises(DatasetError, match="not the same scenes"):
        compare(zipped.isel(lens=0), zipped.isel(lens=1))
    assert zipped.sel(lens="800, 805").fy_px.item() == 805
    assert zipped["solver"].values.tolist() == ["ippe", "iterative", "ippe"]
    assert zipped["guarded"].values.tolist() == [True, True, False]
    assert zipped["fx_px"].attrs["units"] == "px"


def test_cells_are_reused_between_both_declarations(folder, zipped, apart):
    grown = {**ZIPPED, "lens": {"zip": {"fx_px": [800, 700, 600], "fy_px": [805, 700, 600]}}}
    ours, count = computed(folder / "a.zarr", grown, (2, 3), (str(folder / "zipped.zarr"),))
    assert count == 3 * 3
    np.testing.assert_array_equal(ours.isel(lens=2).nees, zipped.isel(lens=0).nees)
    ours, count = computed(folder / "b.zarr", grown, (2, 2), (str(folder / "apart.zarr"),))
    assert count == 3 * 3
    for mine, theirs in cells(ours.isel(lens=[2, 0]), apart):
        np.testing.assert_array_equal(mine.rotation_error_rad, theirs.rotation_error_rad)
        np.testing.assert_array_equal(mine.tilt_deg, theirs.tilt_deg)
    ours, count = computed(
        folder / "c.zarr", APART, (1, 4, 2), (str(folder / "zipped.zarr"),)
    )
    assert count == 3 * 4 * 2 * 2 * 2 - 2 * 3 * 3
    for name in apart.data_vars:
        np.testing.assert_array_equal(ours[name], apart[name], err_msg=str(name))
    # With other names, partly fixed, and along one axis only.
    fixed = {"optics": {"zip": {"fy_px": [805, 900], "fx_px": [800, 800]}}, "trial": 2}
    _, count = computed(folder / "d.zarr", {
        **fixed, "solver": ["ippe"], "guarded": [False],
    }, (2, 2), (str(folder / "zipped.zarr"), str(folder / "apart.zarr")))
    assert count == 2


@pytest.mark.usefixtures("zipped")
def test_grids_without_a_common_cell_are_refused(folder):
    crossed = sweep.Pipeline.from_dict(BASE | {"axes": {
        **ZIPPED, "lens": {"zip": {"fx_px": [600, 800], "fy_px": [805, 600]}},
    }})
    with pytest.raises(StoreError, match="lens: no values of fx_px, fy_px go together in both"):
        match(crossed, open_store(str(folder / "zipped.zarr")))
    store = open_store(str(folder / "zipped.zarr"))
    lines = differences(crossed, store.pipeline, store.fingerprint)
    assert lines == ["axes.lens: the store has 600, 600, 800, 805, this run 600, 805, 800, 600"]
