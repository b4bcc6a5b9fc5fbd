"""Corners that a detector found against the truth: their order, scale and offset, and the IDs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sweep.typing import Floats, Integers

MAX_OFFSET_PX = 0.02
"""Largest mean offset of a detector that conforms."""

STANDARD_ERRORS = 4.0
"""Standard errors of the mean offset that are allowed beside it."""

MAX_SCALE_ERROR = 0.005

ORDERS = tuple(itertools.permutations(range(4)))

Found = Sequence[tuple[int, Floats]]
"""The markers of an image: ID and corners (4, 2) px."""


@dataclass(frozen=True)
class Conventions:
    """What corners and IDs turn out to be.

    Attributes
    ----------
    detected
        Scenes in which the marker was found.
    order
        Index of the found corner that is the true top left one, and so on; None if it differs from
        scene to scene.
    swapped
        Whether x and y are swapped.
    scale
        (2,) of x and y.
    offset_px
        (2,) mean of found minus true, after order, swap and scale.
    offset_error_px
        (2,) its standard error.
    rms_px
        Root mean square of a corner's distance after the mean offset is taken off.
    ids
        Pairs of drawn and found ID that differ.
    """

    detected: int
    order: tuple[int, ...] | None
    swapped: bool
    scale: Floats
    offset_px: Floats
    offset_error_px: Floats
    rms_px: float
    ids: tuple[tuple[int, int], ...]


def conventions(
    found: Sequence[Found], marker_id: Integers, corners_px: Floats
) -> Conventions | None:
    """Return the conventions that explain what was found in N scenes; None if nothing was.

    Parameters
    ----------
    found
        N: the markers of each image. Of several the one with the right ID counts, or the nearest.
    marker_id, corners_px
        (N,) and (N, 4, 2): the truth, the second half of it the point reflection of the first.
    """
    rows, ids, corners = [], [], []
    for row, markers in enumerate(found):
        if markers:
            centre = corners_px[row].mean(axis=0)
            number, quad = min(
                markers, key=lambda marker: (
                    marker[0] != marker_id[row],
                    float(np.linalg.norm(marker[1].mean(axis=0) - centre)),
                ),
            )
            rows.append(row)
            ids.append((int(marker_id[row]), int(number)))
            corners.append(quad)
    if not rows:
        return None
    quads, truth = np.array(corners), corners_px[rows]
    order, swapped, scale = _layout(quads, truth)
    usual = order or min(ORDERS, key=lambda some: _residual(quads[:, list(some)], truth)[0])
    fitted = quads[:, list(usual), :: -1 if swapped else 1]
    other_scale = (np.abs(scale - 1) > MAX_SCALE_ERROR).any()
    error = fitted / scale - truth if other_scale else fitted - truth
    offset = error.mean(axis=(0, 1))
    half = len(corners_px) // 2
    means = dict(zip(rows, error.mean(axis=1), strict=True))
    pairs = np.array([
        (means[row] + means[row + half]) / 2 for row in range(half)
        if row in means and row + half in means
    ])
    spread = pairs.std(axis=0, ddof=1) / np.sqrt(len(pairs)) if len(pairs) > 1 else np.zeros(2)
    return Conventions(
        detected=len(rows), order=order, swapped=swapped, scale=scale, offset_px=offset,
        offset_error_px=spread,
        rms_px=float(np.sqrt(((error - offset) ** 2).sum(axis=2).mean())),
        ids=tuple(pair for pair in ids if pair[0] != pair[1]),
    )


def _residual(quads: Floats, truth: Floats) -> tuple[float, Floats]:
    """Return the root mean square after a scale and an offset of each axis, and the scales (2,)."""
    flat, wanted = quads.reshape(-1, 2), truth.reshape(-1, 2)
    flat, wanted = flat - flat.mean(axis=0), wanted - wanted.mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.nan_to_num((flat * wanted).sum(axis=0) / (wanted**2).sum(axis=0))
    return float(np.sqrt(((flat - scale * wanted) ** 2).mean())), scale


def _layout(quads: Floats, truth: Floats) -> tuple[tuple[int, ...] | None, bool, Floats]:
    """Return order (None if there is no common one), whether axes are swapped, and scales."""
    best = None
    for swapped in (False, True):
        turned = quads[..., ::-1] if swapped else quads
        for order in ORDERS:
            residual, scale = _residual(turned[:, list(order)], truth)
            if best is None or residual < 0.5 * best[0]:  # the plain reading, unless clearly worse
                best = residual, order, swapped, scale
    assert best is not None  # noqa: S101  (there are 48 readings)
    residual, order, swapped, scale = best
    side = float(np.linalg.norm(truth - np.roll(truth, 1, axis=1), axis=2).mean())
    if residual < 0.1 * side * float(np.abs(scale).max()):
        return order, swapped, scale
    return None, False, np.ones(2)


def order_faults(
    result: Conventions, declared: Sequence[int] | None, pixel_center: float | None
) -> list[str]:
    """Return what is wrong with corners and IDs, a line each, with what to declare instead.

    ``declared`` and ``pixel_center`` are what a plug-in declares; None for OpenCV.
    """
    faults = []
    if result.ids:
        drawn, found = result.ids[0]
        steps = {other - one for one, other in result.ids}
        constant = f", always {steps.pop():+d}" if len(steps) == 1 and len(result.ids) > 1 else ""
        faults.append(
            f"IDs are wrong in {len(result.ids)} of {result.detected} scenes{constant}: "
            f"{found} for marker {drawn}"
        )
    if result.order is None:
        faults.append(
            "corners are in no fixed order of the marker: return them so that the first is always "
            "the same corner of the bitmap"
        )
        return faults
    if result.swapped:
        faults.append("x and y of the corners are swapped: return (x, y)")
    for name, scale in zip("xy", result.scale, strict=True):
        if abs(scale - 1) > MAX_SCALE_ERROR:
            way = (
                "counts in the other direction" if abs(scale + 1) < MAX_SCALE_ERROR
                else f"is {scale:.3g} times the image's"
            )
            faults.append(f"{name} of the corners {way}: return pixels of the image, y downwards")
    if result.order != (0, 1, 2, 3):
        faults.append(_order_fault(result.order, declared))
    if not faults:
        faults += offset_fault(result, pixel_center)
    return faults


def _order_fault(order: tuple[int, ...], declared: Sequence[int] | None) -> str:
    quarters = next(
        (k for k in range(1, 4) if order == tuple((i + k) % 4 for i in range(4))), None
    )
    what = {
        None: "corners run the other way round, or cross", 1: "corners are turned by one",
        2: "corners are turned by two (180°)", 3: "corners are turned by three",
    }[quarters]
    if declared is None:
        return what
    wanted = tuple(declared[index] for index in order)
    return f"{what}: declare corner_order = {wanted}"


def offset_fault(result: Conventions, pixel_center: float | None) -> list[str]:
    """Return the line that says how far corners are off in the mean; none if they are not."""
    allowed = MAX_OFFSET_PX + STANDARD_ERRORS * result.offset_error_px
    if (np.abs(result.offset_px) <= allowed).all():
        return []
    x, y = result.offset_px
    line = f"corners are offset by ({x:.2f}, {y:.2f}) px"
    if pixel_center is None:
        return [line]
    for step in (0.5, -0.5, 1.0, -1.0):
        if (np.abs(result.offset_px - step) < 0.1).all() and -1 <= pixel_center + step <= 1:
            return [f"{line}: declare pixel_center = {pixel_center + step:g}"]
    return [f"{line}: no pixel_center is the reason"]
