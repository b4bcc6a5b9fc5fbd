"""CORNER_REFINE_APRILTAG never finds an inverted marker, whatever detectInvertedMarker says.

In OpenCV 4.5.5 and 4.8.1 both together end the process (segmentation fault).
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_APRILTAG_36h11)
MODERN = hasattr(ARUCO, "ArucoDetector")
draw = ARUCO.generateImageMarker if MODERN else ARUCO.drawMarker


def found(image, refinement):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.cornerRefinementMethod = getattr(ARUCO, "CORNER_REFINE_" + refinement)
    parameters.detectInvertedMarker = True
    if MODERN:
        ids = ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)[1]
    else:
        ids = ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters)[1]
    return 0 if ids is None else len(ids)


said = []
for name in ("NONE", "APRILTAG"):
    inverted = sum(
        found(255 - np.pad(draw(DICTIONARY, k, 120), 60, constant_values=255), name)
        for k in range(50))
    said.append(f"{name} {inverted}")
print(f"OpenCV {cv2.__version__}: of 50 inverted markers found with detectInvertedMarker: "
      + ", ".join(said))
