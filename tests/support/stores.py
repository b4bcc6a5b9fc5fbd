"""Stores computed in this process, their bits, and damage that their checksums do not show."""

import itertools
import json
from pathlib import Path

import numpy as np
import xarray as xr
import zarr

from sweep.execution.block_task import compute_block
from sweep.execution.waves import InWaves
from sweep.experiment.grid import TRIAL
from sweep.sampling.rules import make_rule
from sweep.store.lifecycle import CHECKSUM, _checksum, _sealed, create_store

GRID = """
seed = 11
marker = { size_m = 0.04 }
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
scene = { background = 128 }
[axes]
distance_m = [0.2, 0.3, 0.4]
cornerRefinementMethod = ["none", "subpix"]
tilt_deg = [10, 45]
solver = ["ippe_square", "iterative"]
trial = 8
"""
"""A grid of 96 scenes with axes of every stage."""


def by_hand(url, pipeline, extents=None, numbers=None):
    """Compute a store in this process, without a cluster; as one block unless extents are given.

    In waves, extents are such that a block is of one wave. With ``numbers``, these blocks alone.
    """
    rule = make_rule(pipeline)
    lengths = tuple(
        rule.ends[0] if rule and axis.name == TRIAL else len(axis)
        for axis in pipeline.experiment.scene_axes
    )
    store = create_store(url, pipeline, extents or lengths)
    if rule is None:
        for number in range(len(store.blocks)) if numbers is None else numbers:
            compute_block(url, store.run_id, store.blocks[number])
    else:
        in_waves(store)
    return store


def in_waves(store, most=None):
    """Compute blocks of a store in this process by its pipeline's rule; return how many."""
    waves, count = InWaves(store), 0
    for number, decision in itertools.chain.from_iterable(waves):
        if most is not None and count >= most:
            break
        waves.committed(number, compute_block(
            store.url, store.run_id, store.blocks[number], decision=decision))
        count += 1
    return count


def same(a, b):
    """Tell whether two stores hold the same decoded values, bit for bit."""
    one, other = (xr.load_dataset(url, engine="zarr", consolidated=False) for url in (a, b))
    assert set(one.variables) == set(other.variables)
    for name in one.variables:
        x, y = one[name].to_numpy(), other[name].to_numpy()
        if x.dtype.kind == "f":
            x, y = x.view(f"u{x.itemsize}"), y.view(f"u{y.itemsize}")
        if not (x == y).all():
            return False
    return True


def files(url):
    """Return the paths of a store's files below it."""
    return sorted(path.relative_to(url).as_posix() for path in Path(url).rglob("*")
                  if path.is_file())


def edit_root(url, change):
    """Change the attributes of the root, and make the checksum of them fit, as a forger would."""
    path = Path(url) / "zarr.json"
    root = json.loads(path.read_text())
    attributes = root["attributes"]
    metadata = json.loads(attributes["sweep"])
    change(attributes, metadata)
    attributes["sweep"] = json.dumps(metadata)
    if isinstance(attributes["pipeline"], str):
        attributes[CHECKSUM] = _checksum(attributes)
    path.write_text(json.dumps(_sealed(root)))


def editable(url, name):
    """Return an array of a store that writes every chunk, as sweep does, also of fill values."""
    array = zarr.open_array(f"{url}/{name}", mode="r+", zarr_format=3)
    return array.with_config({"write_empty_chunks": True})


def edit_receipt(url, number, change):
    """Change a receipt's content; its checksums are right afterwards."""
    array = editable(url, "commits/receipt")
    content = json.loads(str(np.asarray(array[number])))
    changed = change(content)
    text = changed if isinstance(changed, str) else json.dumps(changed or content)
    array[number : number + 1] = np.array([text], dtype=object)
