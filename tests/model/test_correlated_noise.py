"""Correlated noise and noise by level against closed forms; all statistics are seeded.

A correct sensor passes each statistical test with a probability of at least 1 - 1e-6.
"""

import math

import numpy as np
import pytest

from support.lengths import lengths
from support.small_scenes import image_of
from sweep.model.sensor import noise_kernel, normal_field

FAR = 5.5
"""Standard deviations that a normal number exceeds with a probability of 4e-8."""

CORRELATIONS = (0.01, 0.3, 0.5, 0.8, 0.99)


@pytest.mark.parametrize("correlation", CORRELATIONS)
def test_weights_have_the_correlation_of_the_closed_form(correlation):
    kernel = noise_kernel(correlation)
    at = [math.fsum(kernel[: len(kernel) - lag] * kernel[lag:]) for lag in range(5)]
    assert at[0] == pytest.approx(1, abs=1e-14)
    assert at[1] == pytest.approx(correlation, rel=1e-10)
    if correlation >= 0.8:  # nearly a continuous Gaussian: r(2 lags) = r(lag)**4
        assert at[2] == pytest.approx(correlation**4, rel=0.01)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.5, 0.9])
@lengths(300, 1500)
def test_field_has_mean_variance_and_correlations_of_the_weights(count, correlation):
    field = normal_field(np.uint64(77), 0, 5, 9, (count, count), correlation)
    kernel = noise_kernel(correlation) if correlation else np.ones(1)
    reach = 2 * len(kernel) + 4
    padded = np.convolve(kernel, kernel[::-1])
    along = np.zeros(2 * reach + 1)
    half = len(padded) // 2
    along[reach - half : reach + half + 1] = padded
    plane = np.outer(along, along)
    deviation = math.sqrt(plane.sum()) / count
    assert abs(field.mean()) < FAR * deviation
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (3, 0)):
        product = field[down:, right:] * field[: count - down, : count - right]
        expected = plane[reach + down, reach + right]
        # Covariances of products of a normal field (Isserlis): r(k)² + r(k + d) r(k - d).
        moved = np.roll(plane, (down, right), (0, 1)) * np.roll(plane, (-down, -right), (0, 1))
        deviation = math.sqrt((plane**2 + moved).sum() / product.size)
        assert abs(product.mean() - expected) < FAR * deviation, (down, right)


# In images: levels, table, quantisation.

FLAT = ["background=120", "distance_m=10", "width_px=400", "height_px=300", "quiet_zone_modules=0"]
"""A marker of 1 px, and the background around it."""


def corner(settings, background=120):
    image = image_of([*FLAT, f"background={background}", *settings]).astype(float)
    return image[:, :190]


@pytest.mark.parametrize("table", [(0, 2.0, 255, 10.0), (60, 8.0, 120, 3.0, 200, 5.0), (9, 4.0)])
@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_noise_over_the_level_is_the_table(table, correlation):
    settings = [f"noise_table={list(table)}", f"noise_correlation={correlation}"]
    for level in (45, 90, 120, 190, 230):
        noise = corner(settings if correlation else settings[:1], level) - level
        spread = np.interp(level, table[::2], table[1::2])
        pixels = noise.size / (6 if correlation else 1)
        # Clipping takes less than 1e-4 of a normal number's variance beyond 4 deviations.
        theory = math.sqrt(spread**2 + 1 / 12)
        assert noise.std() == pytest.approx(theory, rel=FAR / math.sqrt(2 * pixels) + 2e-4)
