"""The reference: every parameter, variable, flag, solver, effect and statistic, as tables.

The tables are made from the declarations that the code works by, so they cannot be out of date.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import pandas as pd

from sweep.analysis.summaries import ERROR_HEADINGS, POSE_STATISTICS
from sweep.errors import ArgumentError
from sweep.experiment.parameters import PARAMETERS, SECTIONS, Parameter
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import Flag
from sweep.messages import nearest, shown
from sweep.model.effects import EFFECTS
from sweep.report.table import Findings, Table


def reference(*names: str) -> Findings:
    """Return parameters, effects, solvers, variables, flags or statistics, with their meaning.

    Parameters
    ----------
    names
        A subject ("camera", "effects", "flags", ...) or a parameter; without any, the subjects.

    Returns
    -------
    Findings
        A table of each subject, and one of the parameters.

    Raises
    ------
    ArgumentError
        For a name that is neither.

    Examples
    --------
    >>> sweep.reference("tilt_deg").numbers["parameters"][0]["unit"]
    'degree'
    """
    chosen = [name for name in map(str, names) if name not in TABLES]
    for name in chosen:
        if name not in PARAMETERS:
            raise ArgumentError("names", name, f"expected {', '.join(TABLES)}, or a parameter"
                                + nearest(name, [*TABLES, *PARAMETERS]))
    tables = [TABLES[name]() for name in names if name in TABLES]
    if chosen:
        tables.append(_parameters("parameters", [PARAMETERS[name] for name in chosen]))
    if not names:
        tables = [_table("subjects", ({"subject": name, "rows": len(make().frame)}
                                      for name, make in TABLES.items()))]
    then = ("", "") if names else ("sweep reference NAME", "prints a table, or a parameter")
    return Findings(
        tables, {table.caption: table.as_json()["rows"] for table in tables}, then=then)


def _table(caption: str, rows: Iterable[dict[str, Any]]) -> Table:
    """Return a table of rows by their headings."""
    return Table(caption, pd.DataFrame(list(rows), dtype=object), words=True)


def _parameters(caption: str, parameters: Iterable[Parameter]) -> Table:
    """Return parameters with default, unit, values and meaning."""
    return _table(caption, ({
        "parameter": each.name, "unit": each.unit,
        "default": "-" if each.default is None else shown(each.default),
        "values": ("a predefined dictionary of the installed OpenCV" if each.name == "dictionary"
                   else each.expected()) + "; can be drawn" * each.drawable,
        "meaning": each.meaning} for each in parameters))


def _section(section: str) -> Table:
    return _parameters(f"[{section}] ({SECTIONS[section][1].name})",
                       (each for each in PARAMETERS.values() if each.section == section))


#: Flag variable -> its flags.
FLAGS: dict[str, type[Flag]] = {
    each.name: each.flags for each in VARIABLES.values() if each.flags is not None}


def _presence(variable: Variable) -> str:
    """Return where a variable has a number, and where it is NaN."""
    if variable.flags is not None:
        return "a flag"
    rule = variable.present_when
    if rule is None:
        return ""
    if rule.number == "unless_lost":
        return "always, unless the scene's computation failed"
    if rule.number == "if_seen":
        return "unless the scene's computation failed, or a corner is behind the camera"
    names = " or ".join(flag.name for flag in FLAGS[rule.flag] if flag.present)
    return f"{'if' if rule.number == 'always' else 'only if'} {rule.flag} is {names}"


#: Subject -> the function that makes its table.
TABLES: dict[str, Callable[[], Table]] = {
    **{section: partial(_section, section) for section in SECTIONS},
    "effects": lambda: _table("effects, in physical order", ({
        "effect": each.label, "switched on by": each.switch, "absent at": each.off_text,
        "acts on": each.step, "random": each.random, "in the bound": each.in_bound,
        "meaning": PARAMETERS[each.switch].meaning} for each in EFFECTS)),
    "solvers": lambda: _table("choices of the estimator's solver", ({
        "solver": name, "meaning": each.meaning,
        "from": "a file" if each.recorded else "pixels" if each.needs_images else "corners",
        "guarded": each.guarded} for name, each in SOLVERS.items())),
    "variables": lambda: _table("variables of the dataset", ({
        "variable": each.name, "stage": each.stage.name,
        "dimensions beside the axes": ", ".join(each.inner), "unit": each.units,
        "meaning": each.meaning, "number": _presence(each)} for each in VARIABLES.values())),
    "flags": lambda: _table("flags", ({
        "variable": name, "value": int(flag), "flag": flag.name, "meaning": flag.meaning,
        "counted in rates": flag.counted} for name, flags in FLAGS.items() for flag in flags)),
    "statistics": lambda: _table("variables of error_statistics", (
        {"variable": name, "meaning": meaning} for name, meaning in (
            *((each.name, each.meaning) for each in POSE_STATISTICS),
            *((f"*_{name}_*", f"error: {heading}") for heading, name in ERROR_HEADINGS.items())
        ))),
}
