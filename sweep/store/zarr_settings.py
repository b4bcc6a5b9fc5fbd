"""Whether Zarr works as it is configured: what it cannot read is else taken for a damaged store."""

from __future__ import annotations

import gc
import json
import os
import sys
import warnings
from functools import cache
from typing import Any

import numpy as np
import zarr
from zarr.buffer import default_buffer_prototype
from zarr.storage import MemoryStore

from sweep.errors import StoreError
from sweep.messages import plain
from sweep.store.zarr_sync import sync


def check_zarr() -> None:
    """Check that Zarr reads what it writes.

    Raises
    ------
    StoreError
        If Python runs without assertions, or the user's configuration of Zarr makes that fail.
    """
    if sys.flags.optimize:
        raise StoreError(
            "Zarr cannot read groups where Python leaves out assertions; unset PYTHONOPTIMIZE, and "
            "run Python without -O"
        )
    if reason := _failure():
        given = [f"{name}={os.environ[name]}" for name in os.environ if name.startswith("ZARR_")]
        raise StoreError(plain(
            f"Zarr does not work with its configuration ({', '.join(given) or '~/.config/zarr'}): "
            f"{reason}; correct it, or take it away", 600,
        ))


@cache
def _failure() -> str:
    """Return why a configuration that is not Zarr's own does not work, empty if it does."""
    configuration: Any = zarr.config
    if [configuration.config] == configuration.defaults:
        return ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of coroutines that were never begun
        reason = ""
        try:
            _write_and_read()
        except Exception as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
        gc.collect()
    return reason


def _write_and_read() -> None:
    storage = MemoryStore()
    group = zarr.create_group(storage, zarr_format=3)
    numbers = group.create_array("numbers", shape=(4,), chunks=(2,), dtype="float64")
    texts = group.create_array("texts", shape=(2,), chunks=(1,), dtype=str)
    numbers[:] = np.arange(4)
    texts[:] = np.array(["a", "b"], dtype=object)
    document = sync(storage.get("zarr.json", default_buffer_prototype()))
    json.loads(document.to_bytes() if document is not None else b"")
    again = zarr.open_group(storage, mode="r", zarr_format=3)
    for name, wanted in (("numbers", [0, 1, 2, 3]), ("texts", ["a", "b"])):
        array = again[name]
        if not isinstance(array, zarr.Array) or np.asarray(array[:]).tolist() != wanted:
            raise ValueError(f"an array of {name} is read with other values than it was written")
