"""Causes of wrong poses: what each corrects, with the priors of its numbers, and its own test."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sweep.diagnosis.observations import Observations
from sweep.model.marker import module_count, overhang
from sweep.typing import Floats

# A cause is told by how it is undone: the true position is A t of the said position t, plus columns
# times unknown numbers. In the tape's units every scale is then linear, and what the tape does not
# know stays the tape's, however wrong the program is. A scale that may be anything is a row of
# narrow ones, each linear about its middle.

NAMED_SD = 0.01
"""Relative standard deviation of a named ratio: by how much prints and rulers are off."""

SMALL_SD, FREE_SD = 0.03, 0.35
"""Standard deviations of ln(ratio): of a print or a calibration that is a little off, and of one
that is wrong altogether."""

STEP = 0.06
"""Distance of the middles of ln(ratio) from one another."""

FAR = np.arange(1.6, 3.7, 0.4)
FAR_SD = 0.25
"""Middles of ln(ratio) of sizes left at a default, and their spread."""

INCH = 25.4
UNITS = (10.0, 100.0, 1000.0, INCH, INCH / 10.0, 1.0 / 0.3048, 1000.0 / INCH)
"""Ratios of units that are taken for one another: mm, cm, m; inch and mm, cm; foot, inch and m."""

FOCAL_RATIOS = {
    2.0: "calibrated at twice the resolution, or without binning",
    0.5: "calibrated at half the resolution, or with binning",
    1.5: "calibrated at 1.5 times the resolution (1920 for 1280)",
    2 / 3: "calibrated at 2/3 of the resolution (1280 for 1920)",
    4 / 3: "calibrated with 4/3 of the rows or columns (crop of 4:3)",
    0.75: "calibrated with 3/4 of the rows or columns (crop of 4:3)",
    3.0: "calibrated at 3 times the resolution (1920 for 640)",
    1 / 3: "calibrated at 1/3 of the resolution (640 for 1920)",
}


class Correction(NamedTuple):
    """Ways (c,) in which a cause is undone.

    Attributes
    ----------
    log_weight
        Logarithm of each way's prior probability.
    matrix
        A (c, 3, 3): said position to true one, at the middle of the prior.
    spread
        Standard deviation of ln(ratio) about the middle of each way (c, causes), 0 if there is no
        ratio.
    ratio
        The middles (c, causes): how many times too large what was said is.
    labels
        Name of each way, empty for a number that may be anything.
    square
        How many times larger the square is in the image than f size / z of what was said (c,).
    """

    log_weight: Floats
    matrix: Floats
    spread: Floats
    ratio: Floats
    labels: tuple[str, ...]
    square: Floats

    def times(self, other: Correction) -> Correction:
        """Return all combinations of the ways of two causes."""
        a, b = (index.ravel() for index in np.indices((len(self.labels), len(other.labels))))
        return Correction(
            self.log_weight[a] + other.log_weight[b], self.matrix[a] @ other.matrix[b],
            np.concatenate([self.spread[a], other.spread[b]], axis=1),
            np.concatenate([self.ratio[a], other.ratio[b]], axis=1),
            tuple(f"{self.labels[i]}; {other.labels[j]}".strip("; ")
                  for i, j in zip(a, b, strict=True)),
            self.square[a] * other.square[b])

    def one(self, way: int) -> Correction:
        """Return one of the ways."""
        return Correction(self.log_weight[[way]], self.matrix[[way]], self.spread[[way]],
                          self.ratio[[way]], (self.labels[way],), self.square[[way]])


def unscaled(weight: ArrayLike, matrix: Floats, labels: Sequence[str]) -> Correction:
    """Return ways without a ratio."""
    nothing = np.zeros((len(labels), 1))
    return Correction(np.log(weight), matrix, nothing, nothing + 1.0, tuple(labels),
                      np.ones(len(labels)))


def _as_it_is(_: Observations) -> Correction:
    return unscaled([1.0], np.eye(3)[None], [""])


def _no_columns(_: Observations, points: Floats, _spread: Floats) -> Floats:
    return np.zeros((*points.shape, 0))


@dataclass(frozen=True)
class Cause:
    """One cause.

    Attributes
    ----------
    name, title
        Its name in JSON, and in words.
    prior
        Prior weight, relative to the others.
    test
        What would decide without another distance.
    ways
        How it is undone in these observations.
    columns
        True positions (c, n, 3) and the ways' spreads (c,) -> what one standard deviation of each
        unknown number adds to the positions, (c, n, 3, k).
    lacks
        What observations lack for it to be looked for, empty if nothing.
    unit
        Prior standard deviation of the columns' numbers in this unit, and the unit.
    """

    name: str
    title: str
    prior: float
    test: str
    ways: Callable[[Observations], Correction] = _as_it_is
    columns: Callable[[Observations, Floats, Floats], Floats] = _no_columns
    lacks: Callable[[Observations], str] = lambda _: ""
    unit: tuple[float, str] = (1.0, "")


def ratios(
    named: dict[float, str], share: float, axes: Floats, far_share: float = 0.0
) -> Correction:
    """Return ways of a ratio: ``named`` ones, together ``share``, near 1, any, or far from 1.

    The said positions are that many times too long along ``axes`` (3,), 1 or 0 each.
    """
    middles = np.arange(-24, 25) * STEP
    density = np.exp(-0.5 * (middles / FREE_SD) ** 2)
    log_ratio = np.concatenate([np.log(list(named)), [0.0], middles, FAR, -FAR])
    free = 1.0 - share - far_share
    weight = np.concatenate([
        np.full(len(named), share / len(named)), [0.6 * free],
        0.4 * free * density / density.sum(), np.full(2 * len(FAR), 0.5 * far_share / len(FAR))])
    matrix = np.eye(3) * (1.0 - axes + axes * np.exp(-log_ratio)[:, None])[:, None, :]
    spread = np.repeat([NAMED_SD, SMALL_SD, 0.6 * STEP, FAR_SD],
                       [len(named), 1, len(middles), 2 * len(FAR)])
    labels = (*named.values(), *[""] * (len(weight) - len(named)))
    some = weight > 0
    return Correction(np.log(weight[some]), matrix[some], spread[some, None],
                      np.exp(log_ratio)[some, None], labels[: int(some.sum())],
                      np.ones(int(some.sum())))


def size_ratios(dictionary: str) -> dict[float, str]:
    """Return ratios of sizes taken for the black square's, with their names.

    >>> size_ratios("DICT_APRILTAG_36h11")[1.25]
    'the white margin taken for the edge (10/8)'
    """
    n, beyond = (module_count(dictionary), overhang(dictionary)) if dictionary else (8, 0)
    edge = n + 2 * beyond
    found = {} if not beyond else {
        edge / n: f"the outer border taken for the detected square ({edge}/{n})",
        n / edge: f"the detected square taken for the outer border ({n}/{edge})",
    }
    # A wider square of a family with an overhang ends in white anyway.
    margin = {} if beyond else {
        (n + 2) / n: f"the white margin taken for the edge ({n + 2}/{n})",
        (n - 2) / n: f"the bits taken for the square, without its border ({n - 2}/{n})",
    }
    if not dictionary:  # any family: with a margin or an overhang
        margin |= {8 / 6: "the white margin taken for the edge (8/6)",
                   7 / 5: "the white margin taken for the edge (7/5)",
                   9 / 5: "the outer border taken for the detected square (9/5)",
                   5 / 9: "the detected square taken for the outer border (5/9)"}
    return found | margin | {
        0.5: "half of the side", 2.0: "twice the side (or the side for its half)",
        2**0.5: "the diagonal taken for the side"}


def _size_ways(rows: Observations) -> Correction:
    return ratios(size_ratios(rows.dictionary), 0.6, np.ones(3), 0.05)


def _unit_ways(_: Observations) -> Correction:
    # A size in other units makes tvec as long as it is itself, and f size / z stays the side in the
    # image; a tvec in other units does not.
    ratio = np.tile([unit**sign for unit in UNITS for sign in (1, -1)], 2)
    of_tvec = np.arange(len(ratio)) >= len(ratio) // 2
    labels = tuple(
        f"{'tvec' if tvec else 'size_m'} {'longer' if each > 1 else 'shorter'} by "
        f"{max(each, 1 / each):.4g}" for each, tvec in zip(ratio, of_tvec, strict=True))
    return Correction(
        np.full(len(ratio), -np.log(len(ratio))), np.eye(3) / ratio[:, None, None],
        np.full((len(ratio), 1), NAMED_SD), ratio[:, None], labels, np.where(of_tvec, ratio, 1.0))


def _focal_ways(_: Observations) -> Correction:
    axes = np.array([0.0, 0.0, 1.0])
    return ratios(FOCAL_RATIOS, 0.4, axes)


def _scale_columns(_: Observations, points: Floats, spread: Floats) -> Floats:
    return np.asarray((points * spread[:, None, None])[..., None])


def _depth_columns(rows: Observations, points: Floats, spread: Floats) -> Floats:
    return _scale_columns(rows, points * [0.0, 0.0, 1.0], spread)


def _along_sight(points: Floats) -> Floats:
    """Return unit vectors (c, n, 3) of the lines of sight."""
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))


OFFSET_SD_M, TURN_SD_DEG, BIAS_SD_PX, DELAY_SD_S = 0.1, 4.0, 1.5, 0.1
"""Standard deviations of an offset of the lens, a turn of the frame, a bias of corners (pixels of
the square's side) and a delay."""


def _offset_columns(rows: Observations, points: Floats, _spread: Floats) -> Floats:
    if not rows.spatial:
        return np.asarray(OFFSET_SD_M * _along_sight(points)[..., None])
    return np.broadcast_to(OFFSET_SD_M * np.eye(3), (*points.shape, 3))


def _axis_ways(_: Observations) -> Correction:
    """Return a frame that is turned a little, and axes that are named or pointed otherwise."""
    swaps = [np.eye(3)[list(order)] * np.array(signs)[:, None]
             for order in itertools.permutations(range(3))
             for signs in itertools.product((1.0, -1.0), repeat=3)][1:]
    weight = np.array([0.5, *np.full(len(swaps), 0.5 / len(swaps))])
    labels = ["", *(", ".join(
        f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]} is {axis}"
        for row, axis in zip(swap, "xyz", strict=True)) for swap in swaps)]
    return unscaled(weight, np.stack([np.eye(3), *swaps]), labels)


def _turn_columns(_: Observations, points: Floats, _spread: Floats) -> Floats:
    return np.asarray(np.radians(TURN_SD_DEG) * np.stack(
        [np.cross(axis, points) for axis in np.eye(3)], axis=-1))


def _half_pixel_ways(rows: Observations) -> Correction:
    camera = rows.camera
    slopes = (0.5 / camera.fx_px, 0.5 / camera.fy_px) if camera is not None else (0.0, 0.0)
    matrix = np.stack([np.eye(3)] * 2)
    matrix[:, :2, 2] = np.outer([1.0, -1.0], slopes)
    return unscaled([0.5, 0.5], matrix, (
        "centres of pixels counted from 0.5 in one place, from 0 in the other",
        "centres of pixels counted from 0 in one place, from 0.5 in the other"))


def _bias_columns(rows: Observations, points: Floats, _spread: Floats) -> Floats:
    return np.asarray((-BIAS_SD_PX / rows.side_px[:, None] * points)[..., None])


def _motion_columns(rows: Observations, points: Floats, _spread: Floats) -> Floats:
    away = np.nan_to_num(rows.speed)[:, None] * _along_sight(points)
    return np.asarray(DELAY_SD_S * away[..., None])


def _lateral(rows: Observations) -> str:
    return "" if np.isfinite(rows.position[:, :2]).any() else "measured x_m or y_m"


def _known_square(rows: Observations) -> str:
    return "" if rows.camera is not None and np.isfinite(rows.size_m) else "--camera and size_m"


def _straight(rows: Observations) -> str:
    if not rows.lateral or rows.compared != "z":
        return "tvec_x_m and tvec_y_m beside tvec_z_m"
    return "" if straight_differs(rows) else "rows farther from the optical axis"


def straight_differs(rows: Observations) -> bool:
    """Return whether z is another number than the straight distance in some row."""
    gap = np.linalg.norm(rows.said, axis=1) - rows.said[:, 2]
    return bool((gap > 2.0 * np.hypot(rows.tape_sd, rows.zero_sd_m))[np.isfinite(rows.tape)].any())


def _yaws(rows: Observations) -> str:
    return "" if np.isfinite(rows.yaw * rows.yaw_said).any() else "yaw_deg and rvec_x, rvec_y, ..."


AGREE = "agree"
FLIPS = "flips"
STRAIGHT = "z_for_range"
CAUSES = (
    Cause(AGREE, "the numbers agree with what is expected", 4.0, "nothing to test"),
    Cause("size", "wrong size of the marker (another edge, or a scaled or bent print)", 3.0,
          "measure the square whose corners are detected with a caliper, flat on a table",
          _size_ways, _scale_columns),
    Cause("focal_length", "wrong focal length (resolution, another camera, crop, autofocus)", 2.5,
          "photograph a ruler at a known distance: f is its pixels times distance / length; "
          "compare the file's image size with the image's", _focal_ways, _depth_columns),
    Cause("units", "units taken for one another (m, cm, mm, inch, foot)", 1.0,
          "print size and tvec with their units", _unit_ways, _scale_columns),
    Cause(STRAIGHT, "z taken for the straight distance", 1.5,
          "compare the tape with sqrt(x² + y² + z²)", lacks=_straight),
    Cause("offset", "an offset (zero point of the tape, place of the lens, another frame)", 1.0,
          "measure one more distance: an offset stays, a factor grows",
          columns=_offset_columns, unit=(1e3 * OFFSET_SD_M, "mm")),
    Cause("axes", "axes or frame turned", 1.0,
          "move the marker to the right: x alone must grow; down: y; away: z",
          _axis_ways, _turn_columns, _lateral, (TURN_SD_DEG, "degrees")),
    Cause("half_pixel", "half a pixel (convention of corners or calibration)", 0.7,
          "detect a rendered marker whose corners are known (`sweep export`)",
          _half_pixel_ways, lacks=lambda rows: _lateral(rows) or _known_square(rows)),
    Cause("refinement", "bias of the corner refinement", 1.0,
          "run the other refinement on the same images: its bias differs",
          columns=_bias_columns, lacks=_known_square, unit=(BIAS_SD_PX, "px")),
    Cause("motion", "motion during the exposure, a rolling shutter or a late time stamp", 1.0,
          "measure standing still", columns=_motion_columns,
          lacks=lambda rows: "" if np.nan_to_num(rows.speed).any() else "speed_m_s",
          unit=(1e3 * DELAY_SD_S, "ms")),
    Cause(FLIPS, "flips (the mirrored solution of the plane)", 0.5,
          "print both solutions of solvePnPGeneric with their reprojection errors", lacks=_yaws),
)
"""All causes; prior weights follow how often public questions turned out to be each."""

PAIRS_PRIOR = 0.05
"""Prior weight of two causes at once, relative to one."""
