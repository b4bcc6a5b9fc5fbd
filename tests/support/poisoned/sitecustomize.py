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

import collections
import ctypes
import dataclasses
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


def _kind():
    """Return what this process is: worker, child, client or other."""
    words = " ".join(sys.orig_argv)
    if "sweep.isolation.child_process" in words:
        return "child"
    if "--multiprocessing-fork" in words:
        return "worker"
    if "-m sweep " in words:
        return "client"
    return "other"


class _Poison:
    """Wraps the functions of the evaluation by which the scenes of a call are known."""

    def __init__(self, cells, search, poisons, log):
        self._poisons = poisons
        self._log = log
        self._here = threading.local()
        # Scenes made last with their numbers; rendered images by number.
        self._made = collections.deque(maxlen=4)
        self._images = {}
        homes = {
            "build_scenes": search, "detections_for": cells, "build": cells,
            "render_all": search,
        }
        self._real = {name: getattr(home, name) for name, home in homes.items()}
        for name, home in homes.items():
            setattr(home, name, getattr(self, name))
        from sweep.experiment.experiment import Experiment  # noqa: PLC0415

        self._real["scene_values"] = Experiment.scene_values

        def values(experiment, indices):
            return self.scene_values(experiment, indices)

        Experiment.scene_values = values
        from sweep.measure import detectors  # noqa: PLC0415

        detectors.Detector = self._detector(detectors.Detector)

    def _act(self, stage, cells, **treatment):
        """Do what the poisons say that ``cells`` hold for this stage and treatment."""
        for poison in self._poisons:
            hit = poison["stage"] == stage and poison["cell"] in cells and all(
                getattr(treatment.get(kind), name) == value
                for kind in ("setting", "solver")
                for name, value in poison.get(kind, {}).items()
            )
            if hit:
                with Path(self._log).open("a") as log:
                    log.write(json.dumps({"kind": _kind(), **poison}) + "\n")
                WAYS[poison["how"]]()

    def _cells(self, scenes):
        return next((cells for made, cells in self._made if made is scenes), None)

    def scene_values(self, experiment, indices):
        import numpy as np  # noqa: PLC0415  (this module is imported by every process)

        lengths = [len(axis) for axis in experiment.scene_axes]
        cells = np.ravel_multi_index(list(indices), lengths).tolist() if lengths else [0]
        if experiment.grid.title == "A standard scene":  # computed before any block, not poisoned
            cells = [-1] * len(cells)
        self._here.cells = cells
        return self._real["scene_values"](experiment, indices)

    def build_scenes(self, *arguments):
        scenes = self._real["build_scenes"](*arguments)
        self._made.append((scenes, self._here.cells))
        return scenes

    def render_all(self, scenes, rows, boxes, windows):
        known = self._cells(scenes)
        cells = [known[row] for row in rows.tolist()] if known else []
        self._act("scene", cells)
        images = self._real["render_all"](scenes, rows, boxes, windows)
        marked = {poison["cell"] for poison in self._poisons if poison["stage"] == "detection"}
        self._images.update(
            (cell, image) for cell, image in zip(cells, images, strict=False) if cell in marked
        )
        return images

    def _detector(self, real):
        poison = self

        class Detector(real):
            """A detector that knows the images of poisoned scenes, also when they are cropped."""

            def __init__(self, setting):
                super().__init__(setting)
                self._chosen = setting

            def find(self, image, dictionary, frame_side):
                import numpy as np  # noqa: PLC0415

                cells = [
                    cell for cell, marked in poison._images.items()
                    if np.shares_memory(marked, image)
                ]
                poison._act("detection", cells, setting=self._chosen)
                return super().find(image, dictionary, frame_side)

        return Detector

    def detections_for(self, estimator, batch, result, rows):
        seen = self._real["detections_for"](estimator, batch, result, rows)
        known = self._cells(batch.scenes)
        return _told(seen, [known[row] for row in rows.tolist()]) if known else seen

    def build(self, setting):
        return _Estimator(self, setting, self._real["build"](setting))


def _told(seen, cells):
    """Return detections that know which scenes they are of."""

    class Told(type(seen)):
        """As its base; found corners alone do not tell one scene from another."""

        def take(self, rows):
            return _told(super().take(rows), [cells[row] for row in rows])

    told = Told(*(getattr(seen, field.name) for field in dataclasses.fields(seen)))
    object.__setattr__(told, "cells", cells)
    return told


class _Estimator:
    """An estimator that looks at which scenes it is given."""

    def __init__(self, poison, setting, real):
        self._poison, self._setting, self._real = poison, setting, real

    def __getattr__(self, name):
        return getattr(self._real, name)

    def __call__(self, detections):
        cells = getattr(detections, "cells", ())
        self._poison._act("estimation", cells, solver=self._setting)
        return self._real(detections)


class _Finder(importlib.abc.MetaPathFinder):
    """Has the evaluation wrapped as soon as it has been loaded."""

    def __init__(self, poisons, log):
        self._given = poisons, log

    def find_spec(self, name, path=None, target=None):
        if name != "sweep.evaluation.block":
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        load = spec.loader.exec_module

        def load_and_wrap(module):
            load(module)
            _Poison(module, sys.modules["sweep.evaluation.search"], *self._given)

        spec.loader.exec_module = load_and_wrap
        return spec


if "SWEEP_POISON" in os.environ:
    _given = json.loads(os.environ["SWEEP_POISON"])
    sys.meta_path.insert(0, _Finder(_given["poisons"], str(Path(_given["log"]))))
