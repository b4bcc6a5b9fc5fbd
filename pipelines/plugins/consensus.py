"""A solver of flat boards: the homography of all corners but outliers, made orthonormal."""
import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

def solve(detections):
    count = len(detections.boards)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for i in range(count):
        board, found = detections.boards[i], detections.points[i]
        on_board = board.corners_m[found.marker, :, :2].reshape(-1, 2) * detections.scale[i]
        camera = detections.cameras.take(np.array([i]))
        seen = camera.normalise(found.corners_px.reshape(1, -1, 2))[0]
        columns, _ = cv2.findHomography(on_board, seen, cv2.LMEDS)
        if columns is None:
            continue
        columns *= np.sign(columns[2, 2]) / np.sqrt(np.prod(np.linalg.norm(columns[:, :2], axis=0)))
        turned = np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])])
        left, _, right = np.linalg.svd(turned)
        rotation[i], translation[i] = left @ right, columns[:, 2]
    return rotation, translation

SOLVER = EstimatorPlugin(make=lambda _: solve, of_boards=True, meaning="the median homography")
