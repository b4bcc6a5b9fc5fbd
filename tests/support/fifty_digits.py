"""The model's arithmetic (DESIGN section 3) with 50 digits, and its inputs."""

import dataclasses

import numpy as np
from mpmath import mp, mpf

from sweep.model.camera import Camera
from sweep.model.marker import Marker
from sweep.model.pose import Pose
from sweep.model.scene import Scene

DEFAULTS = {"shift_u_px": 0.0, "shift_v_px": 0.0} | {
    field.name: field.default
    for section in (Camera, Marker, Pose, Scene)
    for field in dataclasses.fields(section)
}
ANGLES = ("tilt_deg", "azimuth_deg", "roll_deg", "bearing_x_deg", "bearing_y_deg")
LENSES = {
    4: (-0.3, 0.1, 0.002, -0.001),
    5: (-0.25, 0.12, -0.001, 0.0015, -0.04),
    8: (0.6, -0.25, 0.001, -0.0008, 0.05, 0.9, -0.1, 0.02),
    12: (-0.2, 0.05, 0.001, 0.002, 0.01, 0.05, -0.02, 0.01, 0.002, -0.001, 0.0015, 0.0005),
    14: (-0.2, 0.08, 0.001, -0.0005, 0.01, 0.1, 0.02, 0.0, 0.002, -0.001, 0.0015, 0.0005, 0.05,
         -0.03),
}


def rotation_about(axis, angle):
    """Rodrigues' formula for a unit axis."""
    x, y, z = axis
    cross = mp.matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return mp.eye(3) + mp.sin(angle) * cross + (1 - mp.cos(angle)) * (cross * cross)


def exact_pose(value):
    """Return the rotation and the translation of a pose."""
    tilt, azimuth, roll, bearing_x, bearing_y = (mp.radians(mpf(value[name])) for name in ANGLES)
    rotation = (
        rotation_about((mp.cos(azimuth), mp.sin(azimuth), 0), tilt)
        * rotation_about((0, 0, 1), roll)
        * mp.diag([1, -1, -1])
    )
    fx, fy, _, _ = exact_camera(value)
    distance = mpf(value["distance_m"])
    centre = distance * mp.matrix([
        mp.tan(bearing_x) + mpf(value["shift_u_px"]) / fx,
        mp.tan(bearing_y) + mpf(value["shift_v_px"]) / fy,
        1,
    ])
    return rotation, centre


def exact_camera(value):
    """Return fx, fy, cx, cy."""
    width, height = value["width_px"], value["height_px"]
    if value["fx_px"] is None:
        focal = mpf(value["focal_length_mm"])
        # Of the sensor's sides neither is given: it is 4.8 mm wide, and its pixels are square.
        fx = fy = focal / mpf(4.8) * width
    else:
        fx = mpf(value["fx_px"])
        fy = fx if value["fy_px"] is None else mpf(value["fy_px"])
    cx = mpf(width - 1) / 2 if value["cx_px"] is None else mpf(value["cx_px"])
    cy = mpf(height - 1) / 2 if value["cy_px"] is None else mpf(value["cy_px"])
    return fx, fy, cx, cy


def exact_corners(value):
    """Return the black square's corners in space: TL, TR, BR, BL."""
    rotation, centre = exact_pose(value)
    half = mpf(value["size_m"]) / 2
    return [
        rotation * mp.matrix([x * half, y * half, 0]) + centre
        for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))
    ]


def exact_pixels(value):
    fx, fy, cx, cy = exact_camera(value)
    return [(fx * x / z + cx, fy * y / z + cy) for x, y, z in exact_corners(value)]


def exact_distortion(x, y, coefficients):
    """OpenCV's documented model, written from its formulae."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = (
        mpf(number) for number in (*coefficients, *[0.0] * (14 - len(coefficients)))
    )
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    about_x = mp.matrix([[1, 0, 0], [0, mp.cos(tx), mp.sin(tx)], [0, -mp.sin(tx), mp.cos(tx)]])
    about_y = mp.matrix([[mp.cos(ty), 0, -mp.sin(ty)], [0, 1, 0], [mp.sin(ty), 0, mp.cos(ty)]])
    r = about_y * about_x
    onto = mp.matrix([[r[2, 2], 0, -r[0, 2]], [0, r[2, 2], -r[1, 2]], [0, 0, 1]])
    u, v, w = onto * r * mp.matrix([u, v, 1])
    return u / w, v / w


def doubles(matrix):
    return np.array(matrix.tolist(), dtype=object).astype(np.float64)


def values(**given):
    return DEFAULTS | given


INVERTED = {
    **LENSES,
    "folding barrel": (-0.5, 0.0, 0.0, 0.0),
    "pincushion": (0.5, 0.2, 0.0, 0.0),
    "moustache": (0.5, -0.4, 0.0, 0.0),
    "sharp moustache": (1.0, -1.0, 0.0, 0.0),
    "barrel then pincushion": (-0.4, 0.3, 0.0, 0.0, 0.2),
    "rational": (8.0, 3.0, 0.0, 0.0, 0.1, 8.3, 5.0, 0.5),
}

AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, -1), (1, 2, 3), (-3, 1, 1e-3),
        (1, -1, 1), (-1e-6, 1, 1e-9)]
