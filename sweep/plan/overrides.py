"""Values that replace those of a pipeline document: ``--set`` changes it, ``--at`` fixes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import tomlkit
import tomlkit.items

from sweep.messages import MAX_FAULTS, nearest, plain, refusal
from sweep.plan.axes import DISTRIBUTION_FORMS, TRIAL
from sweep.plan.parameters import PARAMETERS
from sweep.plan.reader import HEADER, section_of
from sweep.plan.toml_text import quoted_if_bare, read_value


def parse_settings(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values that "key=value" settings give, by parameter or header key.

    A parameter's name needs no section, and a bare word counts as a string.

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
            value = read_value(quoted_if_bare(written))
        except ValueError:
            faults.append(f"{start}expected a TOML value, such as [0, 45] or 'text'")
            continue
        home = section_of(name)
        if not home and name not in HEADER:
            known = [*PARAMETERS, TRIAL, *HEADER]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"{start}unknown parameter{hint}")
        elif home and section not in ("", home, "axes"):
            faults.append(f"{start}expected {name} or {home}.{name}")
        else:
            chosen[name] = value
    if faults:
        raise refusal(faults)
    return chosen


def apply_settings(document: Any, chosen: Mapping[str, Any]) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes the parameter fixed or drawn.
    """
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
        elif all(isinstance(document.get(table, {}), dict) for table in (section_of(name), "axes")):
            _write(document, name, value)
        # Otherwise a section is no table, which reading the document reports.


def fix_values(document: Any, chosen: Mapping[str, Any]) -> None:
    """Fix parameters of a document at chosen values.

    The axis ``trial`` goes; if ``distance_m`` or ``side_px`` is chosen, the other goes.
    """
    dropped = {TRIAL}
    for name, other in (("distance_m", "side_px"), ("side_px", "distance_m")):
        if name in chosen and other not in chosen:
            dropped.add(other)
    for table in document.values():
        if isinstance(table, dict):
            for name in dropped & table.keys():
                del table[name]
    for name, value in chosen.items():
        _write(document, name, list(value) if isinstance(value, tuple) else value)


def _write(document: Any, name: str, value: Any) -> None:
    """Write a parameter under its section or under the axes, and delete it from the other."""
    section = PARAMETERS[name].section if name in PARAMETERS else "axes"
    home, other = ("axes", section) if name == TRIAL or _is_axis(name, value) else (section, "axes")
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


def _is_axis(name: str, value: Any) -> bool:
    """Return whether a value of ``--set`` makes an axis."""
    if isinstance(value, dict):
        return not DISTRIBUTION_FORMS.keys() & value.keys()
    if not isinstance(value, list):
        return False
    if tuple in PARAMETERS[name].types:
        return bool(value) and all(isinstance(item, list) for item in value)
    return True
