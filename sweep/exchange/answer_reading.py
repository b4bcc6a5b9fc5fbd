"""What is read of a program's answers so far: names of columns, faults, and numbers as arrays."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sweep.errors import PipelineError
from sweep.messages import plain
from sweep.model.pose import rotation_of_vector

CORNERS = tuple(f"{axis}{corner}" for corner in range(4) for axis in "xy")
VECTOR = ("rx", "ry", "rz")
QUATERNION = ("qw", "qx", "qy", "qz")
POSITION = ("tx", "ty", "tz")

ALIASES = {
    "file": "image", "filename": "image", "file_name": "image", "image_name": "image",
    "marker_id": "id", "markerid": "id", "tag_id": "id",
    **{f"rvec_{axis}": f"r{axis}" for axis in "xyz"},
    **{f"tvec_{axis}": f"t{axis}" for axis in "xyz"},
    **{f"{axis}_{corner}": f"{axis}{corner}" for corner in range(5) for axis in "xy"},
}
"""Other names of columns."""

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")

MAX_PX = 1e7
MAX_M = 1e9

MAX_FAULTS = 20
"""Faults that are listed; the others are counted."""

MAX_TOLD_COLUMNS = 12


@dataclass(slots=True)
class Reading:
    """A file as far as it could be read, and its faults."""

    source: str
    images: Mapping[str, int]
    faults: list[str] = field(default_factory=list)
    count: int = 0

    def fault(self, line: int, text: str) -> None:
        """Note a fault of a line."""
        self.count += 1
        if len(self.faults) < MAX_FAULTS:
            self.faults.append(f"{self.source}: line {line}: {plain(text, 300)}")

    def check(self) -> None:
        """Raise PipelineError if there are faults."""
        if self.count > len(self.faults):
            self.faults.append(f"... and {self.count - len(self.faults):,} faults more")
        if self.faults:
            raise PipelineError(self.faults)


def finish(reading: Reading, line: int, answer: dict[str, Any]) -> bool:
    """Turn an answer's numbers into arrays; False with a fault if they cannot be."""
    pose = answer.pop("pose", None)
    if "corners" in answer:
        corners = np.array(answer["corners"]).reshape(4, 2)
        if np.abs(corners).max() > MAX_PX:
            reading.fault(line, f"corners beyond {MAX_PX:.0e} px; expected pixels of the image")
            return False
        answer["corners"] = corners
    if pose is not None:
        angles, position = np.array(pose[:-3]), np.array(pose[-3:])
        if np.abs(position).max() > MAX_M:
            reading.fault(line, f"a position beyond {MAX_M:.0e}; expected metres")
            return False
        if len(angles) == 4:
            length = float(np.linalg.norm(angles))
            if abs(length - 1) > 0.01:
                reading.fault(
                    line, f"a quaternion of length {length:.3g}; expected w, x, y, z of length 1"
                )
                return False
            w, x, y, z = angles / length
            half = math.atan2(math.hypot(x, y, z), w)
            sine = math.sin(half)
            angles = 2 * half * np.array([x, y, z]) / sine if sine else np.zeros(3)
        if np.abs(angles).max() > 1e6:
            reading.fault(line, "a rotation vector beyond 1e6; expected radians")
            return False
        answer["rotation"] = rotation_of_vector(angles[None])[0]
        answer["translation"] = position
    if "corners" not in answer and pose is None:
        reading.fault(line, "an ID without corners and without a pose")
        return False
    return True
