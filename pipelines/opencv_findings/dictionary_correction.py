"""Errors that the AprilTag dictionaries correct: none before OpenCV 4.14; too many in MIP_36h12.

With d bits between the nearest markers, (d - 1) // 2 wrong bits can be corrected for certain.
"""

import cv2
import numpy as np

said = []
for name in ("APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
             "ARUCO_MIP_36h12"):
    number = getattr(cv2.aruco, "DICT_" + name, None)
    if number is not None:
        bits = cv2.aruco.getPredefinedDictionary(number).maxCorrectionBits
        least = int(name.rpartition("h")[2])
        said.append(f"{name} {bits} of {(least - 1) // 2}")
assert np.size(said)
print(f"OpenCV {cv2.__version__}: bits that are corrected, of those that could be: "
      + ", ".join(said))
