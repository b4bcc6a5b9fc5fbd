"""An environment in which chosen scenes raise, crash or stall the process that computes them."""

import contextlib
import dataclasses
import json
import os
from pathlib import Path
from unittest import mock

from support.poisoned.sitecustomize import poison
from sweep.evaluation import block, search

POISONED = Path(__file__).parent / "poisoned"

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
        return self.how != "raise"

    def written(self):
        return {**dataclasses.asdict(self), "setting": dict(self.setting),
                "solver": dict(self.solver)}


def poisoned(poisons, log):
    """Return the environment in which the commands are poisoned."""
    given = {"log": str(log), "poisons": [each.written() for each in poisons]}
    path = os.pathsep.join(filter(None, [str(POISONED), os.environ.get("PYTHONPATH")]))
    return {**os.environ, "PYTHONPATH": path, "SWEEP_POISON": json.dumps(given)}


POISONED_FUNCTIONS = [(search, "images_of"), (search, "detection_sources"),
                      (block, "detections_for"), (block.results, "all_or_each")]


@contextlib.contextmanager
def raising(poisons, log):
    """Have scenes raise in this process while this is entered."""
    assert not any(each.deadly for each in poisons)
    with contextlib.ExitStack() as stack:
        for owner, name in POISONED_FUNCTIONS:
            stack.enter_context(mock.patch.object(owner, name, getattr(owner, name)))
        poison(block, search, [each.written() for each in poisons], str(log))
        yield
