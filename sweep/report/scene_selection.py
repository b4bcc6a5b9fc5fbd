"""Example scenes of a store: the best, the median, the worst, a flip, and one of each failure.

The store is read a piece at a time; only the best candidate of each kind is kept.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.measure.flags import DetectionStatus, EstimateStatus, Flag, Flipped
from sweep.report.figure import uncapitalised
from sweep.report.grouping import AREA
from sweep.typing import Floats

MAX_PIECE = 2_000_000
"""Results that are read at once."""

BINS = 1200
MIN_ERROR, MAX_ERROR = 1e-9, 180.0
"""Degrees; the median is known to one of :data:`BINS` bins between them, 2 % wide."""

MIN_FLIP_DEG = 5.0
"""The rotation error of a flip that is shown exceeds this: others are hardly visible."""

Index = dict[str, int]


def _failures() -> Iterator[Flag]:
    """Yield the flags of poses that are counted but not solved; those of both stages last."""
    for flags, other in ((DetectionStatus, EstimateStatus), (EstimateStatus, DetectionStatus)):
        ending = [flag for flag in flags if flag.counted and flag.ends]
        ending.sort(key=lambda flag: flag.name in other.__members__)
        yield from (flag for flag in ending if flag is not EstimateStatus.solved)


FAILURES: tuple[Flag, ...] = tuple(_failures())


@dataclass(slots=True)
class _Candidates:
    """The best candidate of each kind so far, with its merit and its index."""

    best: dict[str, tuple[float, Index]] = field(default_factory=dict)
    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(BINS, dtype=np.int64))
    members: dict[int, Index] = field(default_factory=dict)

    def offer(self, kind: str, merits: Floats, index: Mapping[str, NDArray[np.intp]]) -> None:
        """Keep the candidate with the largest of ``merits`` (n,) if it exceeds the kept one's."""
        if not merits.size:
            return
        k = int(np.argmax(merits))
        if kind not in self.best or merits[k] > self.best[kind][0]:
            self.best[kind] = float(merits[k]), {d: int(i[k]) for d, i in index.items()}

    def count(self, errors: Floats, index: Mapping[str, NDArray[np.intp]]) -> None:
        """Add errors (n,), in degrees, to the bins, and keep a member of each bin."""
        clipped = np.clip(errors, MIN_ERROR, MAX_ERROR)
        share = np.log(clipped / MIN_ERROR) / math.log(MAX_ERROR / MIN_ERROR)
        bins, first, counts = np.unique(
            np.minimum((share * BINS).astype(np.int64), BINS - 1), return_index=True,
            return_counts=True)
        self.counts[bins] += counts
        for number, k in zip(bins.tolist(), first.tolist(), strict=True):
            self.members.setdefault(number, {d: int(i[k]) for d, i in index.items()})

    def median(self) -> Index | None:
        """Return the index of an error in the median's bin; None without errors."""
        total = int(self.counts.sum())
        if total == 0:
            return None
        return self.members[int(np.searchsorted(np.cumsum(self.counts), (total + 1) // 2))]


def select_scenes(results: xr.Dataset) -> Iterator[tuple[str, Index]]:
    """Yield a title and the index along each axis, for each kind of scene that occurs."""
    candidates = _scan(results)
    titles = {
        "best": "best: the smallest rotation error", "worst": "worst: the largest rotation error",
        "worst_unflipped": "worst without a flip", "flipped": "flipped to the mirrored pose",
    }
    if "best" in candidates.best:
        yield titles.pop("best"), candidates.best["best"][1]
    median = candidates.median()
    if median is not None:
        yield "median rotation error of the solved", median
    for kind, title in titles.items():
        if kind in candidates.best:
            yield title, candidates.best[kind][1]
    for flag in FAILURES:
        if _kind(flag) in candidates.best:
            meaning = uncapitalised(flag.meaning).removesuffix(".")
            yield f"{flag.name.replace('_', ' ')}: {meaning}", candidates.best[_kind(flag)][1]


def _kind(flag: Flag) -> str:
    return f"{type(flag).__name__}.{flag.name}"


def _scan(results: xr.Dataset) -> _Candidates:
    candidates = _Candidates()
    names = ("estimate", "rotation_error_deg", "flipped", "detection", AREA)
    for offsets, piece in _pieces(results[list(names)].reset_coords(drop=True)):
        dims = tuple(str(dim) for dim in piece["estimate"].dims)
        estimate, error, flipped = (piece[name].values for name in names[:3])
        area = piece[AREA].broadcast_like(piece["estimate"]).transpose(*dims).values
        area = np.nan_to_num(area, nan=-1.0, posinf=-1.0)

        def indices(
            mask: NDArray[np.bool_], dims: tuple[str, ...] = dims, offsets: Index = offsets
        ) -> dict[str, NDArray[np.intp]]:
            return {
                dim: indices + offsets[dim]
                for dim, indices in zip(dims, np.nonzero(mask), strict=True)
            }

        solved = (estimate == EstimateStatus.solved) & np.isfinite(error)
        index = indices(solved)
        errors = error[solved].astype(np.float64)
        candidates.offer("best", -errors, index)
        candidates.offer("worst", errors, index)
        mirrored = flipped == Flipped.flipped
        unflipped = solved & ~mirrored
        candidates.offer("worst_unflipped", error[unflipped].astype(np.float64), indices(unflipped))
        mirrored &= solved & (error > MIN_FLIP_DEG)
        candidates.offer("flipped", area[mirrored], indices(mirrored))
        candidates.count(errors, index)
        detection = piece["detection"].broadcast_like(piece["estimate"]).transpose(*dims).values
        for flag in FAILURES:
            flagged = (detection if isinstance(flag, DetectionStatus) else estimate) == flag
            # The larger the marker, the more surprising the failure.
            candidates.offer(_kind(flag), area[flagged], indices(flagged))
    for flag in EstimateStatus:
        # A failure of the detection is flagged in the estimate, too: it is shown once.
        name = flag.name
        if name in DetectionStatus.__members__ and _kind(DetectionStatus[name]) in candidates.best:
            candidates.best.pop(_kind(flag), None)
    return candidates


def _pieces(results: xr.Dataset) -> Iterator[tuple[Index, xr.Dataset]]:
    """Yield the results in pieces of whole chunks, each with the index of its first cell."""
    sizes = {str(dim): size for dim, size in results["estimate"].sizes.items()}
    chunks = {str(dim): edges for dim, edges in results["estimate"].chunksizes.items()}
    quota = MAX_PIECE
    cuts: dict[str, list[int]] = {}
    for dim in reversed(list(sizes)):
        length = chunks.get(dim, (sizes[dim],))[0]
        step = min(sizes[dim], max(length, quota // length * length))
        cuts[dim] = list(range(0, sizes[dim], step))
        quota = max(1, quota // step)
        sizes[dim] = step
    for starts in itertools.product(*(cuts[dim] for dim in sizes)):
        offsets = dict(zip(sizes, starts, strict=True))
        box = {dim: slice(start, start + sizes[dim]) for dim, start in offsets.items()}
        yield offsets, results.isel(box).load()
