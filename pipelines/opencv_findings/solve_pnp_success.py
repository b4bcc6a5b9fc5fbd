"""solvePnP says success of poses that are not finite or that lie behind the camera.

Four random corners of a 640 x 480 image, which no marker in front of the camera projects to. The
pose's reprojection error tells nothing of a point behind the camera: it projects all the same.
"""

import cv2
import numpy as np

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
SQUARE = 0.05 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])

said = []
for name in ("ITERATIVE", "IPPE", "IPPE_SQUARE", "SQPNP", "P3P", "AP3P", "EPNP"):
    rng, success, behind, not_finite = np.random.default_rng(1), 0, 0, 0
    for _ in range(1000):
        corners = rng.uniform([0, 0], [640, 480], (4, 2))
        try:
            ok, rvec, tvec = cv2.solvePnP(SQUARE, corners, K, None,
                                          flags=getattr(cv2, f"SOLVEPNP_{name}"))
        except cv2.error:
            continue
        if ok:
            success += 1
            depths = (SQUARE @ cv2.Rodrigues(rvec)[0].T + tvec.T)[:, 2]
            not_finite += not np.isfinite(depths).all()
            behind += bool((depths <= 0).any())
    said.append(f"{name} {not_finite} + {behind} of {success}")
print(f"OpenCV {cv2.__version__}: not finite + behind the camera, of those with success: "
      + ", ".join(said))
