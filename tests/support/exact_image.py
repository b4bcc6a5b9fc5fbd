"""Images by polygon clipping and dense sampling, written without the code under test."""

import dataclasses

import cv2
import numba
import numpy as np

from sweep.model.camera import Camera
from sweep.model.marker import Marker
from sweep.model.pose import Pose
from sweep.model.scene import Scene

DEFAULTS = {"shift_u_px": 0.0, "shift_v_px": 0.0} | {
    field.name: field.default
    for section in (Camera, Marker, Pose, Scene)
    for field in dataclasses.fields(section)
}
DICTIONARIES = (
    "DICT_4X4_50", "DICT_5X5_50", "DICT_6X6_250", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
)
LENSES = (
    (-0.3, 0.1, 0.0, 0.0),
    (0.6, -0.25, 0.001, -0.0008, 0.05, 0.9, -0.1, 0.02),
    (-0.2, 0.08, 0.001, -0.0005, 0.01, 0.0, 0.0, 0.0, 0.002, -0.001, 0.0015, 0.0005, 0.05, -0.03),
)
EXTENDED = np.longdouble
PI = EXTENDED("3.14159265358979323846264338327950288")


def modules_of(value):
    """White modules (n + 2, n + 2), the quiet zone's included, read off OpenCV's own drawing."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, value["dictionary"]))
    n = dictionary.markerSize + 2
    drawn = cv2.aruco.generateImageMarker(dictionary, value["marker_id"], 10 * n)
    return np.pad(drawn[5::10, 5::10] > 127, 1, constant_values=True)


def plane_of(value):
    """Take module coordinates (column, row, 1) to the undistorted camera frame, (3, 3)."""
    tilt, azimuth, roll, bearing_x, bearing_y = (
        EXTENDED(value[name]) * PI / 180
        for name in ("tilt_deg", "azimuth_deg", "roll_deg", "bearing_x_deg", "bearing_y_deg")
    )
    zero, one = EXTENDED(0), EXTENDED(1)
    x, y = np.cos(azimuth), np.sin(azimuth)
    cross = np.array([[zero, zero, y], [zero, zero, -x], [-y, x, zero]])
    tilted = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * (cross @ cross)
    c, s = np.cos(roll), np.sin(roll)
    rolled = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]])
    rotation = tilted @ rolled @ np.diag([1, -1, -1])
    centre = EXTENDED(value["distance_m"]) * np.array(
        [
            np.tan(bearing_x) + EXTENDED(value["shift_u_px"]) / value["fx_px"],
            np.tan(bearing_y) + EXTENDED(value["shift_v_px"]) / value["fx_px"],
            one,
        ]
    )
    size = EXTENDED(value["size_m"])
    module = size / (len(modules_of(value)) - 2)
    to_marker = np.array([[module, zero, -size / 2], [zero, -module, size / 2]])
    plane = rotation[:, :2] @ to_marker
    plane[:, 2] += centre
    return plane


def vertices_of(value):
    """Homogeneous pixels (u·z, v·z, z) of the cells' corners, (n + 3, n + 3, 3)."""
    n, quiet = len(modules_of(value)) - 2, value["quiet_zone_modules"]
    lines = np.array([-quiet, *range(n + 1), n + quiet], dtype=EXTENDED)
    columns, rows = np.meshgrid(lines, lines)
    points = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ plane_of(value).T
    centre = [EXTENDED(value[name] - 1) / 2 for name in ("width_px", "height_px")]
    image = points[..., :2] * EXTENDED(value["fx_px"]) + points[..., 2:] * np.array(centre)
    return np.concatenate([image, points[..., 2:]], axis=-1)


def kept(polygon, plane):
    """Clip a polygon of homogeneous points to plane · point >= 0 (Sutherland and Hodgman)."""
    inside = [point @ plane for point in polygon]
    clipped = []
    for i, (point, here) in enumerate(zip(polygon, inside, strict=True)):
        before = inside[i - 1]
        if (here >= 0) != (before >= 0):
            clipped.append(polygon[i - 1] + before / (before - here) * (point - polygon[i - 1]))
        if here >= 0:
            clipped.append(point)
    return clipped


@numba.njit(cache=True)
def add_clipped(levels, share, polygon, level):
    """Clip a convex polygon (M, 2) to every pixel it may touch; add its area there."""
    low_u, low_v = max(polygon[:, 0].min(), -0.5), max(polygon[:, 1].min(), -0.5)
    high_u, high_v = polygon[:, 0].max(), polygon[:, 1].max()
    here, there = np.empty((12, 2)), np.empty((12, 2))
    for v in range(int(low_v + 0.5), min(int(high_v + 0.5) + 1, levels.shape[0])):
        for u in range(int(low_u + 0.5), min(int(high_u + 0.5) + 1, levels.shape[1])):
            count = len(polygon)
            for i in range(count):
                here[i, 0], here[i, 1] = polygon[i, 0] - u, polygon[i, 1] - v
            for side in range(4):
                axis, sign = side % 2, 1.0 if side < 2 else -1.0
                found = 0
                for i in range(count):
                    j = (i + 1) % count
                    a, b = 0.5 + sign * here[i, axis], 0.5 + sign * here[j, axis]
                    if a >= 0:
                        there[found, 0], there[found, 1] = here[i, 0], here[i, 1]
                        found += 1
                    if (a >= 0) != (b >= 0):
                        t = a / (a - b)
                        there[found, 0] = here[i, 0] + t * (here[j, 0] - here[i, 0])
                        there[found, 1] = here[i, 1] + t * (here[j, 1] - here[i, 1])
                        found += 1
                here, there, count = there, here, found
            area = 0.0
            for i in range(count):
                j = (i + 1) % count
                area += 0.5 * (here[i, 0] * here[j, 1] - here[i, 1] * here[j, 0])
            levels[v, u] += level * abs(area)
            share[v, u] += abs(area)


def add_part(levels, share, polygon, level):
    """Add the image of a convex polygon of homogeneous pixels, clipped to the frame's."""
    height, width = levels.shape
    half = EXTENDED(0.5)
    for side in np.array([[1, 0, half], [0, 1, half], [-1, 0, width - half],
                          [0, -1, height - half]]):
        polygon = kept(polygon, side)
    if len(polygon) > 2:
        pixels = np.array([point[:2] / point[2] for point in polygon]).astype(np.float64)
        add_clipped(levels, share, pixels, level)


def clipped_image(value):
    """Levels and share (height, width) of a frame: every cell clipped to every pixel."""
    width, height = value["width_px"], value["height_px"]
    levels, share = np.zeros((height, width)), np.zeros((height, width))
    vertices, white = vertices_of(value), modules_of(value)
    assert (vertices[..., 2] > 0).all()
    for i, j in np.ndindex(white.shape):
        cell = [vertices[i, j], vertices[i, j + 1], vertices[i + 1, j + 1], vertices[i + 1, j]]
        add_part(levels, share, cell, value["white" if white[i, j] else "black"])
    return levels, share


def values(**given):
    value = DEFAULTS | {"width_px": 640, "height_px": 480, "fx_px": 800.0} | given
    if value["side_px"] is not None:
        value["distance_m"] = value["fx_px"] * value["size_m"] / value["side_px"]
    return value


def through_lens(points, distortion):
    """Distort normalised points (N, 2) with OpenCV."""
    space = np.column_stack([points, np.ones(len(points))])
    none = np.zeros(3)
    return cv2.projectPoints(space, none, none, np.eye(3), np.array(distortion))[0][:, 0]


def visible(value):
    """Tell whether a marker is seen from the front, well before the camera."""
    corners = vertices_of(value)[[0, 0, -1, -1], [0, -1, 0, -1]]
    front = np.dot(np.cross(corners[0], corners[1]), corners[2]) > 0
    return front and corners[:, 2].min() > 0.02 * value["distance_m"]
