"""Every parameter of every section, gathered from where it is declared."""

from __future__ import annotations

import dataclasses
import itertools
import typing
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from sweep.declaration import Declaration, plain_types
from sweep.measure.board_detector import BoardDetectorSetting
from sweep.measure.bound import BoundSetting
from sweep.measure.detector import DetectorSetting
from sweep.measure.detectors import DetectorChoice
from sweep.measure.estimators import EstimatorSetting
from sweep.messages import nearest
from sweep.model.board_values import BoardValues, listed_markers
from sweep.model.camera import Camera
from sweep.model.effects import Effects
from sweep.model.marker import Marker
from sweep.model.pose import Pose
from sweep.model.renderers import renderer_fault
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
class Parameter:
    """A parameter: its section, stage, types, default and declaration."""

    name: str
    section: str
    stage: Stage
    types: tuple[type, ...]
    default: Any
    declaration: Declaration

    @property
    def unit(self) -> str:
        """The unit; empty if it has none."""
        return self.declaration.unit

    def expected(self) -> str:
        """Return the allowed values in words."""
        if tuple in self.types:
            if self.declaration.list_text:
                return self.declaration.list_text
            *counts, last = self.declaration.lengths
            return f"a list of {', '.join(map(str, counts))} or {last} finite numbers"
        words = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}
        kind = " or ".join(words[kind] for kind in self.types)
        extent = self.declaration.range_text()
        if self.declaration.choices:
            return extent
        return f"{kind} {extent}".strip()

    def check(self, value: Any) -> Any:
        """Return ``value`` in the parameter's type; ValueError(expectation) if not allowed."""
        if self.name == "markers":
            return listed_markers(value)
        if tuple in self.types and isinstance(value, (list, tuple)):
            numbers = all(_is_number(item) and abs(item) < 1e300 for item in value)
            if numbers and len(value) in self.declaration.lengths:
                return tuple(float(item) for item in value)
        elif bool in self.types and isinstance(value, bool):
            return value
        elif int in self.types and isinstance(value, int) and not isinstance(value, bool):
            if self.declaration.admits(value):
                return value
        elif float in self.types and _is_number(value):
            if abs(value) < 1e300 and self.declaration.admits(float(value)):
                return float(value)
        elif str in self.types and isinstance(value, str):
            if self.name == "renderer" and value not in self.declaration.choices:
                fault = renderer_fault(value.strip().lower())
                if fault is None:
                    return value.strip().lower()
                raise ValueError(fault)
            if self.declaration.choices:
                choice = self.declaration.choice(value)
                if choice is not None:
                    return choice
            elif value:
                return value
        raise ValueError(self.expected() + self._hint(value))

    def _hint(self, value: Any) -> str:
        """Return the choice that a wrong value may stand for."""
        choices = self.declaration.choices
        if isinstance(value, str) and choices:
            return nearest(value.removeprefix(self.declaration.prefix), choices)
        if isinstance(value, int) and (name := self.declaration.of_number(value)):
            return f"; OpenCV's constant {value} is {name}"
        return ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _gather() -> dict[str, Parameter]:
    gathered: dict[str, Parameter] = {}
    for section, (declaring, stage) in SECTIONS.items():
        hints: dict[str, Any] = {}
        for each in declaring:
            hints |= typing.get_type_hints(each)
        for field in itertools.chain(*(dataclasses.fields(each) for each in declaring)):
            if field.name in gathered:
                raise TypeError(f"parameter {field.name} is declared twice")
            gathered[field.name] = Parameter(
                field.name, section, stage, plain_types(hints[field.name]), field.default,
                field.metadata["declaration"],
            )
    return gathered


PARAMETERS: dict[str, Parameter] = _gather()
"""Every parameter by its name; names are unique over all sections."""
