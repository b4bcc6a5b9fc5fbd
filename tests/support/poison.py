"""An environment in which chosen scenes raise, crash or stall the process that computes them."""

import contextlib
import dataclasses
import json
import os
from pathlib import Path
from unittest import mock

from support.poisoned.sitecustomize import _Poison
from sweep.evaluation import block, search
from sweep.experiment.experiment import Experiment
from sweep.measure import detectors

POISONED = Path(__file__).parent / "poisoned"

RAISES = ("raise",)


@dataclasses.dataclass(frozen=True)
class Poison:
    """What one scene does: to detectors with ``setting``, to estimators with ``solver``."""

    cell: int
    stage: str
    how: str
    setting: tuple = ()
    solver: tuple = ()

    @property
    def deadly(self):
        return self.how not in RAISES

    def written(self):
        return {**dataclasses.asdict(self), "setting": dict(self.setting),
                "solver": dict(self.solver)}


def poisoned(poisons, log):
    """Return the environment in which the commands are poisoned."""
    given = {"log": str(log), "poisons": [poison.written() for poison in poisons]}
    path = os.pathsep.join(filter(None, [str(POISONED), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path, "SWEEP_POISON": json.dumps(given)}


WRAPPED = [(search, "build_scenes"), (search, "render_all"), (block, "detections_for"),
           (block, "build"), (Experiment, "scene_values"), (detectors, "Detector")]


@contextlib.contextmanager
def raising(poisons, log):
    """Have scenes raise in this process while this is entered."""
    assert not any(poison.deadly for poison in poisons)
    with contextlib.ExitStack() as stack:
        for owner, name in WRAPPED:
            stack.enter_context(mock.patch.object(owner, name, getattr(owner, name)))
        _Poison(block, search, [poison.written() for poison in poisons], str(log))
        yield
