"""Cells that crash or raise in a run in waves: they are data, and the rule goes on beside them."""

import json

import numpy as np
import pytest

from support.commands import command
from support.poison import Poison, poisoned
from support.stores import same
from sweep.measure.flags import DetectionStatus
from sweep.store.lifecycle import open_dataset

TEXT = """
seed = 3
camera = { width_px = 64, height_px = 48 }
pose = { jitter_px = 0.5 }
scene = { renderer = "warp" }
axes = { side_px = [8, 13, 30] }
search = { precision = { detection_rate = 0.1 }, max_trials = 150 }
"""

CRASHED, RAISED = (1, 60), (2, 10)
"""Side and trial; the first in the second wave."""


@pytest.mark.long
def test_cells_that_crash_are_flagged_whatever_computes_them(tmp_path):
    file = tmp_path / "crashing.toml"
    file.write_text(TEXT)
    poisons = [Poison(150 * side + trial, stage, how) for (side, trial), stage, how in (
        (CRASHED, "detection", "segv"), (RAISED, "scene", "raise"))]
    urls = []
    for workers in ([], ["--workers", "2"]):
        urls.append(str(tmp_path / f"{len(workers)}.zarr"))
        ran = command("run", str(file), "--store", urls[-1], "--json", *workers,
                      env=poisoned(poisons, tmp_path / "log"))
        assert ran.returncode == 0, ran.stderr
        summary = json.loads(ran.stdout)
        assert (summary["crashed"], summary["failed"]) == (1, 1)
        assert summary["unsettled"] == 0
    assert same(*urls)
    flags = open_dataset(urls[0]).detection.to_numpy()
    assert flags[CRASHED] == DetectionStatus.crashed
    assert flags[RAISED] == DetectionStatus.failed
    assert np.isin(flags, (DetectionStatus.crashed, DetectionStatus.failed)).sum() == 2
