"""A pipeline by the path of its file, or of a store that was made from it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sweep.errors import PipelineError
from sweep.messages import plain, refusal
from sweep.model.image_file import read_regular
from sweep.plan.experiment import Pipeline
from sweep.plan.overrides import apply_settings, parse_settings
from sweep.plan.required import texts_in
from sweep.plan.toml_text import MAX_BYTES, read_document


def names_store(path: str | os.PathLike[str]) -> bool:
    """Return whether a path or URL leads to a folder or a server, where no pipeline file is."""
    return "://" in os.fspath(path) or Path(path).is_dir()


def read_pipeline(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> Pipeline:
    """Return the pipeline of a TOML file, or that of a store.

    Parameters
    ----------
    path
        A TOML file, or the path or URL of a store.
    settings
        "key=value" with TOML values, as ``--set`` takes them.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid, or a folder is no store.
    StoreError
        If the store cannot be read.
    """
    if not names_store(path):
        return Pipeline.from_toml(os.fspath(path), settings)
    from sweep.store.lifecycle import open_store  # noqa: PLC0415  (slow to import)

    url = os.fspath(path)
    if "://" not in url and not (Path(url) / "zarr.json").exists():
        raise refusal([f"{plain(url)}: a folder that is no store; expected a TOML file or a store"])
    stored = open_store(url).pipeline
    return Pipeline.from_text(
        stored.text, settings, name=stored.name, source=f"{url} (its pipeline)",
        folder=stored.folder, camera_files=stored.files,
    )


def texts_required(path: str | os.PathLike[str], settings: Sequence[str] = ()) -> list[str]:
    """Return what a TOML file that has faults requires; nothing if it is no file of TOML."""
    try:
        document = read_document(read_regular(os.fspath(path), MAX_BYTES).decode())
        apply_settings(document, parse_settings(settings))
    except (OSError, ValueError, PipelineError):
        return []
    return texts_in(document)
