"""Poison for tests: chosen scenes end, hang or raise in whatever process computes them.

Python imports this module in every process that has its folder on PYTHONPATH. ``SWEEP_POISON``
holds JSON: ``log``, a file to which notes are appended, and ``poisons``, each with

cell
    number of the scene on the grid of scene axes, the last axis fastest
stage
    scene (rendering), detection or estimation
how
    one of ``WAYS``
setting
    values that a detector's setting must have to be hit (stage detection)
solver
    values that an estimator must have to be hit (stage estimation)

Without that variable nothing is touched.
"""

import ctypes
import importlib.abc
import importlib.machinery
import json
import os
import signal
import sys
import threading
from pathlib import Path


def _hold():
    """Never return, in C, without ever giving up the interpreter's lock."""
    ctypes.PyDLL(None).sleep(1_000_000)


def _raise():
    raise RuntimeError("poisoned")


WAYS = {
    "segv": lambda: ctypes.string_at(0),
    "abort": os.abort,
    "ill": lambda: os.kill(os.getpid(), signal.SIGILL),
    "exit": lambda: os._exit(3),
    "hold": _hold,
    "raise": _raise,
}


class _Source:
    """A source of detections that tells which row it is asked for, before it searches."""

    def __init__(self, real, told):
        self._real, self._told = real, told

    def __getattr__(self, name):
        return getattr(self._real, name)

    def __call__(self, row, image):
        self._told(row)
        return self._real(row, image)


def _cells(batch):
    """Return the numbers (N,) of a batch's scenes; -1 of one that is computed before any block."""
    import numpy as np  # noqa: PLC0415  (this module is imported by every process)

    lengths = [len(axis) for axis in batch.experiment.scene_axes]
    if batch.experiment.grid.title == "A standard scene":
        return np.full(len(batch.scenes), -1)
    return np.ravel_multi_index(list(batch.indices), lengths) if lengths else np.zeros(1, int)


def poison(block, search, poisons, log):
    """Put poison into the functions of the evaluation by which scenes of known number pass."""
    images_of, detection_sources = search.images_of, search.detection_sources
    detections_for, all_or_each = block.detections_for, block.results.all_or_each
    here = threading.local()

    def act(stage, cells, **treatment):
        """Do what the poisons say that ``cells`` hold for this stage and treatment."""
        for each in poisons:
            hit = each["stage"] == stage and each["cell"] in cells and all(
                getattr(treatment.get(kind), name) == value
                for kind in ("setting", "solver")
                for name, value in each.get(kind, {}).items()
            )
            if hit:
                with Path(log).open("a") as notes:
                    notes.write(json.dumps(each) + "\n")
                WAYS[each["how"]]()

    def images(source, batch, *rest):
        def drawn(scenes, rows, *windows):
            act("scene", _cells(batch)[rows])
            return source(scenes, rows, *windows)

        return images_of(drawn, batch, *rest)

    def sources(batch):
        cells = _cells(batch)
        return [
            _Source(real, lambda row, chosen=chosen: act(
                "detection", cells[[row]], setting=chosen))
            for real, chosen in zip(
                detection_sources(batch), batch.experiment.detectors, strict=True)
        ]

    def seen(estimator, batch, result, rows):
        here.cells, here.solver = _cells(batch)[rows], estimator
        return detections_for(estimator, batch, result, rows)

    def estimated(work, numbers, note):
        def worked(some):
            act("estimation", here.cells[some], solver=here.solver)
            return work(some)

        return all_or_each(worked, numbers, note)

    search.images_of, search.detection_sources = images, sources
    block.detections_for, block.results.all_or_each = seen, estimated


class _Finder(importlib.abc.MetaPathFinder):
    """Has the evaluation poisoned as soon as it has been loaded."""

    def find_spec(self, name, path=None, target=None):
        if name != "sweep.evaluation.block":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        load, given = spec.loader.exec_module, json.loads(os.environ["SWEEP_POISON"])

        def load_and_poison(module):
            load(module)
            poison(module, sys.modules["sweep.evaluation.search"], given["poisons"], given["log"])

        spec.loader.exec_module = load_and_poison
        return spec


if "SWEEP_POISON" in os.environ:
    sys.meta_path.insert(0, _Finder())
