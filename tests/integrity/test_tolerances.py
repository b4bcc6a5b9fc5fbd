"""A recomputed scene against the stored one: to the bit here, within tolerances elsewhere."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sweep.integrity.recomputation import compare

TURN = Rotation.from_rotvec([0.3, -0.2, 0.1])


def scene():
    """Return the values of one scene under two estimators."""
    return {
        "true_rvec": np.array([3.0, 0.1, 0.2]),
        "true_tvec_m": np.array([0.0, 0.3, 0.4]),
        "marker_area_px": np.array(900.0),
        "bound": np.array(1, dtype="u1"),
        "bound_std": np.full(6, 1e-3, dtype="f4"),
        "mirror_distance": np.array(np.nan, dtype="f4"),
        "detection": np.array(1, dtype="u1"),
        "corner_error_px": np.full((4, 2), 0.1, dtype="f4"),
        "estimate": np.array([1, 3], dtype="u1"),
        "translation_error_m": np.array([[1e-3, 0, 2e-3], [np.nan] * 3], dtype="f4"),
        "rotation_error_rad": np.array([TURN.as_rotvec(), [np.nan] * 3], dtype="f4"),
        "rotation_error_deg": np.array([21.4, np.nan], dtype="f4"),
        "reprojection_error_px": np.array([0.2, np.nan], dtype="f4"),
        "nees": np.array([5.0, np.nan], dtype="f4"),
    }


def found(name, change, *, same_processor=False):
    """Return what differs where a variable is changed, to an array or by a number."""
    values = scene()
    changed = change(values[name]) if callable(change) else values[name] + change
    values[name] = changed.astype(values[name].dtype)
    return compare(values, scene(), same_processor=same_processor)


def turned(angle_rad):
    """Return the change by which the first estimate is turned further."""
    def change(vectors):
        further = TURN * Rotation.from_rotvec([0, angle_rad, 0])
        return np.array([further.as_rotvec(), vectors[1]])

    return change


@pytest.mark.parametrize("name", scene())
def test_every_bit_counts_on_the_same_processor(name):
    values, stored = scene(), scene()
    assert compare(values, stored, same_processor=True) == ""
    flat = values[name].reshape(-1)
    flat[0] = np.nextafter(flat[0], 9, dtype=flat.dtype) if flat.dtype.kind == "f" else 7
    if np.isnan(flat[0]):
        flat[0] = 0
    assert compare(values, stored, same_processor=True).startswith(f"{name} ")


@pytest.mark.parametrize(
    ("name", "within", "beyond"),
    [
        ("corner_error_px", 0.009, 0.011), ("reprojection_error_px", -0.009, 0.011),
        # 1e-4 rad in degrees.
        ("rotation_error_deg", 0.0055, -0.006),
        # 1e-4 of 0.5 m, as the length of the difference.
        ("translation_error_m", [2.5e-5, 3e-5, 2.5e-5], [3.5e-5, 3.5e-5, 3.5e-5]),
        ("rotation_error_rad", turned(0.9e-4), turned(1.1e-4)),
        ("detection", 0, 1), ("estimate", 0, [0, 1]),
        # Of the truth each component, relative to the vector's length.
        ("true_rvec", 2.9e-12, 3.3e-12), ("true_tvec_m", 0.4e-12, 0.6e-12),
        ("marker_area_px", 8e-10, 10e-10), ("bound_std", 0.9e-9, 1.5e-9), ("bound", 0, 1),
        # What one of the two alone has is a difference.
        ("mirror_distance", 0, np.ones_like), ("reprojection_error_px", 0, np.ones_like),
    ],
)
def test_scenes_of_another_processor_lie_within_their_tolerance(name, within, beyond):
    assert found(name, within) == ""
    assert found(name, beyond).startswith(f"{name} ")


def test_variables_without_a_tolerance_are_compared_on_the_same_processor_alone():
    assert found("nees", 1.0) == ""
    assert found("nees", 1.0, same_processor=True).startswith("nees ")
