"""An environment in which chosen scenes raise, crash or stall the process that computes them."""

import dataclasses
import json
import os
from pathlib import Path

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
