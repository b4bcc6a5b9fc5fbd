"""IPPE is wrong or not finite, with success, where the rotation vector has the length pi.

In the frame of cv2.aruco (z out of the marker) that is every upright marker that is tilted about
one axis of the image, or not at all. The corners are exact. IPPE divides by the angle's sine.
"""

import cv2
import numpy as np

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
SQUARE = 0.05 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])


def half_turn(tilt, azimuth):
    """Return a tilt about the image's x axis (azimuth 0) or y axis, times Rx(180 deg)."""
    c, s = np.cos(tilt), np.sin(tilt)
    about_x, about_y = [[1, 0, 0], [0, c, -s], [0, s, c]], [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    return np.array([about_x, about_y][azimuth]) @ np.diag([1.0, -1, -1])


def degrees_between(a, b):
    """Return the angle between two rotations; NaN if one is not finite."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(a - b) / np.sqrt(8)))


counts = []
for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_IPPE_SQUARE):
    wrong = told = total = 0
    for tilt in np.radians(np.arange(0, 81, 5)):
        for azimuth in range(2):
            for shift in np.linspace(-0.3, 0.3, 13):
                truth = half_turn(tilt, azimuth)
                image = (SQUARE @ truth.T + [shift, 0.1, 0.8]) @ K.T
                ok, rvec, _ = cv2.solvePnP(SQUARE, image[:, :2] / image[:, 2:], K, None,
                                           flags=method)
                right = ok and degrees_between(cv2.Rodrigues(rvec)[0], truth) < 0.01
                total, wrong, told = total + 1, wrong + (not right), told + (ok and not right)
    counts.append(f"{wrong} of {total} wrong, {told} of them with success")
print(f"OpenCV {cv2.__version__}: IPPE {counts[0]}; IPPE_SQUARE {counts[1]}")
