"""aprilTagDeglitch = 1: the result depends on the images that were searched before.

The same noisy images are searched in five orders, each by a new detector. Without deglitching all
agree in every corner. The threshold's image is written except at its border, and deglitching
reads the border, that is whatever the memory held before.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
DICTIONARY = ARUCO.getPredefinedDictionary(ARUCO.DICT_APRILTAG_36h11)
MODERN = hasattr(ARUCO, "ArucoDetector")
cv2.setNumThreads(1)
draw = ARUCO.generateImageMarker if MODERN else ARUCO.drawMarker
rng = np.random.default_rng(1)
images = []
for k in range(150):
    w, h, side = *rng.integers(60, 200, 2).tolist(), int(rng.integers(24, 48))
    image = rng.normal(128, 25, (h, w))
    image[4:side + 12, 4:side + 12] = 255
    image[8:side + 8, 8:side + 8] = draw(DICTIONARY, k, side)
    images.append(np.clip(image + rng.normal(0, 8, (h, w)), 0, 255).astype(np.uint8))


def searched(order, deglitch):
    parameters = ARUCO.DetectorParameters() if MODERN else ARUCO.DetectorParameters_create()
    parameters.cornerRefinementMethod = ARUCO.CORNER_REFINE_APRILTAG
    parameters.aprilTagDeglitch = deglitch
    detect = (ARUCO.ArucoDetector(DICTIONARY, parameters).detectMarkers if MODERN else
              lambda image: ARUCO.detectMarkers(image, DICTIONARY, parameters=parameters))
    out = {k: detect(images[k]) for k in order}
    return [[np.array(c).tolist() for c in (*out[k][0], *out[k][2])] for k in range(150)]


orders = [range(150), *(rng.permutation(150).tolist() for _ in range(4))]
results = {n: [searched(order, n) for order in orders] for n in (0, 1)}
said = {n: sum(any(one[k] != r[0][k] for one in r) for k in range(150)) for n, r in results.items()}
print(f"OpenCV {cv2.__version__}: of 150 images, found otherwise in another order: {said[1]} with "
      f"aprilTagDeglitch, {said[0]} without")
