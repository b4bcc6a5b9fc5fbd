"""Export of an experiment: its images, their truth, and camera files, in a folder."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import multiprocessing
import re
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jinja2 import Template

from sweep.errors import ArgumentError, RunError, StoreError
from sweep.evaluation.opencv_threads import single_threaded
from sweep.exchange.images import (
    BATCH,
    ImageBatch,
    image_batch,
    write_errors,
    write_truth,
)
from sweep.execution.forecast import free_disk
from sweep.experiment.pipeline import Pipeline
from sweep.messages import byte_count, plain
from sweep.model.renderers import render
from sweep.store.files import write_whole
from sweep.store.provenance import environment, fingerprint

# --------------------------------------------------------------------------------------------------
# Export of an experiment: its images, their truth, and camera files, in a folder.

MARK = "export.json"
"""The file by which a folder is known as an export; it says of what."""

CHECKSUMS = "images.sha256"
"""Digests of the images that are written, as ``sha256sum -c`` reads them."""

GUIDE = Path(__file__).with_name("readme.md.jinja")
"""The README of an export: what is in the folder, its conventions, and how answers come back."""

EXPERIMENT = "experiment"
"""Folder of the pipeline and of the files that it names."""

FORMAT = 1

MAX_BYTES = 10 * 10**9
"""Larger exports have to be confirmed."""

MAX_SCENES = 10**6
"""Larger experiments are not exported: their names are listed in memory."""

SAMPLE = 8
"""Images by which the size of all is estimated."""


@dataclass(frozen=True, slots=True)
class Export:
    """What an export did.

    Attributes
    ----------
    folder
        Where it lies.
    images, invisible
        Scenes with an image, and scenes without: the marker is not visible, or the lens folds.
    written, kept, damaged
        Images that were rendered now; that were there; and of those rendered now, those that an
        earlier export had listed, and that were missing or had been changed.
    bytes
        Size of the images.
    cameras
        Distinct cameras.
    seconds
        How long it took.
    """

    folder: str
    images: int
    invisible: int
    written: int
    kept: int
    damaged: int
    bytes: int
    cameras: int
    seconds: float


def export(
    pipeline: Pipeline,
    folder: str | Path,
    *,
    windowed: bool = False,
    workers: int | None = None,
    yes: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Export:
    """Write the images of an experiment, their truth and camera files into a folder.

    A folder with an unfinished export of the same experiment is continued: images are written
    whole, so that those that are there are done, unless a finished export listed other digests.

    Parameters
    ----------
    pipeline
        The experiment.
    folder
        A new or empty folder, or one with an export of the same.
    windowed
        Whether images show the marker's surroundings, as a run searches them, instead of whole
        frames.
    workers
        Processes that render (default: this one).
    yes
        Export also what takes more than 10 GB, or more than is free on the disk.
    progress
        Called with the number of scenes that are done, and of all.

    Raises
    ------
    ArgumentError
        If ``workers`` is below 1.
    StoreError
        If the folder holds something else, or cannot be written, or there is too much to write.
    RunError
        If an image cannot be rendered.
    """
    started = time.perf_counter()
    if workers is not None and workers < 1:
        raise ArgumentError("workers", workers, "expected at least 1")
    target = Path(folder)
    count = len(pipeline.experiment.all_scenes)
    if count > MAX_SCENES:
        raise StoreError(
            f"{plain(target, 300)}: {count:,} scenes; at most {MAX_SCENES:,} are exported; choose "
            "some with --set, or export in parts"
        )
    with write_errors(target):
        mark = _mark(pipeline, windowed)
        begun = check_folder(target, mark)
        if not begun and not yes:
            _check_size(pipeline, target, count, windowed)
        (target / "images").mkdir(parents=True, exist_ok=True)
        if not begun:
            _write_experiment(pipeline, target)
            write_whole(target / MARK, json.dumps(mark, indent=2).encode() + b"\n")
        damaged = _remove_changed(target)
        digests: dict[str, str] = {}
        written = size = done = 0
        for part in _rendered_parts(pipeline, target, windowed, workers):
            digests |= part.digests
            written += part.written
            size += part.bytes
            done += part.scenes
            if progress is not None:
                progress(done, count)
        write_whole(target / CHECKSUMS, "".join(
            f"{digest}  {name}\n" for name, digest in sorted(digests.items())).encode())
        cameras, images, invisible = write_truth(pipeline, target, windowed=windowed)
        (target / "cameras").mkdir(exist_ok=True)
        for camera, name in cameras.items():
            path = target / "cameras" / name
            write_whole(path.with_suffix(".opencv.yml"), camera.opencv_yaml().encode())
            write_whole(path.with_suffix(".ros.yaml"), camera.ros_yaml(name).encode())
        write_whole(target / "README.md", Template(GUIDE.read_text(encoding="utf-8")).render(
            title=pipeline.heading, images=images, invisible=invisible,
            windowed=windowed, target=pipeline.target_word,
        ).encode())
    return Export(
        str(folder), images, invisible, written, len(digests) - written, damaged, size,
        len(cameras), time.perf_counter() - started,
    )


def check_folder(folder: Path, mark: dict[str, Any]) -> bool:
    """Return whether a folder holds an export with this mark, begun before; False if it is empty.

    Raises
    ------
    StoreError
        If it holds something else.
    """
    shown = plain(folder, 300)
    if not folder.exists():
        return False
    if not folder.is_dir():
        raise StoreError(f"{shown}: a file; choose a new folder")
    begun = read_mark(folder)
    if begun is None:
        strange = next((path.name for path in sorted(folder.iterdir())), None)
        if strange is None:
            return False
        raise StoreError(
            f"{shown}: holds {plain(strange)}, and no export; choose a new or an empty folder"
        )
    if begun == mark:
        return True
    lines = [
        f"  {key}: the folder has {plain(begun.get(key))}, this export {plain(mark.get(key))}"
        for key in sorted({*begun, *mark}) if begun.get(key) != mark.get(key)
    ]
    raise StoreError("\n".join([
        f"{shown}: holds another export; choose another folder", *lines,
    ]))


def read_mark(folder: Path) -> dict[str, Any] | None:
    """Return what an export's folder says of it; None if it is no export."""
    try:
        content = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return content if isinstance(content, dict) and "sweep_export" in content else None


def _mark(pipeline: Pipeline, windowed: bool) -> dict[str, Any]:
    """Return what makes two exports the same: the experiment, the versions, what images show."""
    made_by = fingerprint(pipeline)
    return {
        "sweep_export": FORMAT,
        "name": pipeline.name,
        "pipeline": hashlib.sha256(pipeline.text.encode()).hexdigest()[:16],
        "images": "windows" if windowed else "whole frames",
        "fingerprint": json.loads(json.dumps(made_by)),
        "sweep": environment()["sweep"],
    }


def _write_experiment(pipeline: Pipeline, folder: Path) -> None:
    """Write the pipeline, and copies of the files that it names by relative paths within."""
    home = folder / EXPERIMENT
    home.mkdir(exist_ok=True)
    for written in pipeline.files:
        path = Path(written.partition("#")[0])
        if path.is_absolute() or ".." in path.parts:
            continue
        copy = home / path
        copy.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileNotFoundError):
            write_whole(copy, (Path(pipeline.folder) / path).read_bytes())
    write_whole(home / "pipeline.toml", pipeline.text.encode())


def _remove_changed(folder: Path) -> int:
    """Delete the images that differ from the digests of an export that was finished here.

    Returns how many of the listed images were missing or had been changed.
    """
    try:
        text = (folder / CHECKSUMS).read_text(encoding="utf-8")
    except (FileNotFoundError, ValueError):
        return 0
    count = 0
    for digest, name in re.findall(r"^([0-9a-f]{64})  (images/[^/\n]+)$", text, re.MULTILINE):
        path = folder / name
        if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != digest:
            path.unlink(missing_ok=True)
            count += 1
    return count


class _Part(NamedTuple):
    """What became of a run of scenes: its images' paths and digests, counts, and bytes."""

    digests: dict[str, str]
    scenes: int
    written: int
    bytes: int


def _rendered_parts(
    pipeline: Pipeline, folder: Path, windowed: bool, workers: int | None
) -> Iterator[_Part]:
    """Yield the parts of an export, in this process or from several."""
    count = len(pipeline.experiment.all_scenes)
    parts = [range(start, min(start + BATCH, count)) for start in range(0, count, BATCH)]
    work = functools.partial(write_images, pipeline, folder, windowed)
    if workers is None or workers == 1 or len(parts) == 1:
        yield from map(work, parts)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        yield from pool.map(work, parts)


def write_images(pipeline: Pipeline, folder: Path, windowed: bool, numbers: range) -> _Part:
    """Write the images of scenes by their numbers that are missing.

    Raises
    ------
    RunError
        If an image cannot be rendered.
    """
    batch = image_batch(pipeline, np.array(numbers, dtype=np.intp), windowed=windowed)
    names = batch.names
    digests = {}
    written = size = 0
    for row in np.flatnonzero(batch.visible).tolist():
        name = f"images/{names[row]}.png"
        path = folder / name
        if path.exists():
            content = path.read_bytes()
        else:
            content = encoded_image(batch, row)
            write_whole(path, content)
            written += 1
        digests[name] = hashlib.sha256(content).hexdigest()
        size += len(content)
    return _Part(digests, len(numbers), written, size)


def encoded_image(batch: ImageBatch, row: int) -> bytes:
    """Return a scene's image as PNG; RunError if it cannot be rendered."""
    try:
        with single_threaded():
            x0, y0, x1, y1 = batch.windows[row].tolist()
            image = render(batch.scenes, row, batch.boxes[row], (x0, y0, x1, y1))
            _, encoded = cv2.imencode(".png", image)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError, cv2.error) as error:
        raise RunError(f"image {batch.names[row]}: {plain(error, 300)}") from None
    return bytes(encoded.tobytes())


def _check_size(pipeline: Pipeline, folder: Path, count: int, windowed: bool) -> None:
    """Refuse what is large, or more than fits: StoreError; by a sample of the images."""
    numbers = np.unique(np.linspace(0, count - 1, SAMPLE).astype(np.intp))
    batch = image_batch(pipeline, numbers, windowed=windowed)
    sizes: Sequence[int] = [
        len(encoded_image(batch, row)) for row in np.flatnonzero(batch.visible).tolist()
    ]
    # A file takes whole pages of the disk.
    total = int(count * (np.mean([-(-size // 4096) * 4096 for size in sizes]) if sizes else 0))
    free = free_disk(str(folder))
    found = []
    if total > MAX_BYTES:
        found.append(f"takes about {byte_count(total)}")
    if free is not None and total > free.bytes:
        found.append(f"takes about {byte_count(total)}, and {byte_count(free.bytes)} are free")
    if free is not None and free.files is not None and count > free.files:
        found.append(f"makes {count:,} files, and the disk has room for {free.files:,}")
    if found:
        raise StoreError(
            f"{plain(folder, 300)}: the export {' and '.join(dict.fromkeys(found[-1:]))}; choose "
            "fewer scenes, windows, or confirm it with --yes (in Python, yes=True)"
        )
