"""Every parameter of every section, gathered from where it is declared."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from enum import IntEnum

from sweep.declaration import Declared, declared_fields
from sweep.measure.board_detector import BoardDetectorSetting
from sweep.measure.bound import BoundSetting
from sweep.measure.detector import DetectorSetting
from sweep.measure.detectors import DetectorChoice
from sweep.measure.estimators import EstimatorSetting
from sweep.model.board_values import BoardValues
from sweep.model.camera import Camera
from sweep.model.effects import Effects
from sweep.model.marker import Marker
from sweep.model.pose import Pose
from sweep.model.scene import Scene
from sweep.model.world import WorldPose


class Stage(IntEnum):
    """The stages of the core loop; a parameter belongs to the first stage that it affects."""

    scene = 0
    detection = 1
    estimation = 2


SECTIONS: dict[str, tuple[tuple[type, ...], Stage]] = {
    "camera": ((Camera,), Stage.scene),
    "marker": ((Marker,), Stage.scene),
    "board": ((BoardValues,), Stage.scene),
    "pose": ((Pose, WorldPose), Stage.scene),
    "scene": ((Scene, Effects, BoundSetting), Stage.scene),
    "detector": ((DetectorChoice, DetectorSetting, BoardDetectorSetting), Stage.detection),
    "estimator": ((EstimatorSetting,), Stage.estimation),
}
"""Section of a pipeline file -> the dataclasses that declare its parameters, and its stage."""

GEOMETRY_SECTIONS = ("camera", "marker", "pose")
"""Sections whose values make up the geometry key of the random draws."""


@dataclass(frozen=True, slots=True)
class Parameter(Declared):
    """A parameter of pipelines: a declared field with its section and stage."""

    section: str
    stage: Stage


def _gather() -> dict[str, Parameter]:
    gathered: dict[str, Parameter] = {}
    for section, (declaring, stage) in SECTIONS.items():
        for each in itertools.chain(*(declared_fields(group).values() for group in declaring)):
            if each.name in gathered:
                raise TypeError(f"parameter {each.name} is declared twice")
            gathered[each.name] = Parameter(
                each.name, each.types, each.default, each.declaration, section, stage
            )
    return gathered


PARAMETERS: dict[str, Parameter] = _gather()
"""Every parameter by its name; names are unique over all sections."""
