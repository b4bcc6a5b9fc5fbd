"""The model of a photograph of a printed plane: its image, and what cameras do to levels.

The level of a pixel is modelled as

    y = F(b + c m + d p + e m (1 - m)) + gx x + gy y + (hx x + hy y) F(m),
    F(z) = z + a (z - G(z)),

m is the share of white through a Gaussian point spread, p that of the area outside the modelled
paper; b, c, d are levels, e is the tone curve, g and h are the light's gradients on black and on
white, and F is sharpening of an amount a, G being the mean over a Gaussian of ``radius_px``.
With a c as a parameter in the place of a, all but the pose and the point spread is linear.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sweep.compilation import compiled, compiled_inline
from sweep.measure.likelihood import DEPTH, SPREAD, MarkerView, plane_of
from sweep.measure.photograph_image import Slopes, add_plane, slope_space
from sweep.model.derivatives import POSE
from sweep.model.lens import jacobian, undistort
from sweep.model.projection import Optics, Projection
from sweep.typing import Floats, Integers

AMOUNT, OUTSIDE_VALUE, TONE = 13, 14, 15
CONTRAST = 16
STATE_LENGTH = 19
"""A state vector begins as that of :mod:`sweep.measure.likelihood`, up to the point spread; then
from the last solution of the linear parameters the amount of sharpening, the value of outside and
the tone, both as shares of the contrast, and the contrast with its slopes along x and y."""

MOVED = POSE + 1
"""Parameters that are moved: the pose's, and the point spread's variance."""

MAX_TONE = 5.0
"""Largest tone, as a share of the contrast, for which slopes are computed."""

MIN_AMOUNT, MAX_AMOUNT = -0.9, 5.0
"""Range of the amount of sharpening for which slopes are computed."""

LENS_STEP_PX = 8
"""Pixels between those at which the lens is inverted; between them it is interpolated."""


class Nuisances(NamedTuple):
    """Which nuisances are estimated beside the pose, the point spread and the levels.

    Attributes
    ----------
    outside, light, tone, sharpening
        The level outside the paper, light that varies linearly, the tone curve, and sharpening.
    radius_px
        Radius of the sharpening in px.
    """

    outside: bool
    light: bool
    tone: bool
    sharpening: bool
    radius_px: float


class PhotographView(NamedTuple):
    """A box of a photograph with what is known of it.

    Attributes
    ----------
    marker
        The plane's edges, the extent that they describe, and the camera; the principal point is
        relative to the box.
    levels
        (height, width) grey levels.
    spans
        (height, 2) the first fitted pixel of each row, and the one after the last.
    rays
        (6, height, width) undistorted direction x/z, y/z of each pixel, and the derivatives of
        its u and v by them, row by row, in px.
    at
        (2, height, width) x and y relative to the marker's centre, in halves of its extent.
    panel_px
        Least length of the pieces in which edges are integrated.
    """

    marker: MarkerView
    levels: Floats
    spans: Integers
    rays: Floats
    at: Floats
    panel_px: float


class System(NamedTuple):
    """Scratch space of a fit.

    Attributes
    ----------
    slopes
        As :func:`sweep.measure.photograph_image.slope_space` returns it.
    images
        (8, height, width): the level's slopes by contrast, tone, x, y, the point spread's variance,
        the area outside and the amount of sharpening, all as shares of the contrast; and the share
        of white, sharpened.
    scratch
        (2, height, width).
    """

    slopes: Slopes
    images: Floats
    scratch: Floats


@compiled
def system(height: int, width: int) -> System:
    """Return the scratch space for a box."""
    return System(
        slope_space(height, width), np.empty((8, height, width)), np.empty((2, height, width))
    )


@compiled
def pixel_count(view: PhotographView) -> int:
    """Return how many pixels are fitted."""
    total = 0
    for i in range(len(view.spans)):
        total += view.spans[i, 1] - view.spans[i, 0]
    return total


@compiled
def rays_of(optics: Optics, height: int, width: int) -> Floats:
    """Return the rays (6, height, width) of a box, as :class:`PhotographView` has them."""
    rays = np.empty((6, height, width))
    fx, fy, cx, cy = optics.intrinsics
    if not optics.distorted:
        for i in range(height):
            for j in range(width):
                rays[0, i, j], rays[1, i, j] = (j - cx) / fx, (i - cy) / fy
                rays[2, i, j], rays[3, i, j], rays[4, i, j], rays[5, i, j] = fx, 0.0, 0.0, fy
        return rays
    rows = (height - 1) // LENS_STEP_PX + 2
    columns = (width - 1) // LENS_STEP_PX + 2
    lattice = np.empty((6, rows, columns))
    for i in range(rows):
        for j in range(columns):
            x, y, _ = undistort(
                (j * LENS_STEP_PX - cx) / fx, (i * LENS_STEP_PX - cy) / fy, optics.lens
            )
            a, b, c, d = jacobian(x, y, optics.lens)
            lattice[0, i, j], lattice[1, i, j] = x, y
            lattice[2, i, j], lattice[3, i, j] = fx * a, fx * b
            lattice[4, i, j], lattice[5, i, j] = fy * c, fy * d
    blended = np.empty(columns)
    for k in range(6):
        for i in range(height):
            row, down = i // LENS_STEP_PX, (i % LENS_STEP_PX) / LENS_STEP_PX
            for j in range(columns):
                blended[j] = (
                    lattice[k, row, j] * (1.0 - down) + lattice[k, row + 1, j] * down
                )
            for j in range(width):
                column, right = j // LENS_STEP_PX, (j % LENS_STEP_PX) / LENS_STEP_PX
                rays[k, i, j] = blended[column] * (1.0 - right) + blended[column + 1] * right
    return rays


@compiled
def smooth(image: Floats, radius: float, smoothed: Floats, scratch: Floats) -> None:
    """Write an image's (height, width) mean over a Gaussian; zeros lie beyond the box."""
    height, width = image.shape
    half = math.ceil(3.0 * radius)
    kernel = np.empty(half + 1)
    total = 0.0
    for k in range(half + 1):
        kernel[k] = math.exp(-0.5 * (k / radius) ** 2)
        total += kernel[k] if k == 0 else 2.0 * kernel[k]
    for k in range(half + 1):
        kernel[k] /= total
    for i in range(height):
        row, out = image[i], scratch[i]
        for j in range(width):
            out[j] = kernel[0] * row[j]
        for k in range(1, min(half, width // 2) + 1):
            share = kernel[k]
            for j in range(k):
                out[j] += share * row[j + k]
                out[width - 1 - j] += share * row[width - 1 - j - k]
            middle, before, after = out[k : width - k], row[: width - 2 * k], row[2 * k :]
            for j in range(width - 2 * k):
                middle[j] += share * (before[j] + after[j])
    for i in range(height):
        out, row = smoothed[i], scratch[i]
        for j in range(width):
            out[j] = kernel[0] * row[j]
        for k in range(1, half + 1):
            share = kernel[k]
            above, below = scratch[max(i - k, 0)], scratch[min(i + k, height - 1)]
            if i >= k and i + k < height:
                for j in range(width):
                    out[j] += share * (above[j] + below[j])
            elif i >= k or i + k < height:
                one = above if i >= k else below
                for j in range(width):
                    out[j] += share * one[j]


@compiled
def draw(view: PhotographView, state: Floats, nuisances: Nuisances, work: System) -> None:
    """Write the images of a state to ``work.images``."""
    (rates, outsides), images = work.slopes, work.images
    height, width = view.levels.shape
    values = np.zeros(3)
    # The level of what is outside is no slope's if it is not estimated.
    values[0], values[2] = state[OUTSIDE_VALUE] if nuisances.outside else 1.0, 1.0
    add_plane(
        work.slopes, view.marker.edges, values,
        Projection(plane_of(state, view.marker), view.marker.optics), state[SPREAD],
        view.panel_px,
    )
    tone = min(max(state[TONE], -MAX_TONE), MAX_TONE)
    for i in range(height):
        # Beyond the modelled extent is black.
        level, outside = 0.0, 0.0
        shares, squares, by_x, by_y = images[0, i], images[1, i], images[2, i], images[3, i]
        by_spread, outer, row, steps = images[4, i], images[5, i], rates[i], outsides[i]
        for j in range(width):
            level += row[4 * j]
            outside += steps[j]
            shares[j] = level
            squares[j] = level * (1.0 - level)
            outer[j] = outside
            gain = 1.0 + tone * (1.0 - 2.0 * level)
            by_x[j] = gain * row[4 * j + 1]
            by_y[j] = gain * row[4 * j + 2]
            by_spread[j] = gain * row[4 * j + 3]
        row[:] = 0.0
        steps[:] = 0.0
    if not nuisances.sharpening:
        return
    amount = min(max(state[AMOUNT], MIN_AMOUNT), MAX_AMOUNT)
    smoothed, scratch = work.scratch[0], work.scratch[1]
    for k in range(5):
        if k == 1 and not nuisances.tone:
            continue
        smooth(images[k], nuisances.radius_px, smoothed, scratch)
        for i in range(height):
            image, mean, added, sharp = images[k, i], smoothed[i], images[6, i], images[7, i]
            if k == 0:
                for j in range(width):
                    added[j] = image[j] - mean[j]
                for j in range(width):
                    sharp[j] = image[j] + amount * added[j]
            elif k == 1:
                # Newton's step of contrast, tone and sharpening: amount · tone is a product.
                shares = images[0, i]
                for j in range(width):
                    difference = image[j] - mean[j]
                    image[j] += amount * difference
                    added[j] += tone * difference
                    shares[j] -= amount * tone * difference
            else:
                for j in range(width):
                    image[j] += amount * (image[j] - mean[j])


@compiled
def write_columns(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats,
    i: int, first: int, columns: Floats,
) -> None:
    """Write the model's derivatives at pixels of a row to ``columns`` (n, ...), from one on.

    The order: six of the pose, the point spread's variance; black, contrast, outside, tone,
    sharpening and the light's gradients, of those which are estimated; the level itself.
    """
    last = first + len(columns)
    ray_x, ray_y = view.rays[0, i, first:last], view.rays[1, i, first:last]
    ux, uy = view.rays[2, i, first:last], view.rays[3, i, first:last]
    vx, vy = view.rays[4, i, first:last], view.rays[5, i, first:last]
    at_x, at_y = view.at[0, i, first:last], view.at[1, i, first:last]
    shares, by_u, by_v = (
        images[0, i, first:last], images[2, i, first:last], images[3, i, first:last]
    )
    by_spread = images[4, i, first:last]
    contrast, along_x, along_y = state[CONTRAST], state[CONTRAST + 1], state[CONTRAST + 2]
    position_x, position_y, position_z = state[9], state[10], state[11]
    # The plane's normal is the third column of the rotation matrix, position follows it.
    height = state[2] * position_x + state[5] * position_y + state[8] * position_z
    normal_x, normal_y, normal_z = state[2] / height, state[5] / height, state[8] / height
    depth = abs(state[DEPTH])
    for j in range(len(columns)):
        column = columns[j]
        x, y = ray_x[j], ray_y[j]
        scale = contrast + along_x * at_x[j] + along_y * at_y[j]
        # The slope by the direction, from that by the pixel.
        du, dv = scale * by_u[j], scale * by_v[j]
        by_x = du * ux[j] + dv * vx[j]
        by_y = du * uy[j] + dv * vy[j]
        inverse = normal_x * x + normal_y * y + normal_z
        px = x - inverse * position_x
        py = y - inverse * position_y
        pz = 1.0 - inverse * position_z
        by_z = x * by_x + y * by_y
        nearness = depth * inverse
        column[0] = by_y * pz + by_z * py
        column[1] = -by_x * pz - by_z * px
        column[2] = by_x * py - by_y * px
        column[3] = -by_x * nearness
        column[4] = -by_y * nearness
        column[5] = by_z * nearness
        column[6] = scale * by_spread[j]
        column[7] = 1.0
        column[8] = shares[j]
    k = MOVED + 2
    if nuisances.outside:
        _copy(images[5, i, first:last], columns, k)
        k += 1
    if nuisances.tone:
        _copy(images[1, i, first:last], columns, k)
        k += 1
    if nuisances.sharpening:
        _copy(images[6, i, first:last], columns, k)
        k += 1
    if nuisances.light:
        sharp = images[7 if nuisances.sharpening else 0, i, first:last]
        for j in range(len(columns)):
            column = columns[j]
            column[k], column[k + 1] = at_x[j], at_y[j]
            column[k + 2], column[k + 3] = at_x[j] * sharp[j], at_y[j] * sharp[j]
        k += 4
    _copy(view.levels[i, first:last], columns, k)


@compiled_inline
def _copy(row: Floats, columns: Floats, k: int) -> None:
    """Write a row (n,) as the k-th of ``columns`` (n, ...)."""
    for j in range(len(row)):
        columns[j, k] = row[j]


@compiled
def linear_count(nuisances: Nuisances) -> int:
    """Return how many parameters are linear."""
    return (
        2 + int(nuisances.outside) + int(nuisances.tone) + int(nuisances.sharpening)
        + 4 * int(nuisances.light)
    )
