"""Where rays meet a bent sheet, in closed form."""

import numpy as np


def flat_points(directions, rotation, centre, bend, curvature, turn_rad):
    """The points (n, 2) of the flat sheet, right and up in metres, that rays (n, 3) from the camera
    meet first (a bulge towards the viewer) or last (a hollow); NaN where they miss."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    along = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    origin = along @ (rotation.T @ -np.asarray(centre))
    d, k = directions @ rotation @ along.T, curvature
    if bend == "cylinder":
        # x² + (z + 1/k)² = 1/k²
        a = d[:, 0] ** 2 + d[:, 2] ** 2
        b = 2 * (origin[0] * d[:, 0] + (origin[2] + 1 / k) * d[:, 2])
        c = origin[0] ** 2 + origin[2] ** 2 + 2 * origin[2] / k
    else:
        # z + k (x² - y²) / 2 = 0
        a = k / 2 * (d[:, 0] ** 2 - d[:, 1] ** 2)
        b = d[:, 2] + k * (origin[0] * d[:, 0] - origin[1] * d[:, 1])
        c = origin[2] + k / 2 * (origin[0] ** 2 - origin[1] ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
        if bend == "cylinder":
            t = (-b - np.sign(k) * root) / (2 * a)
        else:
            # The root that stays finite as k goes to 0.
            t = -2 * c / (b + np.sign(b) * root)
    x, y, z = (origin + t[:, None] * d).T
    if bend == "cylinder":
        x = np.arctan2(k * x, k * z + 1) / k
    return np.column_stack([x, y]) @ along[:2, :2]
