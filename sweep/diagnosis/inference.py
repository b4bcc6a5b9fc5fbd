"""Causes of wrong poses, how each is undone, and their posterior probabilities."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sweep.diagnosis.observations import REFINEMENTS, SOLVED_YAW_SD_DEG, Observations, tape_sd
from sweep.model.marker import module_count, overhang
from sweep.typing import Floats

# A cause is told by how it is undone: the true position is A t of the said position t, plus columns
# times unknown numbers. In the tape's units every scale is then linear, and what the tape does not
# know stays the tape's, however wrong the program is. A scale that may be anything is a row of
# narrow ones, each linear about its middle.

# Relative standard deviation of a named ratio: by how much prints and rulers are off.
NAMED_SD = 0.01

# Standard deviation of ln(ratio) of a print or a calibration that is a little off.
SMALL_SD = 0.03

# Half widths at half maximum of ln(ratio) of a size and a focal length that are wrong altogether:
# sizes are left at defaults, lenses are not ten times as long.
SIZE_WIDTH, FOCAL_WIDTH = 0.35, 0.2

# Ratios of units that are taken for one another: mm, cm, m; inch and mm, cm; foot, inch and m.
UNITS = (10.0, 100.0, 1000.0, 25.4, 2.54, 1.0 / 0.3048, 1000.0 / 25.4)

# Ratios of resolutions, of crops and of binning: 1920 for 960, 1280, 1440 and 640, and back.
FOCAL_RATIOS = {
    each: f"calibrated at {each:.3g} times the resolution (another mode, crop or binning)"
    for each in (2.0, 0.5, 1.5, 2 / 3, 4 / 3, 0.75, 3.0, 1 / 3)}

# Distortions that a camera's file lacks: the image at the tangent r from the axis belongs at
# r exp(b r²), and k1 = -b.
BENDS = np.concatenate([np.geomspace(0.02, 0.6, 20), -np.geomspace(0.02, 0.25, 15)])

# By which share of their distance rows may be off that no cause explains.
SCATTERS = (0.03, 0.1, 0.3, 1.0)

# A way in which a cause is undone: logarithm of its prior probability; said position to true one,
# at the middle of the prior; how many times too large what was said is, there; standard deviation
# of ln(ratio) about it, 0 if there is no ratio; its name, empty if the ratio may be anything; by
# how much an ignored distortion moves the image at 45 degrees from the axis; the row, counted from
# 1, that is off by anything, 0 for all rows, -1 for all along the line of sight; by which share of
# its distance.
Ways = NDArray[np.void]
WAY = np.dtype([
    ("log_weight", np.float64), ("matrix", np.float64, (3, 3)), ("ratio", np.float64),
    ("spread", np.float64), ("label", np.str_, 80), ("bend", np.float64), ("row", np.int64),
    ("scatter", np.float64)])


def ways_of(
    matrix: Floats, label: Sequence[str] = ("",), weight: ArrayLike = 1.0, share: float = 1.0,
    **fields: ArrayLike,
) -> Ways:
    """Return the ways (c,) of one cause of matrices (c, 3, 3); a number stands for all of them.

    They have a ``share`` of the cause's prior. Without ``fields`` they have a ratio of 1, and
    neither spread, bend nor scatter.
    """
    ways = np.zeros(len(matrix), WAY)
    ways["matrix"], ways["ratio"] = matrix, 1.0
    ways["log_weight"] = np.log(weight)
    ways["log_weight"] += math.log(share) - np.logaddexp.reduce(ways["log_weight"])
    ways["label"][: len(label)] = label
    for name, values in fields.items():
        ways[name] = values
    return ways


def undone(ways: Sequence[Ways]) -> Floats:
    """Return said position to true one (c, 3, 3) by ways (c,) of several causes together."""
    return functools.reduce(np.matmul, (each["matrix"] for each in ways), np.eye(3)[None])


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
        True positions (c, n, 3) and the ways' spreads (c, 1, 1) -> what one standard deviation of
        each unknown number adds to the positions, (c, n, 3) or what is broadcast to it.
    lacks
        What observations lack for it to be looked for, empty if nothing.
    unit
        Prior standard deviation of the columns' numbers in this unit, and the unit.
    yaws
        Prior shares (m, 3) of yaws that are as said, mirrored, or anything, each as likely: a wrong
        sign mirrors all. A marker seen from behind or turned by 180 degrees is another mistake.
    """

    name: str
    title: str
    prior: float
    test: str
    ways: Callable[[Observations], Ways] = lambda _: ways_of(np.eye(3)[None])
    columns: Callable[[Observations, Floats, Floats], Sequence[Floats]] = lambda *_: ()
    lacks: Callable[[Observations], str] = lambda _: ""
    unit: tuple[float, str] = (1.0, "")
    yaws: ArrayLike = ((0.99, 0.0, 0.01),)


def ratios(
    named: Mapping[float, str], share: float, width: float, axes: Sequence[float]
) -> Ways:
    """Return ways of a ratio: ``named`` ones, together ``share``, near 1, or any.

    ln(ratio) that may be any is Cauchy's with ``width``, whose tails are wide. The said positions
    are that many times too long along ``axes`` (3,), 1 or 0 each.
    """
    middles = width * np.sinh(np.arange(-25, 26) * 0.115)
    spacing = np.gradient(middles)
    density = spacing / (1.0 + (middles / width) ** 2)
    log_ratio, weight, spread = np.concatenate([np.broadcast_arrays(*group) for group in (
        (np.log(list(named)), share / len(named), NAMED_SD), ([0.0], 0.6 * (1.0 - share), SMALL_SD),
        (middles, 0.4 * (1.0 - share) * density / density.sum(), 0.6 * spacing))], axis=1)
    matrix = np.eye(3) * np.exp(-np.outer(log_ratio, axes))[:, None, :]
    return ways_of(matrix, [*named.values()], weight, ratio=np.exp(log_ratio), spread=spread)


def size_ratios(dictionary: str) -> dict[float, str]:
    """Return ratios of sizes taken for the black square's, with their names.

    >>> size_ratios("DICT_APRILTAG_36h11")[1.25]
    'the white margin taken for the edge (10/8)'
    """
    found = {0.5: "half of the side", 2.0: "twice the side (or the side for its half)",
             2**0.5: "the diagonal taken for the side"}
    # Modules of the square, and beyond it on each side: of the likely families if none is given.
    for n, beyond in ([(module_count(dictionary), overhang(dictionary))] if dictionary
                      else [(8, 0), (7, 0), (6, 0), (5, 2)]):
        # A wider square of a family with an overhang ends in white anyway.
        edge = n + 2 * (beyond or 1)
        found |= {
            edge / n: f"the outer border taken for the detected square ({edge}/{n})",
            n / edge: f"the detected square taken for the outer border ({n}/{edge})",
        } if beyond else {
            edge / n: f"the white margin taken for the edge ({edge}/{n})",
            (n - 2) / n: f"the bits taken for the square, without its border ({n - 2}/{n})"}
    return found


def _unit_ways(rows: Observations) -> Ways:
    """Return what is in other units: the size, all that is said, or its z alone."""
    ratio, parts = np.array([unit**sign for unit in UNITS for sign in (1, -1)]), []
    for name, powers, larger, share in (
            # As long as it is itself, such a size makes tvec; so does a tape in other units.
            ("size_m (or the tape, inversely)", (1, 1, 1), 0, 0.45),
            ("tvec", (1, 1, 1), 1, 0.45), ("tvec_z_m alone", (0, 0, 1), 1, 0.1)):
        # No detector reads a square that would be larger than the image, or a few pixels.
        side = np.outer(ratio**larger, rows.side_px)
        unread = rows.known_square & (side != np.clip(side, *SIDE_LIMITS_PX)).any(axis=1)
        parts.append(ways_of(
            np.eye(3) / (ratio[:, None] ** powers)[:, None], [
                f"{name} {'longer' if each > 1 else 'shorter'} by {max(each, 1 / each):.4g}"
                for each in ratio],
            np.where(unread, 1e-6, 1.0), share, ratio=ratio, spread=NAMED_SD))
    return np.concatenate(parts)


def _moved_centre(rows: Observations, shift_px: Floats) -> Floats:
    """Return said position to true one (c, 3, 3) where the image's centre is off by (c, 2) px."""
    matrix = np.tile(np.eye(3), (len(shift_px), 1, 1))
    if rows.camera is not None:
        matrix[:, :2, 2] = shift_px / [rows.camera.fx_px, rows.camera.fy_px]
    return matrix


def _focal_ways(rows: Observations) -> Ways:
    """Return a wrong focal length, and those of other resolutions with their image's centre.

    With the centre c and the focal length f of an image that is r times as large, x / z is
    (u - c) / f and should be (u - c / r) r / f: x + (1 - 1 / r) z c / f is true, and z / r, or z if
    the image is a crop.
    """
    alone, ratio = (
        ratios(FOCAL_RATIOS, 0.4, FOCAL_WIDTH, (0, 0, 1)), np.array([*FOCAL_RATIOS]))
    if rows.camera is None or not rows.lateral:
        return alone
    crop = _moved_centre(rows, np.outer(
        1.0 - 1.0 / ratio, [rows.camera.cx_px, rows.camera.cy_px]))
    alone["log_weight"] += math.log(0.5)
    resized = alone["matrix"][: len(ratio)] @ crop
    return np.concatenate([
        alone, ways_of(
            resized, [*FOCAL_RATIOS.values()], share=0.2, ratio=ratio, spread=NAMED_SD),
        ways_of(crop, [*FOCAL_RATIOS.values()], share=0.1, spread=NAMED_SD),
        ways_of(np.tile(np.eye(3), (len(BENDS), 1, 1)),
                ["a distortion that the camera's file lacks"] * len(BENDS), share=0.2, bend=BENDS)])


def _scattered(rows: Observations) -> Ways:
    """Return what explains anything, badly: one row is off, each as likely, or all of them are."""
    # Pairs with each of more rows would take gigabytes.
    lone = range(1, 1 + len(rows.said)) if len(rows.said) <= 40 else ()
    whose = np.repeat([-1, 0, *lone], len(SCATTERS))
    return ways_of(np.tile(np.eye(3), (len(whose), 1, 1)), [
        f"row {k} stands apart" if k > 0 else "all rows are off" for k in whose],
        np.where(whose > 0, 2.0 / len(rows.said), 1.0),
        row=whose, scatter=np.resize(SCATTERS, len(whose)))


def along_sight(points: Floats) -> Floats:
    """Return unit vectors (..., 3) of the lines of sight."""
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))


# Standard deviations of an offset of the lens, a turn of the frame, a bias of corners (pixels of
# the square's side) and a delay.
OFFSET_SD_M, TURN_SD_DEG, BIAS_SD_PX, DELAY_SD_S = 0.1, 4.0, 1.5, 0.1


def _axis_ways(_: Observations) -> Ways:
    """Return a frame that is turned a little, and axes that are named or pointed otherwise."""
    swaps = [np.eye(3)[list(order)] * np.array(signs)[:, None]
             for order in itertools.permutations(range(3))
             for signs in itertools.product((1.0, -1.0), repeat=3)]
    labels = [", ".join(
        f"{way} is {'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}"
        for row, way in zip(swap, ("right", "down", "away"), strict=True)) for swap in swaps]
    # The first is the frame as it is, as likely as all 47 others.
    return ways_of(np.stack(swaps), ["", *labels[1:]], [47.0, *[1.0] * 47])


def _lateral(rows: Observations) -> str:
    # Beyond the camera lies what has other axes, which z shows, too.
    known = np.isfinite(rows.measured[:, :2]).any() or rows.said[:, 2].min() < 0
    return "" if known else "measured x_m or y_m"


def _known_square(rows: Observations) -> str:
    return "" if rows.known_square else "--camera and size_m"


def straight_differs(rows: Observations) -> bool:
    """Return whether z was compared with the tape, and is another number than the range.

    It was not where z was measured, too, or is behind the camera.
    """
    depth, tape = np.isfinite(rows.measured[:, 2:]).T
    gap = np.linalg.norm(rows.said, axis=1) - rows.said[:, 2]
    seen = tape & (gap > 2.0 * np.hypot(rows.measured_sd[:, 3], rows.zero_sd_m))
    return rows.compared == "z" and bool(seen.any()) and not (depth | (rows.said[:, 2] < 0.0)).any()


def _scaled(_: Observations, points: Floats, spread: Floats) -> Sequence[Floats]:
    return [points * spread]


# All causes; prior weights follow how often public questions turned out to be each.
AGREE = "agree"
ROWS = "rows"
STRAIGHT = "z_for_range"
FOCAL = "focal_length"
CAUSES = (
    Cause(AGREE, "the numbers agree with what is expected", 4.0, "nothing to test"),
    Cause("size", "wrong size of the marker (another edge, or a scaled or bent print)", 3.0,
          "measure the square whose corners are detected with a caliper, flat on a table",
          lambda rows: ratios(size_ratios(rows.dictionary), 0.6, SIZE_WIDTH, (1, 1, 1)),
          _scaled),
    Cause(FOCAL, "wrong focal length (resolution, another camera, crop, autofocus)", 2.5,
          "photograph a ruler in the middle and at the edge: f is its pixels times distance / "
          "length; if they differ, give the lens' distortion; compare image sizes with the file's",
          _focal_ways, lambda _, points, spread: [points * spread * [0.0, 0.0, 1.0]]),
    Cause("units", "units taken for one another (m, cm, mm, inch, foot)", 1.0,
          "print size and tvec with their units", _unit_ways, _scaled),
    Cause(STRAIGHT, "z taken for the measured distance, which tvec has right", 1.5,
          "compare a straight tape with sqrt(x² + y² + z²), one along the floor with sqrt(x² + z²)",
          lambda _: ways_of(np.stack([np.eye(3), np.diag([1.0, 0.0, 1.0])]),
                            ["", "the tape lay along the floor"], [9.0, 1.0]),
          lacks=lambda rows: "" if straight_differs(rows) else "a tape off the axis beside z"),
    Cause("offset", "an offset (zero point of the tape, place of the lens, another frame)", 1.0,
          "measure one more distance: an offset stays, a factor grows",
          columns=lambda rows, points, _: [*(OFFSET_SD_M * (
              np.eye(3) if (rows.cells[1] < 3).any() else along_sight(points)[None]))],
          unit=(1e3 * OFFSET_SD_M, "mm to add")),
    Cause("axes", "axes or frame turned", 1.0,
          "move the marker to the right: x alone must grow; down: y; away: z",
          _axis_ways,
          lambda _, points, _spread: [
              np.radians(TURN_SD_DEG) * np.cross(axis, points) for axis in np.eye(3)],
          _lateral, (TURN_SD_DEG, "degrees to turn")),
    Cause("half_pixel", "half a pixel (convention of corners or calibration)", 0.7,
          "detect a rendered marker whose corners are known (`sweep export`)",
          lambda rows: ways_of(_moved_centre(rows, np.array([[0.5, 0.5], [-0.5, -0.5]]))),
          lacks=lambda rows: _lateral(rows) or _known_square(rows)),
    Cause("refinement", "bias of the corner refinement", 1.0,
          "run the other refinement on the same images: its bias differs",
          columns=lambda rows, points, _: [-BIAS_SD_PX / rows.side_px[:, None] * points],
          lacks=_known_square, unit=(BIAS_SD_PX, "px too far")),
    Cause("motion", "motion during the exposure, a rolling shutter or a late time stamp", 1.0,
          "measure standing still",
          columns=lambda rows, points, _: [
              DELAY_SD_S * np.nan_to_num(rows.speed)[:, None] * along_sight(points)],
          lacks=lambda rows: "" if np.nan_to_num(rows.speed).any() else "speed_m_s",
          unit=(1e3 * DELAY_SD_S, "ms late")),
    Cause("flips", "flips (the mirrored solution of the plane)", 0.5,
          "print both solutions of solvePnPGeneric with their reprojection errors",
          lacks=lambda rows: "" if np.isfinite(rows.yaw_off).any()
          else "yaw_deg and rvec_x, rvec_y, ...", yaws=((0.495, 0.495, 0.01),)),
    Cause(ROWS, "no cause of this list (a mistaken row, a camera that moved or refocused)", 1.0,
          "measure again: a mistaken row changes, a cause stays", _scattered,
          yaws=((0.5, 0.0, 0.5), (0.0, 0.99, 0.01))),
)

# Prior weight of two causes at once, relative to one.
PAIRS_PRIOR = 0.05


# --------------------------------------------------------------------------------------------------
# Evidence of each cause, or of two, and their posterior probabilities.

# Posterior odds from which on one explanation is told from another: 0.95 to 0.05.
CLEAR_ODDS = 20.0

# Sides between which the refinement's bias and noise are expected.
SIDE_LIMITS_PX = (8.0, 2000.0)


@dataclass(frozen=True)
class Explanation:
    """One cause, or two, fitted to observations.

    Attributes
    ----------
    causes
        One or two.
    log_evidence
        Logarithm of the prior weight times the marginal likelihood.
    misfit
        Squared distance (c,) of what was measured from the prediction of each way in which they
        are undone, the likeliest first, in standard deviations, with all that is unknown; and minus
        twice the log-likelihood of the yaws, relative to yaws as they were said.
    way
        The likeliest way of each cause, and after it those that are not told from it.
    numbers, covariance
        Posterior mean (k,) and covariance (k, k) of its unknown numbers, in prior standard
        deviations: the causes' own first, then bias and zero points.
    fitted, residuals
        Expected readings of the tape (d,), and what they leave, in standard deviations.
    probability
        Posterior probability among all explanations.
    """

    causes: tuple[Cause, ...]
    log_evidence: float
    misfit: Floats
    way: Sequence[Ways]
    numbers: Floats
    covariance: Floats
    fitted: Floats
    residuals: Floats
    probability: float = math.nan

    @property
    def names(self) -> frozenset[str]:
        """Names of the causes; empty if the numbers agree."""
        return frozenset(cause.name for cause in self.causes) - {AGREE}

    def words(self, attribute: str, between: str = " + ") -> str:
        """Return the name, title or test of all causes."""
        return between.join(getattr(cause, attribute) for cause in self.causes)


def predict(
    rows: Observations, causes: Sequence[Cause], ways: Sequence[Ways]
) -> tuple[Floats, Floats, Floats]:
    """Return the expected readings of the tape by each way (c,) of undoing causes.

    Of all measured numbers (c, d), how unknown numbers change them (c, d, k), and the variance of
    their noise (c, d).

    Notes
    -----
    A plane through an image's ray at the angle b to the axis is shown larger by 1 / cos b across,
    and by 1 / cos² b away from the axis. So a solver that believes another lens, and another ray,
    finds a marker parallel to the image where the way says, and others nearer or farther as they
    are tilted, which is not known. With the rays' unit vectors (x, y, z) both stretches differ by
    the complex number a = [(x + iy)² - (x' + iy')²] / 2, nearly; half of the ratio of both cosines
    is expected, and ± 0.5 |a|: the rest was within 0.6 |a| of cv2.projectPoints and IPPE. A
    distortion exp(b r²) of the image's radius r enlarges it by b r² across and by 3 b r² away from
    the axis: (1.6 ± 0.6) b r² was found for tilts up to 40 degrees.
    """
    bias, bias_sd, noise, lateral = REFINEMENTS[rows.refinement]
    row, component = rows.cells
    points = np.einsum("cij,nj->cni", undone(ways), rows.said)
    side = np.clip(rows.side_px, *SIDE_LIMITS_PX)[:, None]
    lens = undone([way for way, cause in zip(ways, causes, strict=True) if cause.name == FOCAL])
    # In other axes z is no depth: no lens of a pinhole camera sees beyond 60 degrees.
    rays = [along_sight(each) for each in (
        points, points @ np.linalg.inv(lens).transpose(0, 2, 1))]
    true, believed = (np.maximum(ray[..., 2:], 0.5) for ray in rays)
    first, second = ((ray[..., :1] + 1j * ray[..., 1:2]) ** 2 for ray in rays)
    bend, alone, scatter = (
        np.sum([each[name] for each in ways], axis=0)[:, None]
        for name in ("bend", "row", "scatter"))
    bend = bend[..., None] * (believed**-2 - 1.0)
    points = points * np.sqrt(believed / true) * np.exp(-bend * [0.6, 0.6, 1.6]) * (
        1.0 - bias / side)
    slant = np.hypot(0.25 * np.abs(first - second), 0.6 * bend)
    sight = along_sight(points)
    # Change of what is measured with the position: a component, or along the line of sight.
    # The tape is straight; who finds z wrong has compared z with it, if no cause explains it.
    along_z = straight_differs(rows) and causes[0].name == AGREE
    onto = np.where((component == 3)[:, None],
                    np.eye(3)[2] if along_z else sight[:, row], np.eye(4, 3)[component])
    moves = [move for cause, way in zip(causes, ways, strict=True)
             for move in cause.columns(rows, points, way["spread"][:, None, None])]
    moves.append(-bias_sd / side * points)
    seen = [(onto * np.broadcast_to(move, points.shape)[:, row]).sum(axis=-1) for move in moves]
    # Each measured component has a zero point of its own.
    seen += [np.broadcast_to(rows.zero_sd_m * (component == k), seen[0].shape)
             for k in np.unique(component)]
    # Noise grows with distance. By that of the points alone, a factor that brings them near would
    # explain many rows by less noise.
    known = np.abs(np.nan_to_num(np.fmax(rows.measured[:, 3], rows.measured[:, 2])))
    reach = np.maximum(known, np.linalg.norm(points, axis=-1))[:, row]
    across = lateral / (rows.camera.fx_px if rows.camera is not None else 1000.0)
    along = (onto * sight[:, row]).sum(axis=-1)
    apart = np.where(alone < 0, along**2, (alone == 0) | (alone == row + 1))
    variance = rows.measured_sd[row, component] ** 2 + reach**2 * (
        along**2 * ((noise / side) ** 2 + slant**2)[:, row, 0] + (1.0 - along**2) * across**2
        + scatter**2 * apart)
    return (points[:, row] * onto).sum(axis=-1), np.stack(seen, axis=-1), variance


def explain(rows: Observations, causes: tuple[Cause, ...], log_prior: float) -> Explanation:
    """Return an explanation by one cause or two, with its evidence.

    Notes
    -----
    What was measured is normal with mean m + J v and independent errors S, v standard normal; the
    marginal likelihood is N(m, S + J Jᵀ), by Woodbury's identity (Rasmussen and Williams, "Gaussian
    processes for machine learning", 2006, appendix A.3). Ways are summed.
    """
    each_one = [cause.ways(rows) for cause in causes]
    every = np.indices([len(ways) for ways in each_one]).reshape(len(causes), -1)
    ways = [own[index] for own, index in zip(each_one, every, strict=True)]
    mean, columns, variance = predict(rows, causes, ways)
    residual = rows.measured[rows.cells] - mean
    weighted = columns / variance[..., None]
    # By eigenvalues: an inverse of the sum fails where units make numbers of 1e15 beside the 1.
    values, vectors = np.linalg.eigh(np.einsum("cdk,cdl->ckl", columns, weighted))
    precision = 1.0 + np.maximum(values, 0.0)
    covariance = (vectors / precision[:, None, :]) @ vectors.transpose(0, 2, 1)
    numbers = np.einsum("ckl,cdl,cd->ck", covariance, weighted, residual, optimize=True)
    # As a sum of squares: the shorter difference of two large numbers came out below zero.
    left = residual - np.einsum("cdk,ck->cd", columns, numbers)
    misfit = (left**2 / variance).sum(axis=-1) + (numbers**2).sum(axis=-1)
    joint = sum(each["log_weight"] for each in ways) - 0.5 * (
        misfit + np.log(2.0 * math.pi * variance).sum(axis=-1) + np.log(precision).sum(axis=-1))
    yaw = _yaw_evidence(rows, causes[-1])  # causes that change them are the last
    likeliest = np.argsort(-joint, kind="stable")
    near, k = likeliest[joint[likeliest] > joint.max() - math.log(CLEAR_ODDS)], likeliest[0]
    return Explanation(
        causes, float(np.logaddexp.reduce(joint)) + log_prior + yaw,
        misfit[likeliest] - 2.0 * yaw,
        [each[near] for each in ways], numbers[k], covariance[k],
        mean[k] + columns[k] @ numbers[k], left[k] / np.sqrt(variance[k]))


def _yaw_evidence(rows: Observations, cause: Cause) -> float:
    """Return the log-likelihood of the measured yaws by a cause's shares.

    It is relative to that of a yaw as it was said, which is the same for all causes.
    """
    known = np.isfinite(rows.yaw_off[:, 0])
    spread = np.hypot(rows.yaw_sd, SOLVED_YAW_SD_DEG)[known, None]
    off = (rows.yaw_off[known] + 180.0) % 360.0 - 180.0
    likelihood = np.hstack([
        np.exp(-0.5 * (off / spread) ** 2), spread * math.sqrt(2.0 * math.pi) / 360.0])
    total = np.log(likelihood @ np.transpose(cause.yaws)).sum(axis=0)
    return float(np.logaddexp.reduce(total)) - math.log(len(total))


def rank(rows: Observations) -> list[Explanation]:
    """Return all explanations of observations, by posterior probability."""
    found = [cause for cause in CAUSES if not cause.lacks(rows)]
    total = sum(cause.prior for cause in found)
    # Units of z alone beside a focal length would be any focal length.
    pairs = [pair for pair in itertools.combinations(found, 2)
             if not {cause.name for cause in pair} & {AGREE, STRAIGHT}
             and {cause.name for cause in pair} != {"units", FOCAL}]
    explanations = [
        # Who finds z wrong, and compared it with a straight tape, has made that mistake, too.
        explain(rows, causes, math.log(
            PAIRS_PRIOR ** (len(causes) - 1 + (
                straight_differs(rows) and causes[0].name not in {AGREE, STRAIGHT}))
            * math.prod(cause.prior / total for cause in causes)))
        for causes in [*((cause,) for cause in found), *pairs]]
    evidence = np.array([each.log_evidence for each in explanations])
    share = np.exp(evidence - np.logaddexp.reduce(evidence))
    return [replace(explanations[k], probability=float(share[k]))
            for k in np.argsort(-evidence, kind="stable")]


def rivals(ranked: Sequence[Explanation]) -> list[Explanation]:
    """Return explanations that the first is not told from; a cause beside the first is none."""
    first, *others = ranked
    return [each for each in others if first.names and not first.names < each.names
            and each.probability * CLEAR_ODDS > first.probability]


# --------------------------------------------------------------------------------------------------
# The next measurement: where two explanations differ most, in standard deviations.

# Angle of a new marker to the optical axis.
BEARING_DEG = 20.0

# Difference in standard deviations from which on one more row is worth taking.
DECIDES = 2.0


def next_measurement(rows: Observations, a: Explanation, b: Explanation) -> dict[str, Any]:
    """Return the row at which two explanations differ most relative to their uncertainty.

    Returns
    -------
    dict
        ``distance_m`` and ``bearing_deg``, where the marker is to stand; ``component``, which is
        "distance" along the line of sight, "x" to the right or "z" along the axis; and the
        ``difference`` of both predictions, in standard deviations.
    """
    undo = undone(a.way)[0]
    reach = np.linalg.norm(rows.said @ undo.T, axis=1)
    distance = np.geomspace(reach.min() / 3.0, reach.max() * 3.0, 30)
    if rows.camera is not None and rows.known_square:
        focal_size = float(np.median(reach * rows.side_px))  # as the image shows it
        # The square's side is measured from 20 px to 60 % of the frame's height.
        distance = focal_size / np.clip(focal_size / distance, 20.0, 1.2 * rows.camera.cy_px)
    bearing = math.radians(BEARING_DEG)
    truth = np.outer(distance, [math.sin(bearing), 0.0, math.cos(bearing)])
    # The program's answer if a were right.
    said = truth @ np.linalg.pinv(undo).T
    new = replace(
        rows, said=said, measured_sd=np.tile(tape_sd(distance), (4, 1)).T,
        measured=np.column_stack([truth[:, 0], distance * np.nan, truth[:, 2], distance]),
        speed=np.full(len(said), np.nanmean([*rows.speed, 0.0])))
    row, which = new.cells
    # A new row counts as apart, too, where an old one of its number does: those beside it decide.
    # The unknown zero points are those of the new row alone where it measures a new component.
    gap, variance = np.zeros(len(row)), np.full(len(row), rows.zero_sd_m**2)
    for sign, each in ((1.0, a), (-1.0, b)):
        own = slice(len(each.numbers) - len(np.unique(rows.cells[1])))
        mean, columns, noise = (part[0] for part in predict(new, each.causes, each.way))
        gap += sign * (mean + columns[:, own] @ each.numbers[own])
        variance += 0.5 * noise + np.einsum(
            "dk,kl,dl->d", columns[:, own], each.covariance[own, own], columns[:, own])
    difference = np.abs(gap) / np.sqrt(variance)
    # Of rows that decide well enough the one that is nearest to those measured.
    enough = difference >= min(float(difference.max()), 2.0 * DECIDES)
    effort = np.abs(np.log(distance[row] / np.median(reach)))
    k = int(np.argmin(np.where(enough, effort, np.inf)))
    return {
        "distance_m": float(distance[row[k]]), "bearing_deg": BEARING_DEG,
        "component": ("x", "y", "z", "distance")[which[k]], "difference": float(difference[k])}
