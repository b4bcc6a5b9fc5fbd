"""warpAffine rounds coordinates to 1/32 px (4.x), and INTER_AREA silently means INTER_LINEAR.

A ramp of slope 64 a pixel is shifted by fractions of a pixel; the right answer is exact.
"""

import cv2
import numpy as np

ramp = 64.0 * np.tile(np.arange(40.0), (40, 1)).astype(np.float32)
worst, same = 0.0, True
for shift in np.linspace(0, 1, 101):
    onto = np.array([[1.0, 0, shift], [0, 1, 0]])
    linear = cv2.warpAffine(ramp, onto, (40, 40), flags=cv2.INTER_LINEAR)
    worst = max(worst, abs(linear - (ramp - 64 * shift))[5:-5, 5:-5].max() / 64)
board = (np.indices((64, 64)).sum(0) % 2 * 255).astype(np.uint8)
quarter = np.array([[0.25, 0, 0], [0, 0.25, 0]])
area = cv2.warpAffine(board, quarter, (16, 16), flags=cv2.INTER_AREA)
linear = cv2.warpAffine(board, quarter, (16, 16), flags=cv2.INTER_LINEAR)
mean = cv2.resize(board, (16, 16), interpolation=cv2.INTER_AREA)
print(f"OpenCV {cv2.__version__}: shifts are wrong by up to {worst:.4f} px; a chessboard at a "
      f"quarter: INTER_AREA equals INTER_LINEAR: {bool((area == linear).all())}, differs from the "
      f"mean by {abs(area.astype(int) - mean).max()} grey levels")
