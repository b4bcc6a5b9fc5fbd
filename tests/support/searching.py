"""What one detector setting finds in scenes that were built without a pipeline."""

from types import SimpleNamespace

import numpy as np

from sweep.evaluation.search import SceneBatch, detections_of, visibility_flags
from sweep.measure.classify import target_scenes
from sweep.measure.detectors import BoardDetectorSetting
from sweep.model.camera import Column
from sweep.model.exposure import marker_boxes


def searched(scenes, setting, *, full=False, wanted=None, boards=None, keep=False):
    """Search windows, or whole frames with ``full``, of the scenes ``wanted`` (N,): by default all.

    ``boards`` are the scenes' targets and the most markers and corners, if they are no markers. No
    search may raise.
    """
    count, failures = len(scenes), []
    flags = np.zeros(count, dtype=np.uint8) if boards is None else visibility_flags(scenes)
    targets = target_scenes(scenes, flags, *(boards or ()))
    experiment = SimpleNamespace(detectors=[setting], board_settings=[BoardDetectorSetting()])
    windows = ["full" if each else "target" for each in np.broadcast_to(full, count).tolist()]
    values = {"window": Column.of(windows), "background": Column.of(0.0)}
    batch = SceneBatch(experiment, [], values, scenes, flags, targets, marker_boxes(scenes))
    wanted = np.broadcast_to(True if wanted is None else wanted, count)
    (result,), _ = detections_of(batch, wanted[:, None], failures, keep=keep)
    assert not failures
    return result
