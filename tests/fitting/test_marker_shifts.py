"""The size and reach of shifts from sums of squares, against fields drawn by plain NumPy."""

import dataclasses

import numpy as np
import pytest

from sweep.fitting.fit import LENGTHS, Residuals, shifts_of

WIDTH_PX, SIZE_PX, LENGTH_PX = 360.0, 0.15, 40.0
PAIRS = 8
NOISE = 0.02**2 * np.eye(2 * PAIRS)


def field(points, length_px):
    distances = ((points[:, None] - points[None]) ** 2).sum(axis=2)
    return np.exp(-0.5 * distances / length_px**2)


def photograph(generator):
    """Return what fields lead to in a photograph, and a function that draws its sums of squares.

    Pairs of points stand for markers; the sums are of their means and of their differences.
    """
    centres = generator.uniform(0, WIDTH_PX, (PAIRS, 2))
    across = generator.uniform(-20, 20, (PAIRS, 2))
    points = np.concatenate([centres + across, centres - across], axis=1).reshape(-1, 2)
    means = np.kron(np.eye(PAIRS), np.full((2, 2), 0.5))
    forms = (means, np.eye(2 * PAIRS) - means)
    fields = np.array([
        [np.trace(form @ field(points, length * WIDTH_PX)) for length in LENGTHS]
        for form in forms
    ])
    factor = np.linalg.cholesky(SIZE_PX**2 * field(points, LENGTH_PX) + NOISE)

    noise = np.array([np.trace(form @ NOISE) for form in forms])

    def squares():
        drawn = factor @ generator.normal(size=len(points))
        return np.array([drawn @ form @ drawn for form in forms]) - noise

    return Residuals(np.zeros(2), fields), squares


@pytest.mark.evidence
def test_intervals_of_size_and_reach_hold_what_was_drawn():
    generator = np.random.default_rng(3)
    photographs = [photograph(generator) for _ in range(8)]
    held = np.zeros(2)
    for _ in range(400):
        found = shifts_of(
            [dataclasses.replace(known, squares=draw()) for known, draw in photographs], WIDTH_PX)
        held += (
            found.size_px.low <= SIZE_PX <= found.size_px.high,
            found.length_px.low <= LENGTH_PX <= found.length_px.high,
        )
    print(held / 400)
    # Of 400 intervals of 95 %, fewer than 356 hold the truth with a probability below 1e-6.
    assert (held >= 356).all()
    assert (held < 400).all()
