"""What killed processes left of stores and in them, and its removal."""

from __future__ import annotations

import contextlib
import glob
import shutil
import time
import uuid
from pathlib import Path

from sweep.store.blocks import BEGUN, committed
from sweep.store.locations import is_remote
from sweep.store.run_store import RunStore, list_folder
from sweep.store.schema_check import GROUPS
from sweep.store.zarr_sync import sync

ABANDONED_S = 3600.0
"""Age from which a partly created store counts as abandoned."""


def tidy(store: RunStore) -> None:
    """Delete what killed processes left in a local store; no other process may be writing it.

    Zarr warns of unknown files among its groups; elsewhere they are harmless.
    """
    if is_remote(store.url):
        return
    root = Path(store.url).resolve()
    for folder in ("", *GROUPS, *(f"{name}/*" for name in GROUPS)):
        for path in root.glob(f"{folder}/*.partial".lstrip("/")):
            if path.parent.resolve().is_relative_to(root):
                path.unlink(missing_ok=True)
    done = committed(store)
    for mark in sync(list_folder(store.storage, BEGUN)):
        if mark.isdecimal() and int(mark) in done:
            sync(store.storage.delete(f"{BEGUN}/{mark}"))


def beside(url: str, ending: str) -> Path:
    """Return an unused path in the folder of a local store, which may lie behind a link."""
    path = Path(url).resolve()
    return path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.{ending}")


def tidy_beside(url: str) -> None:
    """Delete what killed processes left of stores that they were creating or deleting here."""
    real = Path(url).resolve()
    for ending, age_s in (("deleted", 0.0), ("new", ABANDONED_S)):
        for path in real.parent.glob(f".{glob.escape(real.name)}.*.{ending}"):
            with contextlib.suppress(OSError):
                if path.stat().st_mtime <= time.time() - age_s:
                    shutil.rmtree(path, ignore_errors=True)
