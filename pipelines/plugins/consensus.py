"""A solver of flat boards: the homography of all corners but outliers, made orthonormal."""
import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

def solve(detections):
    count = len(detections)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for i in range(count):
        found = detections.take(np.array([i]))
        on_board = found.objects_m[..., :2].reshape(-1, 2)
        seen = found.cameras.normalise(found.corners.reshape(1, -1, 2))[0]
        columns, _ = cv2.findHomography(on_board, seen, cv2.LMEDS)
        if columns is None:
            continue
        columns *= np.sign(columns[2, 2]) / np.sqrt(np.prod(np.linalg.norm(columns[:, :2], axis=0)))
        turned = np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])])
        left, _, right = np.linalg.svd(turned)
        rotation[i], translation[i] = left @ right, columns[:, 2]
    return rotation, translation

SOLVER = EstimatorPlugin(make=lambda _: solve, of_boards=True, meaning="the median homography")
