"""Stores computed in this process, and whether two of them hold the same bits."""

import xarray as xr

from sweep.execution.block_task import compute_block
from sweep.plan.grid import scene_axes
from sweep.store.lifecycle import create_store


def by_hand(url, pipeline, extents=None):
    """Compute a store in this process, without a cluster; as one block unless extents are given."""
    lengths = tuple(len(axis) for axis in scene_axes(pipeline))
    store = create_store(url, pipeline, extents or lengths)
    for block in store.blocks:
        compute_block(url, store.run_id, block)
    return store


def same(a, b):
    """Tell whether two stores hold the same decoded values, bit for bit."""
    with xr.open_zarr(a, consolidated=False) as one, xr.open_zarr(b, consolidated=False) as other:
        assert set(one.variables) == set(other.variables)
        for name in one.variables:
            x, y = one[name].to_numpy(), other[name].to_numpy()
            if x.dtype.kind == "f":
                x, y = x.view(f"u{x.itemsize}"), y.view(f"u{y.itemsize}")
            if not (x == y).all():
                return False
    return True
