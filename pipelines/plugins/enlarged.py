"""A detector: OpenCV's, on an enlarged image."""
from dataclasses import dataclass
import cv2
import numpy as np
from sweep.plugins import DetectorPlugin, parameter

@dataclass(frozen=True)
class Settings:
    enlargement: int = parameter(2, "factor on the image's sides", low=1, high=8)

class Enlarged:
    def __init__(self, settings, family):
        self.factor = settings.enlargement
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, family))
        self.detect = cv2.aruco.ArucoDetector(dictionary).detectMarkers

    def __call__(self, image):
        size = (self.factor * image.shape[1], self.factor * image.shape[0])
        corners, ids, _ = self.detect(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC))
        if ids is None:
            return [], []
        return (np.concatenate(corners) + 0.5) / self.factor, ids.ravel()

DETECTOR = DetectorPlugin(make=Enlarged, settings=Settings, pixel_center=0.5, margin_px=24)
