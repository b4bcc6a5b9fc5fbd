"""What one detector setting finds in scenes that were built without a pipeline."""

import numpy as np

from sweep.evaluation.search import (
    ImageSearch,
    SceneBatch,
    search,
    search_windows,
    visibility_flags,
)
from sweep.measure.classify import target_scenes
from sweep.measure.detectors import BoardDetectorSetting, make_board_detector, make_detector
from sweep.model.exposure import marker_boxes


def searched(scenes, setting, *, full=False, wanted=None, boards=None, keep=False):
    """Search windows, or whole frames with ``full``, of the scenes ``wanted`` (N,): by default all.

    ``boards`` are the scenes' targets and the most markers and corners, if they are no markers. No
    search may raise.
    """
    count, failures = len(scenes), []
    flags = np.zeros(count, dtype=np.uint8) if boards is None else visibility_flags(scenes)
    targets = target_scenes(scenes, flags, *(boards or ()))
    batch = SceneBatch([], {}, scenes, flags, targets, marker_boxes(scenes))
    source = ImageSearch(
        make_detector(setting), make_board_detector(setting, BoardDetectorSetting()), scenes,
        targets,
    )
    cut = search_windows(scenes, batch.boxes, setting, np.broadcast_to(full, count))
    wanted = np.broadcast_to(True if wanted is None else wanted, count)
    (result,), _ = search(batch, wanted[:, None], [source], [cut], failures, keep=keep)
    assert not failures
    return result
