"""AprilTag's library and OpenCV about the same square: pixel centres at 0.5 and at 0.

An upright tag whose black square covers the pixels 100 to 199 wholly (apriltag#121, PR 346): its
edges are at 100 and 200 with the first pixel's corner at (0, 0), at 99.5 and 199.5 with its centre.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_APRILTAG_36h11)
image = np.full((300, 300), 255, np.uint8)
image[100:200, 100:200] = cv2.resize(
    ARUCO.generateImageMarker(DICTIONARY, 5, 8), (100, 100), interpolation=cv2.INTER_NEAREST)
image = cv2.GaussianBlur(image, (0, 0), 0.8)
for name in ("NONE", "CONTOUR", "SUBPIX", "APRILTAG"):
    parameters = ARUCO.DetectorParameters()
    parameters.cornerRefinementMethod = getattr(ARUCO, "CORNER_REFINE_" + name)
    found = ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)[0][0]
    x, y = found.reshape(4, 2).mean(axis=0)
    print(f"OpenCV {name}: centre of the square ({x:.3f}, {y:.3f}), true 149.5")
try:
    import pyapriltags
except ModuleNotFoundError:
    print("pyapriltags: not installed (pip install pyapriltags)")
else:
    tag, = pyapriltags.Detector(families="tag36h11").detect(image)
    x, y = tag.corners.mean(axis=0)
    print(f"pyapriltags: centre of the square ({x:.3f}, {y:.3f}), true 150 with centres at 0.5")
