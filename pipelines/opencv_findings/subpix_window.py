"""cornerRefinementWinSize is without effect where relativeCornerRefinmentWinSize is smaller.

The half window of the sub-pixel refinement is the smaller of it and 0.3 module: for small markers
1 or 2 px, whatever is asked. Versions without the second field take what is asked. Corners of a
marker of 5 px modules at random positions, against the truth.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_5X5_50)
MODERN = hasattr(ARUCO, "ArucoDetector")
draw = ARUCO.generateImageMarker if MODERN else ARUCO.drawMarker


def corners(image, window):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.cornerRefinementMethod = ARUCO.CORNER_REFINE_SUBPIX
    parameters.cornerRefinementWinSize = window
    if MODERN:
        return ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers(image)[0]
    return ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters)[0]


squares, rng = {1: [], 3: [], 5: [], 10: []}, np.random.default_rng(1)
for k in range(300):
    bitmap = np.pad(draw(DICTIONARY, k % 50, 70), 20, constant_values=255)
    x, y = 40 + rng.uniform(-0.5, 0.5, 2)
    onto = np.array([[0.5, 0, x - 19.5 / 2], [0, 0.5, y - 19.5 / 2]])
    image = cv2.warpAffine(bitmap, onto, (120, 120), borderValue=255)
    truth = np.array([[x, y], [x + 35, y], [x + 35, y + 35], [x, y + 35]])
    for window, errors in squares.items():
        errors += [((c[0] - truth) ** 2).sum(1).mean() for c in corners(image, window)[:1]]
said = [f"{np.sqrt(np.mean(errors)):.2f} px at {window}" for window, errors in squares.items()]
print(f"OpenCV {cv2.__version__}: RMS corner error by cornerRefinementWinSize: {', '.join(said)}")
