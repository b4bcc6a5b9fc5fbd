"""The files of a store, and damage to them that its checksums do not show."""

import json
from pathlib import Path

import numpy as np
import zarr

from sweep.store.lifecycle import CHECKSUM, _checksum, _sealed


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
