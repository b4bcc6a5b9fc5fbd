"""CORNER_REFINE_APRILTAG raises on images wider than 32767 px; other refinements search them."""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_APRILTAG_36h11)
MODERN = hasattr(ARUCO, "ArucoDetector")
image = np.full((64, 40_000), 255, np.uint8)
image[:, 20_000:20_020] = 0

said = []
for name in ("NONE", "APRILTAG"):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.cornerRefinementMethod = getattr(ARUCO, "CORNER_REFINE_" + name)
    try:
        if MODERN:
            ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)
        else:
            ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters)
        said.append(f"{name} searches")
    except cv2.error as error:
        said.append(f"{name} raises: " + str(error).split("error: ")[-1].strip())
print(f"OpenCV {cv2.__version__}: an image of 40000 x 64 px: {'; '.join(said)}")
