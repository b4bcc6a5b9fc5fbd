"""Scenes of a store looked at again: the best, the median, the worst, a flip, and each failure.

They are chosen by reading the store a piece at a time, then rendered once more, here; what is
found must be what the store holds, and where it is not the page says so.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.errors import SweepError
from sweep.evaluation.inspection import SceneInspection, inspect_scene
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.cell_selection import at_text, cell, coordinates_text
from sweep.plan.experiment import Pipeline
from sweep.plan.schema import SCHEMA
from sweep.report.report_data import AREA, NEEDED, Subject, reading
from sweep.report.scene_drawing import LINE_HEIGHT, MAX_SIDE, draw_scene
from sweep.report.table import number
from sweep.typing import Floats

PIECE = 2_000_000
"""Results that are read at once."""

BINS = 1200
MIN_ERROR, MAX_ERROR = 1e-9, 180.0
"""Degrees; the median is known to one of the bins between them, 2 % wide."""

ANOTHER_POSE_DEG = 5.0
"""A flip that is shown changes the rotation by more."""

MARGIN = 0.35
"""Of the marker's side, shown around it."""

FAILURES = (
    DetectionStatus.wrong_id,
    DetectionStatus.rejected,
    DetectionStatus.no_candidate,
    DetectionStatus.failed,
    DetectionStatus.crashed,
    EstimateStatus.solver_failed,
    EstimateStatus.not_converged,
    EstimateStatus.not_explained,
    EstimateStatus.failed,
    EstimateStatus.crashed,
)
WORDS = {
    "wrong_id": "decoded as another ID", "rejected": "a candidate that could not be decoded",
    "no_candidate": "not found at all", "failed": "an exception was raised",
    "crashed": "the process died", "solver_failed": "found, but no pose",
    "not_converged": "the likelihood's maximum was not reached",
    "not_explained": "the pixels are not explained",
}

Index = dict[str, int]

@dataclass(frozen=True, slots=True)
class Scene:
    """One scene of the gallery; ``picture`` is a PNG, or None where ``problem`` says why not."""

    titles: tuple[str, ...]
    coordinates: str
    command: str
    told: str
    alt: str
    picture: bytes | None
    size: tuple[int, int] = (0, 0)
    problem: str = ""


@dataclass(slots=True)
class _Found:
    """The best so far of each thing that is looked for: how good it is, and where it lies."""

    best: dict[str, tuple[float, Index]] = field(default_factory=dict)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, dtype=np.int64))
    members: dict[int, Index] = field(default_factory=dict)

    def offer(self, name: str, merits: Floats, index: Mapping[str, NDArray[np.intp]]) -> None:
        """Take the candidate with the largest merit if it beats what is there."""
        if not merits.size:
            return
        k = int(np.argmax(merits))
        if name not in self.best or merits[k] > self.best[name][0]:
            self.best[name] = float(merits[k]), {d: int(i[k]) for d, i in index.items()}

    def median(self) -> Index | None:
        """Return where an error in the median's bin lies."""
        total = int(self.counts.sum())
        if total == 0:
            return None
        return self.members[int(np.searchsorted(np.cumsum(self.counts), (total + 1) // 2))]


def scenes_of(subject: Subject) -> Iterator[Scene]:
    """Yield the scenes of a store's gallery; two that are the same are one."""
    chosen: dict[tuple[tuple[str, int], ...], list[str]] = {}
    with reading(subject.store):
        listed = list(_chosen(subject.results))
    for title, index in listed:
        chosen.setdefault(tuple(sorted(index.items())), []).append(title)
    for key, titles in chosen.items():
        yield _scene(subject, dict(key), tuple(titles))


# Which.

def _chosen(results: xr.Dataset) -> Iterator[tuple[str, Index]]:
    """Yield a title and where it lies, for each that occurs."""
    found = _scan(results)
    listed = {
        "best": "best: the smallest rotation error", "worst": "worst: the largest rotation error",
        "worst_unflipped": "worst without a flip", "flipped": "flipped to the mirrored pose",
    }
    if "best" in found.best:
        yield listed.pop("best"), found.best["best"][1]
    median = found.median()
    if median is not None:
        yield "median rotation error of the solved", median
    for name, title in listed.items():
        if name in found.best:
            yield title, found.best[name][1]
    for flag in FAILURES:
        name = f"{type(flag).__name__} {flag.name}"
        if name in found.best:
            shown = flag.name.replace("_", " ")
            yield f"{shown}: {WORDS[flag.name]}", found.best[name][1]


def _scan(results: xr.Dataset) -> _Found:
    found = _Found()
    names = ("estimate", "rotation_error_deg", "flipped", "detection", AREA)
    for offsets, piece in _pieces(results[list(names)].reset_coords(drop=True)):
        dims = tuple(str(dim) for dim in piece["estimate"].dims)
        estimate, error, flipped = (piece[name].values for name in names[:3])
        area = piece[AREA].broadcast_like(piece["estimate"]).transpose(*dims).values
        area = np.nan_to_num(area, nan=-1.0, posinf=-1.0)

        def where(
            mask: NDArray[np.bool_], dims: tuple[str, ...] = dims, offsets: Index = offsets
        ) -> dict[str, NDArray[np.intp]]:
            return {
                dim: indices + offsets[dim]
                for dim, indices in zip(dims, np.nonzero(mask), strict=True)
            }

        solved = (estimate == EstimateStatus.solved) & np.isfinite(error)
        index = where(solved)
        errors = error[solved].astype(np.float64)
        found.offer("best", -errors, index)
        found.offer("worst", errors, index)
        mirrored = flipped == Flipped.flipped
        kept = solved & ~mirrored
        found.offer("worst_unflipped", error[kept].astype(np.float64), where(kept))
        mirrored &= solved & (error > ANOTHER_POSE_DEG)
        found.offer("flipped", area[mirrored], where(mirrored))
        _count(found, errors, index)
        detected = piece["detection"].broadcast_like(piece["estimate"]).transpose(*dims).values
        for flag in FAILURES:
            flagged = (detected if isinstance(flag, DetectionStatus) else estimate) == flag
            # The larger the marker, the more surprising.
            found.offer(f"{type(flag).__name__} {flag.name}", area[flagged], where(flagged))
    for name in ("failed", "crashed"):  # told once, by the stage where it happened
        if f"Detection {name}" in found.best:
            found.best.pop(f"Estimate {name}", None)
    return found


def _count(found: _Found, errors: Floats, index: Mapping[str, NDArray[np.intp]]) -> None:
    clipped = np.clip(errors, MIN_ERROR, MAX_ERROR)
    share = np.log(clipped / MIN_ERROR) / math.log(MAX_ERROR / MIN_ERROR)
    bins, first, counts = np.unique(
        np.minimum((share * BINS).astype(np.int64), BINS - 1), return_index=True,
        return_counts=True)
    found.counts[bins] += counts
    for number_, k in zip(bins.tolist(), first.tolist(), strict=True):
        found.members.setdefault(number_, {d: int(i[k]) for d, i in index.items()})


def _pieces(results: xr.Dataset) -> Iterator[tuple[Index, xr.Dataset]]:
    """Yield the results in pieces of whole chunks, each with where it begins."""
    sizes = {str(dim): size for dim, size in results["estimate"].sizes.items()}
    chunks = {str(dim): edges for dim, edges in results["estimate"].chunksizes.items()}
    room = PIECE
    cuts: dict[str, list[int]] = {}
    for dim in reversed(list(sizes)):
        length = chunks.get(dim, (sizes[dim],))[0]
        step = min(sizes[dim], max(length, room // length * length))
        cuts[dim] = list(range(0, sizes[dim], step))
        room = max(1, room // step)
        sizes[dim] = step
    for starts in itertools.product(*(cuts[dim] for dim in sizes)):
        offsets = dict(zip(sizes, starts, strict=True))
        box = {dim: slice(start, start + sizes[dim]) for dim, start in offsets.items()}
        yield offsets, results.isel(box).load()


# Looked at again.

def _scene(subject: Subject, index: Index, titles: tuple[str, ...]) -> Scene:
    with reading(subject.store):
        stored = subject.results[list(NEEDED)].isel(index).load()
    at = at_text({
        axis.name: axis.values[index[axis.name]] for axis in subject.pipeline.axes
    })
    command = f"sweep show {pipeline_file(subject.pipeline)}"
    command += f" --at {shlex.quote(at)}" if at else ""
    flags = _flags(stored)
    plain = Scene(titles, at.replace(",", ", "), command, flags, "", None)
    if "crashed" in flags:
        return dataclasses.replace(
            plain, problem="Not drawn: it ended its process; `sweep repro` tries again.")
    try:
        one = cell(subject.pipeline, at)
        seen = inspect_scene(one)
        plain = dataclasses.replace(plain, coordinates=coordinates_text(subject.pipeline, one))
        picture = _picture(seen)
    except (SweepError, OSError, ValueError, cv2.error, np.linalg.LinAlgError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        return dataclasses.replace(plain, problem=f"Cannot be drawn here: {reason}")
    _, encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    told = _told(seen)
    return dataclasses.replace(
        plain, told=told, picture=encoded.tobytes(), problem=_differences(seen, stored),
        size=(picture.shape[1], picture.shape[0]),
        alt=f"Rendered marker with the true outline and what was found: {told}",
    )


def pipeline_file(pipeline: Pipeline) -> str:
    """Return the name of the file with a pipeline's text, as commands take it."""
    return shlex.quote(f"{pipeline.name}.toml")


def _picture(seen: SceneInspection) -> NDArray[np.uint8]:
    """Return the drawn scene without the caption, cut to the marker and its surroundings."""
    cut = _cut(seen)
    height, width = cut.image.shape
    scale = max(1, min(MAX_SIDE // max(height, width), 24))
    page = draw_scene(cut, "")
    # The caption of a picture that stands alone is not needed: a page says more, as text.
    bottom = page.shape[0] - (LINE_HEIGHT * 3 + 20)
    left = (page.shape[1] - width * scale) // 2
    return np.ascontiguousarray(page[:bottom, left : left + width * scale])


def _cut(seen: SceneInspection) -> SceneInspection:
    corners = seen.true_corners
    left, top, right, bottom = seen.window
    if not np.isfinite(corners).all():
        return seen
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = max(4.0, MARGIN * float((high - low).max()))
    x0, y0 = np.maximum(np.floor(low - margin), (left, top)).astype(int)
    x1, y1 = np.minimum(np.ceil(high + margin) + 1, (right, bottom)).astype(int)
    if x1 - x0 < 4 or y1 - y0 < 4:
        return seen
    image = seen.image[y0 - top : y1 - top, x0 - left : x1 - left]
    return dataclasses.replace(
        seen, image=np.ascontiguousarray(image), window=(int(x0), int(y0), int(x1), int(y1)))


def _flags(stored: xr.Dataset) -> str:
    detection = DetectionStatus(int(stored["detection"]))
    estimate = EstimateStatus(int(stored["estimate"]))
    names = [detection.name]
    if estimate not in {EstimateStatus.solved, EstimateStatus.no_detection, EstimateStatus.not_run}:
        names.append(estimate.name)
    return ", ".join(name.replace("_", " ") for name in dict.fromkeys(names))


def _told(seen: SceneInspection) -> str:
    """Return what was found, and how far off it is, in words."""
    parts = [seen.detection.name.replace("_", " "), f"area {number(seen.area_px)} px\u00b2"]
    if seen.detection is DetectionStatus.detected and seen.estimate is not EstimateStatus.solved:
        parts.append(seen.estimate.name.replace("_", " "))
    rotation = seen.errors["rotation_error_deg"]
    if math.isfinite(rotation):
        parts += [
            f"rotation off by {number(rotation)}\u00b0",
            f"position by {number(1000 * seen.errors['translation_error_m'])} mm",
            f"reprojection {number(seen.errors['reprojection_error_px'])} px",
        ]
    return ", ".join(parts)


def _differences(seen: SceneInspection, stored: xr.Dataset) -> str:
    """Return where a scene looked at again is not what the store holds; empty where it is."""
    told: list[str] = []
    pairs: Sequence[tuple[str, Any, Any]] = [
        ("detection", DetectionStatus(int(stored["detection"])), seen.detection),
        ("estimate", EstimateStatus(int(stored["estimate"])), seen.estimate),
    ]
    told += [
        f"{name} is {now.name}, in the store {then.name}"
        for name, then, now in pairs if then != now
    ]
    scalars = [v.name for v in SCHEMA if v.inner == () and v.name in seen.errors]
    for name in (scalars if not told else []):
        # The store holds single precision.
        then, now = float(stored[name]), float(np.float32(seen.errors[name]))
        if then != now and not (math.isnan(then) and math.isnan(now)):
            told.append(f"{name} is {now:.6g}, in the store {then:.6g}")
    if not told:
        return ""
    return f"Not what the store holds: {'; '.join(told[:3])}."
