"""Values that replace those of a pipeline document: ``--set`` changes it, ``--at`` fixes it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import tomlkit
import tomlkit.items

from sweep.messages import MAX_FAULTS, nearest, plain, refusal
from sweep.model.board_values import used_by
from sweep.plan.alternatives import RIVALS
from sweep.plan.axes import DISTRIBUTION_FORMS, TRIAL
from sweep.plan.camera_files import FILE_DEVIATIONS, FILE_VALUES, OTHER_WAYS
from sweep.plan.parameters import PARAMETERS, Parameter
from sweep.plan.reader import HEADER, REQUIRE, is_zip, section_of
from sweep.plan.required import KEYS
from sweep.plan.stopping import MAX_TRIALS, SECTIONS
from sweep.plan.toml_text import python_boolean, quoted_if_bare, read_value

_PX = ("fx_px", "fy_px")
_SIDES = ("sensor_width_mm", "sensor_height_mm")
_MM = ("focal_length_mm", *_SIDES, "pixel_size_um")
_FIELDS = ("hfov_deg", "vfov_deg", "dfov_deg")

ALTERNATIVES: dict[str, Collection[str]] = {
    **RIVALS,
    **dict.fromkeys(_PX, (*_MM, *_FIELDS)),
    "focal_length_mm": (*_PX, *_FIELDS),
    **dict.fromkeys(_SIDES, (*_PX, *_FIELDS, "pixel_size_um")),
    "pixel_size_um": (*_PX, *_FIELDS, *_SIDES),
    **{
        name: (*_PX, *_MM, *(other for other in _FIELDS if other != name)) for name in _FIELDS
    },
    "believed_focal_scale": ("believed_fx_px", "believed_fy_px"),
    "believed_fx_px": ("believed_focal_scale",),
    "believed_fy_px": ("believed_focal_scale",),
    "camera_file": (*FILE_VALUES, *FILE_DEVIATIONS, *OTHER_WAYS),
}
"""Parameter -> those that say the same in another way: choosing it drops them."""


def parse_settings(
    settings: Sequence[str], parameters: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, Any]:
    """Return the values that "key=value" settings give, by parameter or header key.

    A parameter's name needs no section, and a bare word counts as a string. ``parameters`` are
    those that the pipeline has, plug-ins' included.

    Raises
    ------
    PipelineError
        One line for each setting that is not of that form.

    Examples
    --------
    >>> parse_settings(["tilt_deg=[0, 45]", "pose.roll_deg=3", "solver=ippe"])
    {'tilt_deg': [0, 45], 'roll_deg': 3, 'solver': 'ippe'}
    """
    faults: list[str] = []
    chosen: dict[str, Any] = {}
    for setting in settings:
        key, equals, written = (part.strip() for part in setting.partition("="))
        section, _, name = key.rpartition(".")
        start = f"--set {plain(setting)}: "
        if not equals or not name:
            faults.append(f"{start}expected key=value, such as tilt_deg=45")
            continue
        try:
            value = read_value(quoted_if_bare(python_boolean(written)))
        except ValueError:
            faults.append(f"{start}expected a TOML value, such as [0, 45] or 'text'")
            continue
        home = section_of(name, parameters)
        if (section == REQUIRE and name in KEYS) or section in SECTIONS:
            chosen[f"{section}.{name}"] = value
        elif not home and name not in HEADER and not is_zip(value):
            known = [*parameters, TRIAL, *HEADER]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"{start}unknown parameter{hint}")
        elif is_zip(value) and section in ("", "axes"):
            chosen[name] = value
        elif home and section not in ("", home, "axes"):
            faults.append(f"{start}expected {name} or {home}.{name}")
        else:
            chosen[name] = value
    if faults:
        raise refusal(faults)
    return chosen


def displaced_by(chosen: Collection[str]) -> set[str]:
    """Return the parameters that give way to chosen ones: other ways to say the same.

    >>> sorted(displaced_by(["distance_m"])), sorted(displaced_by(["side_px", "distance_m"]))
    (['side_px'], [])
    """
    others = {name for each in chosen for name in ALTERNATIVES.get(each, ())}
    return others.difference(chosen)


def _delete(document: Any, names: Collection[str]) -> None:
    """Delete parameters from all tables of a document."""
    for table in document.values():
        if isinstance(table, dict):
            for name in table.keys() & names:
                del table[name]


def apply_settings(
    document: Any, chosen: Mapping[str, Any], parameters: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes the parameter fixed or drawn. What the chosen values displace goes.
    """
    _leave_camera_file(document, chosen)
    _delete(document, displaced_by(chosen))
    _delete(document, _other_counts(chosen) | _of_other_boards(chosen, parameters))
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
        elif "." in name:  # a key of a section that has no parameters
            section, _, key = name.partition(".")
            if isinstance(document.setdefault(section, {}), dict):
                document[section][key] = value
        elif all(
            isinstance(document.get(table, {}), dict)
            for table in (section_of(name, parameters), "axes")
        ):
            _write(document, name, value, parameters)
        # Otherwise a section is no table, which reading the document reports.


def _of_other_boards(
    chosen: Mapping[str, Any], parameters: Mapping[str, Parameter]
) -> set[str]:
    """Return the parameters of boards that chosen kinds do not use; those of other kinds go."""
    if "kind" not in chosen:
        return set()
    kinds = chosen["kind"] if isinstance(chosen["kind"], list) else [chosen["kind"]]
    used = {"kind", *chosen, *(name for kind in kinds for name in used_by(kind))}
    return {name for name, each in parameters.items() if each.section == "board"} - used


def _other_counts(chosen: Collection[str]) -> set[str]:
    """Return the keys that say how many trials there are in another way than chosen ones."""
    if any(name.endswith(f".{MAX_TRIALS}") for name in chosen):
        return {TRIAL}
    return {MAX_TRIALS} if TRIAL in chosen else set()


def _leave_camera_file(document: Any, chosen: Collection[str]) -> None:
    """Delete the name of a camera file whose values the document has, if one of them is chosen."""
    camera = document.get("camera")
    if not isinstance(camera, dict) or "camera_file" in chosen:
        return
    if camera.keys() >= {"camera_file", *FILE_VALUES} and {*FILE_VALUES, *OTHER_WAYS} & {*chosen}:
        del camera["camera_file"]


def fix_values(
    document: Any, chosen: Mapping[str, Any], parameters: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Fix parameters of a document at chosen values.

    The axis ``trial`` goes, axes of parameters that go together, each of which must be chosen, and
    what the chosen values displace. The document has the values of its camera file, which goes if
    another value is chosen for one of them.
    """
    axes = document.get("axes", {})
    for section in (REQUIRE, *SECTIONS):  # one pose fulfils or fails nothing
        document.pop(section, None)
    _leave_camera_file(document, chosen)
    _delete(document, {
        TRIAL, *displaced_by(chosen), *_of_other_boards(chosen, parameters),
        *(name for name, value in axes.items() if is_zip(value)),
    })
    for name, value in chosen.items():
        written = list(value) if isinstance(value, tuple) else value
        _write(document, name, written, parameters)


def _write(
    document: Any, name: str, value: Any, parameters: Mapping[str, Parameter]
) -> None:
    """Write a parameter under its section or under the axes, and delete it from the other."""
    section = parameters[name].section if name in parameters else "axes"
    is_axis = name == TRIAL or _is_axis(name, value, parameters)
    home, other = ("axes", section) if is_axis else (section, "axes")
    if other != home and name in document.get(other, {}):
        del document[other][name]
    if home not in document:
        document[home] = {}
    inline = isinstance(document, tomlkit.TOMLDocument) and isinstance(value, dict)
    document[home][name] = _inline(value) if inline else value


def _inline(table: dict[str, Any]) -> tomlkit.items.InlineTable:
    inline = tomlkit.inline_table()
    inline.update(table)
    return inline


def _is_axis(name: str, value: Any, parameters: Mapping[str, Parameter]) -> bool:
    """Return whether a value of ``--set`` makes an axis."""
    if name not in parameters:
        return True
    if isinstance(value, dict):
        return not DISTRIBUTION_FORMS.keys() & value.keys()
    if not isinstance(value, list):
        return False
    if tuple in parameters[name].types:
        return bool(value) and all(isinstance(item, list) for item in value)
    return True
