"""The reference: every parameter, variable, flag, solver, effect and statistic, as tables.

The tables are made from the declarations that the code works by, so they cannot be out of date.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from sweep.analysis.summaries import POSE_STATISTICS, error_headings
from sweep.errors import ArgumentError
from sweep.experiment.parameters import PARAMETERS, SECTIONS, Parameter
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import Flag
from sweep.messages import label, nearest
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
    parameters = [name for name in names if name not in TABLES]
    for name in parameters:
        if name not in PARAMETERS:
            raise ArgumentError(
                "names", name,
                f"expected {', '.join(TABLES)}, or a parameter"
                + nearest(name, [*TABLES, *PARAMETERS]))
    tables = [TABLES[name]() for name in names if name in TABLES]
    if parameters:
        tables.append(_parameter_table(
            "parameters", [PARAMETERS[name] for name in dict.fromkeys(parameters)]))
    if not names:
        tables = [_table("subjects", ["subject", "rows"],
                         [[name, str(len(make().frame))] for name, make in TABLES.items()])]
    numbers = {table.caption: table.as_json()["rows"] for table in tables}
    return Findings(tables, numbers, then=("sweep reference NAME", "prints a table, or a parameter")
                    if not names else ("", ""))


def _table(caption: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    return Table.of(caption, headings, rows, words=True)


def _parameter_table(caption: str, parameters: Sequence[Parameter]) -> Table:
    """Return parameters with default, unit, values and meaning."""
    return _table(caption, ["parameter", "default", "unit", "values", "meaning"],
                  [_parameter_row(parameter) for parameter in parameters])


def _section_table(section: str) -> Table:
    _, stage = SECTIONS[section]
    return _parameter_table(f"[{section}] ({stage.name})",
                            [p for p in PARAMETERS.values() if p.section == section])


def _parameter_row(parameter: Parameter) -> list[str]:
    default = parameter.default
    if default is None:
        shown = "-"
    elif isinstance(default, bool):
        shown = str(default).lower()
    else:
        shown = f"{default:g}" if isinstance(default, float) else label(default)
    values = parameter.expected()
    if parameter.name == "dictionary":
        values = "a predefined dictionary of the installed OpenCV"
    drawable = "; can be drawn" if parameter.drawable else ""
    return [parameter.name, shown, parameter.unit, f"{values}{drawable}",
            parameter.meaning]


def _variable_table() -> Table:
    return _table(
        "variables of the dataset",
        ["variable", "stage", "dimensions beside the axes", "unit", "meaning", "number"],
        [[v.name, v.stage.name, ", ".join(v.inner), v.units, v.meaning, _presence(v)]
         for v in VARIABLES.values()])


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
    names = " or ".join(flag.name for flag in _flags()[rule.flag] if flag.present)
    return f"{'if' if rule.number == 'always' else 'only if'} {rule.flag} is {names}"


def _flags() -> dict[str, type[Flag]]:
    """Return the flags of each flag variable."""
    return {v.name: v.flags for v in VARIABLES.values() if v.flags is not None}


def _flag_table() -> Table:
    return _table(
        "flags", ["variable", "value", "flag", "meaning", "counted in rates"],
        [[name, str(int(flag)), flag.name, flag.meaning, "yes" if flag.counted else "no"]
         for name, flags in _flags().items() for flag in flags])


def _solver_table() -> Table:
    return _table(
        "choices of the estimator's solver", ["solver", "meaning", "from", "guarded"],
        [[name, solver.meaning,
          "a file" if solver.recorded else "pixels" if solver.needs_images else "corners",
          "yes" if solver.guarded else "no"]
         for name, solver in SOLVERS.items()])


def _effect_table() -> Table:
    return _table(
        "effects, in physical order",
        ["effect", "switched on by", "absent at", "acts on", "random", "in the bound", "meaning"],
        [[effect.label, effect.switch, effect.off_text, effect.step,
          "yes" if effect.random else "no", "yes" if effect.in_bound else "no",
          PARAMETERS[effect.switch].meaning]
         for effect in EFFECTS])


def _statistics_table() -> Table:
    rows = [[record.statistic.outputs()[0].name, record.statistic.outputs()[0].meaning]
            for record in POSE_STATISTICS]
    rows += [[f"*_{name}_*", f"error: {heading}"] for heading, name in error_headings().items()]
    return _table("variables of error_statistics", ["variable", "meaning"], rows)


TABLES: dict[str, Callable[[], Table]] = {
    **{section: partial(_section_table, section) for section in SECTIONS},
    "effects": _effect_table,
    "solvers": _solver_table,
    "variables": _variable_table,
    "flags": _flag_table,
    "statistics": _statistics_table,
}
"""Subject -> the function that makes its table."""
