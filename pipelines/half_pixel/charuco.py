"""A ChArUco's chessboard corners: half a pixel too large in OpenCV 4.6 to 4.13 (opencv#25539).

A board of whole pixels, drawn by repetition, so that its corners are known without a renderer:
with pixel centres at whole numbers, the corner between pixels 99 and 100 is at 99.5. Pull request
28380 took away the half pixel that the detector added after `cornerSubPix`.
"""

import cv2
import numpy as np

ARUCO = cv2.aruco
SQUARE, MARGIN = 60, 40
board = ARUCO.CharucoBoard((5, 4), 1.0, 0.7, ARUCO.getPredefinedDictionary(ARUCO.DICT_4X4_50))
image = np.full((4 * SQUARE + 2 * MARGIN, 5 * SQUARE + 2 * MARGIN), 255, np.uint8)
image[MARGIN:-MARGIN, MARGIN:-MARGIN] = board.generateImage((5 * SQUARE, 4 * SQUARE))
image = cv2.GaussianBlur(image, (0, 0), 0.8)
corners, ids, _, _ = ARUCO.CharucoDetector(board).detectBoard(image)
column, row = ids.ravel() % 4, ids.ravel() // 4
true = MARGIN - 0.5 + SQUARE * np.stack([column + 1, row + 1], axis=1)
x, y = (corners.reshape(-1, 2) - true).mean(axis=0)
print(f"OpenCV {cv2.__version__}: {len(true)} corners, mean offset ({x:+.3f}, {y:+.3f}) px")
