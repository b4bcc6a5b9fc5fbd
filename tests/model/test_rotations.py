"""Rotations by the angles that users give, against SciPy's Rotation and closed forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sweep.model.pose import (
    ABOUT_X_180,
    angles_of_rotation,
    orientation,
    pose_in_camera,
    rotation_of_angles,
    towards,
)

TOLERANCE = 4e-15
"""Of an element: some ten roundings of sines, cosines and their products, each of 1.1e-16."""


def random_angles(count, seed=0):
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-2 * np.pi, 2 * np.pi, (3, count))
    special = np.radians([0, 90, -90, 180, -180, 360, 89.9, 1e-9, 179.999999999])
    grid = np.stack(np.meshgrid(special, special, special), axis=0).reshape(3, -1)
    return np.concatenate([angles, grid], axis=1)


def test_tilt_azimuth_and_roll_of_a_rotation_are_those_that_make_it():
    tilt, azimuth, roll = random_angles(2000, 1)
    for rotation in (
        rotation_of_angles(tilt, azimuth, roll),
        Rotation.random(5000, rng=2).as_matrix(),
        Rotation.from_rotvec(1e-12 * np.eye(3)).as_matrix() @ ABOUT_X_180,
    ):
        angles = angles_of_rotation(rotation)
        np.testing.assert_allclose(rotation_of_angles(*angles), rotation, atol=TOLERANCE)
        assert (angles[0] >= 0).all()
        assert (angles[0] <= np.pi).all()
        assert (np.abs(angles[1:]) <= np.pi).all()


def sights(count):
    """Lines of sight up to 89.9° off the axis, from 1 mm to 1 km away."""
    rng = np.random.default_rng(4)
    off = np.radians(np.concatenate([rng.uniform(0, 89.9, count), [0, 1e-9, 80, 89.9]]))
    around = rng.uniform(0, 2 * np.pi, len(off))
    length = 10.0 ** rng.uniform(-3, 3, len(off))
    return (length * np.array(
        [np.sin(off) * np.cos(around), np.sin(off) * np.sin(around), np.cos(off)]
    )).T


def test_the_smallest_rotation_to_a_line_of_sight_is_scipys():
    sight = sights(1000)
    expected = []
    for each in sight / np.linalg.norm(sight, axis=1, keepdims=True):
        axis = np.cross([0, 0, 1], each)
        sine = np.linalg.norm(axis)
        angle = np.arctan2(sine, each[2])
        expected.append(Rotation.from_rotvec(axis * (angle / sine if sine else 1.0)).as_matrix())
    np.testing.assert_allclose(towards(sight), np.array(expected), atol=TOLERANCE)


@pytest.mark.parametrize(
    ("camera", "marker", "position", "normal", "up"),
    [
        # A camera at the origin that looks along x, a marker 2 m ahead that faces it.
        ([0, 0, 0, 0, 0, 0], [2, 0, 0, 180, 0, 0], [0, 0, 2], [0, 0, -1], [0, -1, 0]),
        # The marker lies 1 m to the left and 0.5 m up.
        ([0, 0, 0, 0, 0, 0], [2, 1, 0.5, 180, 0, 0], [-1, -0.5, 2], [0, 0, -1], [0, -1, 0]),
        # A camera 3 m up that looks straight down at a marker on the floor, face up, whose upper
        # side points along x, as the image's does.
        ([0, 0, 3, 0, 90, 0], [0, 0, 0, 180, -90, 0], [0, 0, 3], [0, 0, -1], [0, -1, 0]),
        # A camera that is turned to the left by 90° sees what lies to the left.
        ([1, 0, 0, 90, 0, 0], [1, 5, 0, -90, 0, 0], [0, 0, 5], [0, 0, -1], [0, -1, 0]),
        # A camera rolled by 90° to its right sees up at its left.
        ([0, 0, 0, 0, 0, 90], [2, 0, 0, 180, 0, 0], [0, 0, 2], [0, 0, -1], [-1, 0, 0]),
        # Behind the camera.
        ([0, 0, 0, 0, 0, 0], [-2, 0, 0, 0, 0, 0], [0, 0, -2], [0, 0, 1], [0, -1, 0]),
    ],
)
def test_places_in_the_world_by_hand(camera, marker, position, normal, up):
    parts = []
    for x, y, z, *angles in (camera, marker):
        parts += [np.array([[x, y, z]], float), orientation(*np.radians(angles)[:, None])]
    rotation, found = pose_in_camera(*parts)
    np.testing.assert_allclose(found[0], position, atol=1e-15 * 10)
    np.testing.assert_allclose(rotation[0] @ [0, 0, 1], normal, atol=TOLERANCE)
    np.testing.assert_allclose(rotation[0] @ [0, 1, 0], up, atol=TOLERANCE)
