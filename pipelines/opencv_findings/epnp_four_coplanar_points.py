"""EPNP on the four exact corners of a square: often far from the truth, with success."""

import cv2
import numpy as np

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
SQUARE = 0.5 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
FLIP = np.diag([1.0, -1, -1])

said = []
rng = np.random.default_rng(1)
for low, high in ((0, 15), (15, 45), (45, 75)):
    wrong = 0
    for _ in range(1000):
        axis, roll = rng.uniform(0, 2 * np.pi, 2)
        tilt = np.radians(rng.uniform(low, high)) * np.array([np.cos(axis), np.sin(axis), 0])
        truth = cv2.Rodrigues(tilt)[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0] @ FLIP
        image = (SQUARE @ truth.T + [0.5, 0.2, 8]) @ K.T
        ok, rvec, _ = cv2.solvePnP(SQUARE, image[:, :2] / image[:, 2:], K, None,
                                   flags=cv2.SOLVEPNP_EPNP)
        chord = np.linalg.norm(cv2.Rodrigues(rvec)[0] - truth) / np.sqrt(8)
        wrong += bool(ok and not 2 * np.degrees(np.arcsin(min(1, chord))) < 1)
    said.append(f"{wrong} at tilts of {low}-{high} deg")
print(f"OpenCV {cv2.__version__}: EPNP off by more than 1 deg with success, of 1000 exact squares: "
      + ", ".join(said))
