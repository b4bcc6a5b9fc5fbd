"""cv2.Rodrigues, matrix to vector: 0 for small angles, and half a turn near pi loses its axis.

The matrices are correct to rounding (NumPy, Rodrigues' formula).
"""

import cv2
import numpy as np


def matrix(rvec):
    """Return the rotation matrix of a vector: I + sin t/t [r] + (1 - cos t)/t^2 [r]^2."""
    t = np.linalg.norm(rvec)
    x, y, z = rvec
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(t) / t * cross + 2 * (np.sin(t / 2) / t) ** 2 * cross @ cross


rng = np.random.default_rng(1)
said = []
for text, angle in (("1e-4", 1e-4), ("2e-5", 2e-5), ("9e-6", 9e-6), ("1e-6", 1e-6),
                    ("pi - 1e-4", np.pi - 1e-4), ("pi - 5e-6", np.pi - 5e-6)):
    worst = 0.0
    for _ in range(500):
        axis = rng.normal(size=3)
        rvec = angle * axis / np.linalg.norm(axis)
        got = cv2.Rodrigues(matrix(rvec))[0].ravel()
        # Modulo a whole turn: the vector of the same rotation, or its complement.
        other = rvec * (1 - 2 * np.pi / angle)
        worst = max(worst, min(np.linalg.norm(got - rvec), np.linalg.norm(got - other)))
    said.append(f"{worst:.0e} at {text}")
print(f"OpenCV {cv2.__version__}: largest error of the vector, rad, at an angle of: "
      + ", ".join(said))
