"""Every parameter of every section, gathered from its declaration; parameters of plug-ins."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any

from sweep.declaration import Declared, declared_fields
from sweep.errors import PluginError
from sweep.measure.detectors import BoardDetectorSetting, DetectorChoice, DetectorSetting
from sweep.measure.estimators import EstimatorSetting
from sweep.measure.likelihood import BoundSetting
from sweep.model.board_kinds import BoardValues
from sweep.model.camera import Camera
from sweep.model.effects import Effects
from sweep.model.marker import Marker
from sweep.model.pose import Pose, WorldPose
from sweep.model.scene import Scene
from sweep.plugins.loading import DeclaredPlugin, declare, offered

# --------------------------------------------------------------------------------------------------
# Every parameter of every section, gathered from where it is declared.

class Stage(IntEnum):
    """The stages of the core loop; a parameter belongs to the first stage that it affects."""

    scene = 0
    detection = 1
    estimation = 2


#: Section of a pipeline file -> the dataclasses that declare its parameters, and its stage.
SECTIONS: dict[str, tuple[tuple[type, ...], Stage]] = {
    "camera": ((Camera,), Stage.scene),
    "marker": ((Marker,), Stage.scene),
    "board": ((BoardValues,), Stage.scene),
    "pose": ((Pose, WorldPose), Stage.scene),
    "scene": ((Scene, Effects, BoundSetting), Stage.scene),
    "detector": ((DetectorChoice, DetectorSetting, BoardDetectorSetting), Stage.detection),
    "estimator": ((EstimatorSetting,), Stage.estimation),
}

#: Sections whose values make up the geometry key of the random draws.
GEOMETRY_SECTIONS = ("camera", "marker", "pose")


@dataclass(frozen=True)
class Parameter(Declared):
    """A parameter of pipelines: a declared field with its section and stage."""

    section: str = ""
    stage: Stage = Stage.scene


#: Every parameter by its name; names are unique over all sections.
PARAMETERS: dict[str, Parameter] = {
    name: Parameter(**vars(each), section=section, stage=stage)
    for section, (declaring, stage) in SECTIONS.items() for group in declaring
    for name, each in declared_fields(group).items()
}


# --------------------------------------------------------------------------------------------------
# Parameters that say the same in different ways: one of the ways is given, not two.

#: Parameters that place the camera and the marker in the world.
WORLD = tuple(
    f"{whose}_{name}" for whose in ("camera", "marker")
    for name in ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
)

#: Parameters that place the marker in the camera's frame.
IN_CAMERA = tuple(
    p.name for p in PARAMETERS.values()
    if p.section == "pose" and p.name not in (*WORLD, "jitter_px")
)

SENSOR_SIDES = ("sensor_width_mm", "sensor_height_mm")
IN_MM = (*SENSOR_SIDES, "focal_length_mm", "pixel_size_um")
FIELDS_OF_VIEW = ("hfov_deg", "vfov_deg", "dfov_deg")

#: The ways, each of one or more parameters, in which a quantity of the pose in the camera's frame,
#: of the camera, or of what is believed of it is given: one of them, not two.
CHOICES: tuple[tuple[tuple[str, ...], ...], ...] = (
    (("distance_m",), ("side_px",)),
    (("bearing_x_deg",), ("x_m",), ("frame_x",)),
    (("bearing_y_deg",), ("y_m",), ("frame_y",)),
    (("tilt_deg",), ("view_angle_deg",), ("yaw_deg", "pitch_deg")),
    (("azimuth_deg",), ("yaw_deg", "pitch_deg")),
    (("fx_px", "fy_px"), IN_MM, *((name,) for name in FIELDS_OF_VIEW)),
    (SENSOR_SIDES, ("pixel_size_um",)),
    (("believed_focal_scale",), ("believed_fx_px", "believed_fy_px")),
)

#: The parameter that takes poses and images from a record of photographs.
PHOTOGRAPHS = "photographs"

#: The parameters that say how far a calibration is from the truth.
STATED = ("calibration_sd", "calibration_covariance")

#: The parameter that takes from such a record the poses alone.
SIMULATED = "simulated"

#: The parameters that cannot be an axis.
ONE_VALUE = ("camera_file", *STATED, SIMULATED, "ids", "markers", "distractors")

#: Parameter of one of the ways -> the parameters of the other ways.
#:
#: >>> sorted(RIVALS["yaw_deg"]) ['azimuth_deg', 'tilt_deg', 'view_angle_deg']
RIVALS: dict[str, frozenset[str]] = {
    name: frozenset(
        other for ways in CHOICES for way in ways
        if name not in way and any(name in each for each in ways) for other in way
    )
    for choice in CHOICES for each in choice for name in each
}


def is_zip(value: Any) -> bool:
    """Return whether a value under [axes] makes an axis of parameters that go together."""
    return isinstance(value, dict) and value.keys() == {"zip"} and isinstance(value["zip"], dict)


# --------------------------------------------------------------------------------------------------
# The plug-ins that a document names, and their settings as parameters beside our own.

#: Kind of plug-in -> the parameter whose values name it.
NAMED_BY = {each.plugin: each for each in PARAMETERS.values() if each.plugin}

#: The key above the sections that names effects.
EFFECTS_KEY = "effects"

#: The keys whose values name plug-ins.
NAMING = (EFFECTS_KEY, *(parameter.name for parameter in NAMED_BY.values()))


def section_of_settings(kind: str) -> str:
    """Return the section that the settings of a kind of plug-in belong under."""
    return NAMED_BY[kind].section if kind in NAMED_BY else "scene"


def _named(document: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield kind, name and key of each plug-in that a document names, or means to, in its order."""
    tables = {path: table for path, table in document.items() if isinstance(table, dict)}
    tables |= {f"axes.{key}": value["zip"]
               for key, value in tables.get("axes", {}).items() if is_zip(value)}
    for kind, parameter in NAMED_BY.items():
        # Where there are several choices, another word is more likely one of them, misspelt.
        few = len(parameter.choices) == 1
        for path, table in tables.items():
            known = path.partition(".")[0] in (parameter.section, "axes")
            for name in _words(table.get(parameter.name)) if known else ():
                try:
                    parameter.check(name)
                except ValueError:
                    if few or ":" in name or name in [entry.name for entry in offered(kind)]:
                        yield kind, name, f"{path}.{parameter.name}"
    for name in _words(document.get(EFFECTS_KEY), single=False):
        yield "effect", name, EFFECTS_KEY


def _words(value: Any, *, single: bool = True) -> list[str]:
    """Return the texts of a list, of ``{ values = [...] }``, or a ``single`` one."""
    listed = value.get("values") if isinstance(value, dict) else value
    whole = listed if isinstance(listed, list) else [listed] * single
    return [word for word in whole if isinstance(word, str)]


def read_plugins(
    document: Mapping[str, Any], folder: str, known: Iterable[DeclaredPlugin] | None
) -> tuple[list[DeclaredPlugin], list[tuple[str, str, str, str]]]:
    """Return a document's plug-ins, and faults: kind, key, name and what was expected.

    ``known`` are those of a store, or of the pipeline that the document is a cell of: they are
    taken instead of importing them, also those that the document does not name.
    """
    plugins = list(known or ())
    declared = {(plugin.kind, plugin.name) for plugin in plugins}
    faults: list[tuple[str, str, str, str]] = []
    for kind, name, key in _named(document):
        if (kind, name) not in declared:
            declared.add((kind, name))
            try:
                if known is not None:
                    raise PluginError("a plug-in that the store has recorded")
                plugin = declare(kind, name, folder)
                parameters_with((*plugins, plugin))
                plugins.append(plugin)
            except PluginError as error:
                faults.append((kind, key, name, str(error)))
    return plugins, faults


def lacking_plugins(plugins: Iterable[DeclaredPlugin], folder: str) -> list[str]:
    """Return a line for each plug-in that is not in this process as it was declared."""
    lines = []
    for plugin in plugins:
        try:
            plugin.record(folder)
        except PluginError as error:
            lines.append(str(error))
    return lines


@lru_cache(maxsize=64)
def parameters_with(plugins: tuple[DeclaredPlugin, ...]) -> Mapping[str, Parameter]:
    """Return every parameter by its name: our own, which may name them, and their settings.

    Raises
    ------
    PluginError
        If a setting has a name of ours, or of another plug-in's that is declared otherwise.
    """
    gathered = dict(PARAMETERS)
    for plugin in plugins:
        section = section_of_settings(plugin.kind)
        stage = SECTIONS[section][1]
        if plugin.kind in NAMED_BY:
            by = gathered[NAMED_BY[plugin.kind].name]
            gathered[by.name] = dataclasses.replace(by, choices=(*by.choices, plugin.name))
        for setting in plugin.settings:
            name, own = setting.name, Parameter(**vars(setting), section=section, stage=stage)
            if name in PARAMETERS:
                raise PluginError(f"another name for its setting {name}: the pipeline has this one")
            if gathered.setdefault(name, own) != own:
                raise PluginError(f"its setting {name} to be declared as that of another plug-in, "
                                  "or another name")
    return gathered
