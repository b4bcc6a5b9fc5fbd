"""cv2.undistortPoints stops after five steps, converged or not; solvePnP uses it so.

Points are distorted by the model itself (k1 = -0.3, k2 = 0.1) and undistorted again. The model is
invertible there: NumPy's Newton iteration returns every point to rounding.
"""

import cv2
import numpy as np

K = np.array([[600.0, 0, 639.5], [0, 600, 479.5], [0, 0, 1]])
K1, K2 = -0.3, 0.1

said = []
for degrees in (20, 30, 40):
    r = np.tan(np.radians(degrees))
    angles = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    truth = r * np.stack([np.cos(angles), np.sin(angles)], 1)
    bent = r * (1 + K1 * r**2 + K2 * r**4)
    pixels = truth / r * bent * 600 + [639.5, 479.5]
    got = cv2.undistortPoints(pixels[:, None], K, np.array([K1, K2, 0, 0]))[:, 0]
    newton = bent
    for _ in range(50):
        slope = 1 + 3 * K1 * newton**2 + 5 * K2 * newton**4
        newton -= (newton * (1 + K1 * newton**2 + K2 * newton**4) - bent) / slope
    assert abs(newton - r) < 1e-12
    error = 600 * np.linalg.norm(got - truth, axis=1).max()
    said.append(f"{error:.2g} px at {degrees} deg")
print(f"OpenCV {cv2.__version__}: error of undistortPoints at f = 600 px: {', '.join(said)}")
