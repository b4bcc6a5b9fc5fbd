"""A solver: the homography's columns, made orthonormal (Zhang 2000, section 3.1)."""
import cv2
import numpy as np
from sweep.plugins import EstimatorPlugin

SQUARE = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])

def solve(detections):
    count = len(detections.corners)
    rotation, translation = np.full((count, 3, 3), np.nan), np.full((count, 3), np.nan)
    for i, seen in enumerate(detections.cameras.normalise(detections.corners)):
        columns, _ = cv2.findHomography(SQUARE * detections.size_m[i], seen)
        if columns is None:
            continue
        columns *= np.sign(columns[2, 2]) / np.sqrt(np.prod(np.linalg.norm(columns[:, :2], axis=0)))
        turned = np.column_stack([columns[:, :2], np.cross(columns[:, 0], columns[:, 1])])
        left, _, right = np.linalg.svd(turned)
        rotation[i], translation[i] = left @ right, columns[:, 2]
    return rotation, translation

SOLVER = EstimatorPlugin(make=lambda _: solve, meaning="the homography's columns, made orthonormal")
