"""With 4 samples a cell (the default) small, perfect markers are lost at certain sizes.

Frontal markers without noise, at random positions between the pixels, all 50 IDs. Bits are read
from whole-pixel corners at perspectiveRemovePixelPerCell samples a cell, of which the margin
leaves 4 of 16: a sample next to a cell's edge reads its neighbour, and half of the bit is wrong.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_5X5_50)
MODERN = hasattr(ARUCO, "ArucoDetector")
draw = ARUCO.generateImageMarker if MODERN else ARUCO.drawMarker


def found(image, samples):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.perspectiveRemovePixelPerCell = samples
    if MODERN:
        return ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)[1]
    return ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters)[1]


said = []
for side in (16.5, 18.0, 20.0, 22.0):
    rng, rates = np.random.default_rng(1), np.zeros(2)
    for k in range(1000):
        bitmap = np.pad(draw(DICTIONARY, k % 50, 70), 10, constant_values=255)
        x, y = 30 + rng.uniform(-0.5, 0.5, 2)
        s = side / 70  # of bitmap to image; the bitmap's black square begins at 9.5
        onto = np.array([[s, 0, x - 9.5 * s], [0, s, y - 9.5 * s]])
        image = cv2.warpAffine(bitmap, onto, (96, 80), flags=cv2.INTER_LINEAR)
        rates += [np.any(found(image, n) == k % 50) for n in (4, 8)]
    said.append(f"{side:g} px {rates[0] / 1000:.3f} ({rates[1] / 1000:.3f})")
print(f"OpenCV {cv2.__version__}: share of frontal markers found, 4 samples a cell (8): "
      + ", ".join(said))
