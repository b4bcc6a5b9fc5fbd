"""What one detector setting finds in scenes without a pipeline, in windows and elsewhere."""

from types import SimpleNamespace

import cv2
import numpy as np

from sweep.evaluation.search import SceneBatch, detections_of, search_windows
from sweep.measure.classify import target_scenes
from sweep.measure.detectors import REFINEMENTS, BoardDetectorSetting
from sweep.model.camera import Column
from sweep.model.exposure import marker_boxes
from sweep.model.marker import opencv_dictionary
from sweep.model.renderers import render


def outcome(detector, image, scenes, row, shift):
    """Return what a plain OpenCV call makes of the marker of a scene that was moved by shift."""
    corners, ids, rejected = detector.detectMarkers(image)
    truth = (scenes.corners_px[row] + shift).astype(np.float32)

    def there(quadrilateral):
        centre = quadrilateral.reshape(4, 2).mean(axis=0)
        return cv2.pointPolygonTest(truth, (float(centre[0]), float(centre[1])), False) >= 0

    decoded = [] if ids is None else [
        marker_id for corner, marker_id in zip(corners, ids.ravel().tolist(), strict=True)
        if there(corner)
    ]
    return tuple(decoded) or ("rejected" if any(map(there, rejected)) else "nothing")


def outcomes_elsewhere(scenes, row, setting):
    """Return the outcomes with the *same pixels* of a window pasted all over the full frame.

    Offsets are multiples of 4 px and others. A window that touches the frame's edge keeps to it.
    """
    box = marker_boxes(scenes)
    window = search_windows(scenes, box, setting, np.zeros(len(scenes), dtype=bool))[row]
    x0, y0, x1, y1 = window.tolist()
    pixels = render(scenes, row, box[row], (x0, y0, x1, y1))
    width, height = scenes.frame[row].tolist()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = REFINEMENTS[setting.cornerRefinementMethod]
    detector = cv2.aruco.ArucoDetector(opencv_dictionary(scenes.dictionary[row]), parameters)
    lefts = [x0] if x0 == 0 or x1 == width else [0, *range(3, width - (x1 - x0), 29), x0]
    tops = [y0] if y0 == 0 or y1 == height else [0, *range(3, height - (y1 - y0), 29), y0]
    lefts += [left // 4 * 4 for left in lefts] if len(lefts) > 1 else []
    tops += [top // 4 * 4 for top in tops] if len(tops) > 1 else []
    seen = set()
    for top in sorted(set(tops)):
        for left in sorted(set(lefts)):
            image = np.full((height, width), round(scenes.levels[row, 0]), dtype=np.uint8)
            image[top : top + y1 - y0, left : left + x1 - x0] = pixels
            seen.add(outcome(detector, image, scenes, row, (left - x0, top - y0)))
            if len(seen) > 1:
                return seen
    return seen


def searched(scenes, setting, *, full=False):
    """Search windows, or whole frames with ``full``, of scenes of markers. No search may raise."""
    count, failures = len(scenes), []
    flags = np.zeros(count, dtype=np.uint8)
    experiment = SimpleNamespace(detectors=[setting], board_settings=[BoardDetectorSetting()])
    windows = ["full" if full else "target"] * count
    values = {"window": Column.of(windows), "background": Column.of(0.0)}
    targets = target_scenes(scenes, flags)
    batch = SceneBatch(experiment, [], values, scenes, flags, targets, marker_boxes(scenes))
    (result,) = detections_of(batch, np.ones((count, 1), dtype=bool), failures, keep=False)
    assert not failures
    return result
