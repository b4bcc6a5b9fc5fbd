"""The model of a photograph of a printed plane: its image, and what cameras do to levels.

The level of a pixel is modelled as

    y = F(b + c m + d p + e m (1 - m)) + gx x + gy y + (hx x + hy y) F(m),
    F(z) = z + a (z - G(z)),

m is the share of white through a Gaussian point spread, p that of the area outside the modelled
paper; b, c, d are levels, e is the tone curve, g and h are the light's gradients on black and on
white, and F is sharpening of an amount a, G being the mean over a Gaussian of ``radius_px``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.compilation import compiled, compiled_inline
from sweep.measure.likelihood import DEPTH, SPREAD, MarkerView, plane_of
from sweep.measure.photograph_image import Slopes, add_plane, slope_space
from sweep.model.derivatives import POSE
from sweep.model.lens import jacobian, undistort
from sweep.model.projection import Optics, Projection
from sweep.typing import Floats

AMOUNT, OUTSIDE_VALUE, TONE = 13, 14, 15
CONTRAST = 16
STATE_LENGTH = 19
"""A state vector begins as that of :mod:`sweep.measure.likelihood`, up to the point spread; then
the amount of sharpening, and from the last solution of the linear parameters the value of outside
and the tone, both as shares of the contrast, and the contrast with its slopes along x and y."""

MAX_TONE = 2.0
"""Largest tone, as a share of the contrast, for which slopes are computed."""

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
    used
        (height, width): whether a pixel is fitted.
    rays
        (height, width, 6) undistorted direction x/z, y/z of each pixel, and the derivatives of
        its u and v by them, row by row, in px.
    at
        (2, height, width) x and y relative to the marker's centre, in halves of its extent.
    """

    marker: MarkerView
    levels: Floats
    used: NDArray[np.bool_]
    rays: Floats
    at: Floats


class System(NamedTuple):
    """Scratch space of a fit.

    Attributes
    ----------
    slopes
        As :func:`sweep.measure.photograph_image.slope_space` returns it.
    images
        (8, height, width): the image, the tone's term, slopes by x, y and variance, the area
        outside, the difference of the image to the smoothed one; and scratch.
    scratch
        (height, width).
    """

    slopes: Slopes
    images: Floats
    scratch: Floats


@compiled
def system(height: int, width: int) -> System:
    """Return the scratch space for a box."""
    return System(
        slope_space(height, width), np.zeros((8, height, width)), np.zeros((height, width))
    )


@compiled
def rays_of(optics: Optics, height: int, width: int) -> Floats:
    """Return the rays (height, width, 6) of a box, as :class:`PhotographView` has them."""
    rays = np.empty((height, width, 6))
    fx, fy, cx, cy = optics.intrinsics
    if not optics.distorted:
        for i in range(height):
            for j in range(width):
                rays[i, j, 0], rays[i, j, 1] = (j - cx) / fx, (i - cy) / fy
                rays[i, j, 2], rays[i, j, 3], rays[i, j, 4], rays[i, j, 5] = fx, 0.0, 0.0, fy
        return rays
    rows = (height - 1) // LENS_STEP_PX + 2
    columns = (width - 1) // LENS_STEP_PX + 2
    lattice = np.empty((rows, columns, 6))
    for i in range(rows):
        for j in range(columns):
            x, y, _ = undistort(
                (j * LENS_STEP_PX - cx) / fx, (i * LENS_STEP_PX - cy) / fy, optics.lens
            )
            a, b, c, d = jacobian(x, y, optics.lens)
            lattice[i, j, 0], lattice[i, j, 1] = x, y
            lattice[i, j, 2], lattice[i, j, 3] = fx * a, fx * b
            lattice[i, j, 4], lattice[i, j, 5] = fy * c, fy * d
    for i in range(height):
        row, down = i // LENS_STEP_PX, (i % LENS_STEP_PX) / LENS_STEP_PX
        for j in range(width):
            column, right = j // LENS_STEP_PX, (j % LENS_STEP_PX) / LENS_STEP_PX
            for k in range(6):
                above = (
                    lattice[row, column, k] * (1.0 - right)
                    + lattice[row, column + 1, k] * right
                )
                below = (
                    lattice[row + 1, column, k] * (1.0 - right)
                    + lattice[row + 1, column + 1, k] * right
                )
                rays[i, j, k] = above * (1.0 - down) + below * down
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
        for k in range(1, min(half, width - 1) + 1):
            share = kernel[k]
            ahead, begin = row[k:], out[: width - k]
            behind, end = row[: width - k], out[k:]
            for j in range(width - k):
                begin[j] += share * ahead[j]
            for j in range(width - k):
                end[j] += share * behind[j]
    for i in range(height):
        out = smoothed[i]
        row = scratch[i]
        for j in range(width):
            out[j] = kernel[0] * row[j]
        for k in range(1, half + 1):
            share = kernel[k]
            if i >= k:
                above = scratch[i - k]
                for j in range(width):
                    out[j] += share * above[j]
            if i + k < height:
                below = scratch[i + k]
                for j in range(width):
                    out[j] += share * below[j]


@compiled
def draw(view: PhotographView, state: Floats, nuisances: Nuisances, work: System) -> None:
    """Write the images of a state to ``work.images``."""
    (rates, curved, outsides), images = work.slopes, work.images
    height, width = view.used.shape
    values = np.zeros(3)
    values[0], values[2] = state[OUTSIDE_VALUE] * nuisances.outside, 1.0
    add_plane(
        work.slopes, view.marker.edges, values,
        Projection(plane_of(state, view.marker), view.marker.optics), state[SPREAD],
    )
    tone = min(max(state[TONE], -MAX_TONE), MAX_TONE)
    for i in range(height):
        # Beyond the modelled extent is black.
        level, outside = 0.0, 0.0
        for j in range(width):
            level += rates[i, 4 * j]
            outside += outsides[i, j]
            images[0, i, j] = level
            images[1, i, j] = level * (1.0 - level)
            images[5, i, j] = outside
            gain = 1.0 + tone * (1.0 - 2.0 * level)
            images[2, i, j] = gain * rates[i, 4 * j + 1]
            images[3, i, j] = gain * rates[i, 4 * j + 2]
            images[4, i, j] = gain * (rates[i, 4 * j + 3] + curved[i, j])
            curved[i, j] = 0.0
        rates[i] = 0.0
        outsides[i] = 0.0
    if not nuisances.sharpening:
        return
    amount = state[AMOUNT]
    for k in range(6):
        if (k == 5 and not nuisances.outside) or (k == 1 and not nuisances.tone):
            continue
        smooth(images[k], nuisances.radius_px, images[7], work.scratch)
        share = 1.0 if k == 0 else tone
        for i in range(height):
            for j in range(width):
                difference = images[k, i, j] - images[7, i, j]
                images[k, i, j] += amount * difference
                if k == 0:
                    images[6, i, j] = difference
                elif k == 1:
                    images[6, i, j] += share * difference


@compiled_inline
def columns_at(
    view: PhotographView, state: Floats, nuisances: Nuisances, images: Floats,
    i: int, j: int, column: Floats,
) -> None:
    """Write the model's derivatives at a pixel: by what is moved, and by the linear parameters.

    The order: six of the pose, the point spread's variance, the amount; black, contrast, outside,
    tone, and the light's gradients, of those which are estimated.
    """
    rays = view.rays
    ray_x, ray_y = rays[i, j, 0], rays[i, j, 1]
    x_at, y_at = view.at[0, i, j], view.at[1, i, j]
    scale = state[CONTRAST] + state[CONTRAST + 1] * x_at + state[CONTRAST + 2] * y_at
    # The slope by the direction, from that by the pixel.
    by_x = scale * (images[2, i, j] * rays[i, j, 2] + images[3, i, j] * rays[i, j, 4])
    by_y = scale * (images[2, i, j] * rays[i, j, 3] + images[3, i, j] * rays[i, j, 5])
    # The plane's normal is the third column of the rotation matrix, position follows it.
    inverse = (state[2] * ray_x + state[5] * ray_y + state[8]) / (
        state[2] * state[9] + state[5] * state[10] + state[8] * state[11]
    )
    px = ray_x - inverse * state[9]
    py = ray_y - inverse * state[10]
    pz = 1.0 - inverse * state[11]
    by_z = ray_x * by_x + ray_y * by_y
    nearness = abs(state[DEPTH]) * inverse
    column[0] = by_y * pz + by_z * py
    column[1] = -by_x * pz - by_z * px
    column[2] = by_x * py - by_y * px
    column[3] = -by_x * nearness
    column[4] = -by_y * nearness
    column[5] = by_z * nearness
    column[6] = scale * images[4, i, j]
    k = 7
    if nuisances.sharpening:
        column[k] = scale * images[6, i, j]
        k += 1
    share = images[0, i, j]
    column[k] = 1.0
    column[k + 1] = share
    k += 2
    if nuisances.outside:
        column[k] = images[5, i, j]
        k += 1
    if nuisances.tone:
        column[k] = images[1, i, j]
        k += 1
    if nuisances.light:
        column[k], column[k + 1] = x_at, y_at
        column[k + 2], column[k + 3] = x_at * share, y_at * share
        k += 4
    column[k] = view.levels[i, j]


@compiled
def counts(nuisances: Nuisances) -> tuple[int, int]:
    """Return how many parameters are moved, and how many are linear."""
    return (
        POSE + 1 + int(nuisances.sharpening),
        2 + int(nuisances.outside) + int(nuisances.tone) + 4 * int(nuisances.light),
    )
