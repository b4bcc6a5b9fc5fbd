"""What the child process does with a detector under trial, in steps that the parent asks for."""

from __future__ import annotations

import contextlib
import os
import resource
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sweep.conformance.conventions import Found
from sweep.conformance.scenes import TrialScenes, trial_pipeline, trial_scenes
from sweep.errors import PluginError
from sweep.measure.detectors import FindFunction, make_detector
from sweep.typing import Floats, Integers

FRAME_SIDE_PX = 640

ODD_IMAGES: tuple[tuple[str, tuple[int, int], str], ...] = (
    ("grey", (480, 640), "a plain image"),
    ("black", (480, 640), "a black image"),
    ("noise", (480, 640), "an image of noise"),
    ("noise", (241, 319), "an image of 319 x 241 px"),
    ("noise", (37, 53), "an image of 53 x 37 px"),
    ("noise", (8, 8), "an image of 8 x 8 px"),
)
"""Content, shape and name of images without markers."""


@dataclass
class _State:
    """What this process keeps between steps."""

    scenes: TrialScenes | None = None
    find: FindFunction | None = None
    threads: int = 0
    processes: set[str] = field(default_factory=set)
    arguments: tuple[str, Sequence[str], str] = field(default=("", (), ""))


_state = _State()


@dataclass(frozen=True)
class Opened:
    """The truth of the scenes: IDs (N,), corners (N, 4, 2) px."""

    marker_id: Integers
    corners_px: Floats


@dataclass(frozen=True)
class Searched:
    """Results of searching scenes.

    Attributes
    ----------
    found
        The markers of each scene.
    faults
        What a plug-in raised, or what is wrong with what it returned; distinct lines.
    seconds
        Of each search.
    printed
        The beginning of what was printed meanwhile.
    threads, processes
        Threads, and child processes, more than before the detector was made.
    cpu_share
        Processor time over elapsed time.
    """

    found: list[list[tuple[int, Floats]]]
    faults: tuple[str, ...]
    seconds: list[float]
    printed: str
    threads: int
    processes: int
    cpu_share: float


def open_trial(detector: str, dictionary: str, settings: Sequence[str], folder: str) -> Opened:
    """Render the scenes; the detector is made by the first search."""
    cv2.setNumThreads(1)
    _state.arguments = (detector, settings, folder)
    _state.scenes = trial_scenes(trial_pipeline(detector, dictionary, settings, folder))
    _state.find = None
    _state.threads, _state.processes = _threads(), _processes()
    return Opened(_state.scenes.marker_id, _state.scenes.corners_px)


def search_scenes(order: Sequence[int]) -> Searched:
    """Search scenes in an order; the results are in the order of the scenes."""
    scenes = _scenes()
    found: list[list[tuple[int, Floats]]] = [[] for _ in scenes.images]
    faults: dict[str, None] = {}
    seconds = []
    began, used = time.perf_counter(), time.process_time()
    with _printed() as printed:
        for index in order:
            start = time.perf_counter()
            try:
                found[index] = _found(_find(), scenes.images[index], scenes.dictionary)
            except PluginError as error:
                faults[str(error)] = None
            seconds.append(time.perf_counter() - start)
    share = (time.process_time() - used) / max(time.perf_counter() - began, 1e-9)
    return Searched(
        found, tuple(faults), seconds, printed[0], _threads() - _state.threads,
        len(_processes() - _state.processes), share,
    )


def search_odd_image(index: int) -> str:
    """Search an image without markers; return what was raised, or nothing."""
    content, shape, _ = ODD_IMAGES[index]
    image = np.full(shape, 0 if content == "black" else 128, dtype=np.uint8)
    if content == "noise":
        image = np.random.default_rng(index).integers(256, size=shape).astype(np.uint8)
    try:
        _find()(image, _scenes().dictionary, max(shape))
    except PluginError as error:
        return str(error)
    return ""


def search_family(dictionary: str) -> tuple[Opened, list[Found]]:
    """Search eight scenes with markers of another dictionary, by a detector of its own."""
    detector, settings, folder = _state.arguments
    scenes = trial_scenes(trial_pipeline(detector, dictionary, settings, folder, count=8))
    find = make_detector(scenes.setting)
    found: list[Found] = [_found(find, image, dictionary) for image in scenes.images]
    return Opened(scenes.marker_id, scenes.corners_px), found


def search_again(count: int) -> tuple[int, int]:
    """Search ``count`` images; return the memory in bytes that is used before and afterwards."""
    scenes = _scenes()
    before = _memory()
    for index in range(count):
        with contextlib.suppress(PluginError):
            _find()(scenes.images[index % len(scenes.images)], scenes.dictionary, FRAME_SIDE_PX)
    return before, _memory()


def _scenes() -> TrialScenes:
    if _state.scenes is None:
        raise RuntimeError("no trial is open")
    return _state.scenes


def _find() -> FindFunction:
    if _state.find is None:
        _state.find = make_detector(_scenes().setting)
    return _state.find


def _found(
    find: Callable[..., Any], image: NDArray[np.uint8], dictionary: str
) -> list[tuple[int, Floats]]:
    corners, ids, _ = find(image, dictionary, max(image.shape))
    numbers = [] if ids is None else np.ravel(ids).tolist()
    return [
        (int(number), np.asarray(quad, dtype=np.float64).reshape(4, 2))
        for number, quad in zip(numbers, corners, strict=True)
    ]


@contextlib.contextmanager
def _printed() -> Iterator[list[str]]:
    """Collect what is written to the process' standard output and error, by compiled code too."""
    collected = [""]
    kept = [os.dup(1), os.dup(2)]
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
        try:
            yield collected
        finally:
            for number, copy in zip((1, 2), kept, strict=True):
                os.dup2(copy, number)
                os.close(copy)
            file.seek(0)
            collected[0] = file.read(200).decode(errors="replace")


def _threads() -> int:
    """Return the threads of this process, those included that Python does not know of."""
    try:
        return len(list(Path("/proc/self/task").iterdir()))
    except OSError:
        return threading.active_count()


def _processes() -> set[str]:
    """Return the processes that this one started and that still run."""
    try:
        return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())
    except OSError:
        return set()


def _memory() -> int:
    """Return the resident memory of this process in bytes."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
