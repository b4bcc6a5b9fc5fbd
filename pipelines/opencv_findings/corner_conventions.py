"""Each refinement has its own idea of where a pixel's centre is: up to half a pixel apart.

A marker parallel to the axes whose black square covers the pixels 100 to 201 wholly. With pixel
centres at whole numbers, as in the rest of OpenCV, its edges are at 99.5 and 201.5.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_ARUCO_ORIGINAL)
MODERN = hasattr(ARUCO, "ArucoDetector")
draw = ARUCO.generateImageMarker if MODERN else ARUCO.drawMarker
image = np.full((300, 300), 255, np.uint8)
# 7 modules of 14 and 15 pixels
image[100:202, 100:202] = cv2.resize(draw(DICTIONARY, 23, 7), (102, 102),
                                     interpolation=cv2.INTER_NEAREST)
said = []
for name in ("NONE", "CONTOUR", "SUBPIX", "APRILTAG"):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.cornerRefinementMethod = getattr(ARUCO, "CORNER_REFINE_" + name)
    if MODERN:
        corners = ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)[0]
    else:
        corners = ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters)[0]
    low, high = corners[0].min(), corners[0].max()
    said.append(f"{name} {low:.2f} to {high:.2f}")
print(f"OpenCV {cv2.__version__}: a square from 99.50 to 201.50 is found at: {', '.join(said)}")
