"""Conventions of corners are recognised from what a detector returns."""

import numpy as np
import pytest

from sweep.conformance.check import conventions, order_faults

DECLARED = (0, 1, 2, 3)


def truth(count=32):
    """Squares that are turned, and the point reflection of each about (319.5, 239.5)."""
    rng = np.random.default_rng(8)
    angle = rng.uniform(0, 2 * np.pi, count // 2)[:, None] + np.arange(4) * np.pi / 2
    reach = rng.uniform(40, 110, (count // 2, 1))
    corners = np.stack([np.cos(angle), np.sin(angle)], axis=2) * reach[:, :, None]
    corners += rng.uniform(-60, 60, (count // 2, 1, 2)) + np.array([319.5, 239.5])
    return np.concatenate([corners, 2 * np.array([319.5, 239.5]) - corners])


def faults_of(change, ids=lambda number: number, *, declared=DECLARED, center=0.0, noise=0.2):
    corners, marker_id = truth(), np.arange(32) % 16 + 5
    rng = np.random.default_rng(3)
    returned = change(corners + rng.normal(0, noise, corners.shape))
    found = [[(int(ids(number)), quad)] for number, quad in zip(marker_id, returned, strict=True)]
    return order_faults(conventions(found, marker_id, corners), declared, center)


@pytest.mark.parametrize(("change", "line"), [
    (lambda c: c + 0.5, "corners are offset by (0.5"),
    (lambda c: c + np.array([0.2, -0.1]), "no pixel_center is the reason"),
    (lambda c: np.roll(c, 1, axis=1), "turned by one: declare corner_order = (1, 2, 3, 0)"),
    (lambda c: np.roll(c, 2, axis=1), "turned by two (180°): declare corner_order = (2, 3, 0, 1)"),
    (lambda c: c[:, [1, 0, 3, 2]], "the other way round, or cross: declare corner_order = (1, 0,"),
    (lambda c: c[..., ::-1], "no pixels of the image"),
    (lambda c: c * [1, -1] + np.array([0, 479]), "y downwards"),
    (lambda c: np.array([quad[np.lexsort(quad.T)] for quad in c]), "in no fixed order"),
])
def test_a_wrong_convention_is_told_with_what_to_declare(change, line):
    assert line in "\n".join(faults_of(change))


def test_what_is_declared_is_the_start_of_what_to_declare():
    faults = faults_of(lambda c: np.roll(c, 1, axis=1), declared=(1, 0, 3, 2))
    assert faults == ["corners are turned by one: declare corner_order = (0, 3, 2, 1)"]
    assert "declare pixel_center = 0.5" in faults_of(lambda c: c + 0.5)[0]
    assert "declare pixel_center = 0" in faults_of(lambda c: c - 0.5, center=0.5)[0]


def test_wrong_ids_are_told():
    (line,) = faults_of(lambda c: c, ids=lambda number: number + 1)
    assert line.startswith("IDs are wrong in 32 of 32 scenes, always +1: ")
    (line,) = faults_of(lambda c: c, ids=lambda number: number if number % 4 else 700)
    assert line.startswith("IDs are wrong in 8 of 32 scenes: 700 for marker 8")


def test_nothing_found_has_no_conventions():
    assert conventions([[]] * 32, np.arange(32), truth()) is None


def test_of_several_markers_the_one_with_the_right_id_counts():
    corners, marker_id = truth(), np.arange(32)
    found = [
        [(99, quad + 1), (int(number), quad)]
        for number, quad in zip(marker_id, corners, strict=True)
    ]
    result = conventions(found, marker_id, corners)
    assert not result.ids
    assert np.abs(result.offset_px).max() < 1e-9
