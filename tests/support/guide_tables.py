"""Tables of the guides, generated from the declarations that the code works by.

``python tests/support/guide_tables.py FILE.md ...`` replaces what stands between the markers
``<!-- table: NAME -->`` and ``<!-- /table -->`` by the table of that name; ``--check`` only
compares, and exits with 1 if a table is out of date. Without files it lists the names.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from sweep.analysis.summaries import POSE_STATISTICS, error_headings
from sweep.experiment.parameters import PARAMETERS, SECTIONS, Parameter
from sweep.experiment.schema import VARIABLES, Variable
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import Flag
from sweep.messages import label, nearest
from sweep.model.effects import EFFECTS

_MARKED = re.compile(r"(<!-- table: (\S+) -->\n)(.*?)(<!-- /table -->)", re.DOTALL)
_OPENING = re.compile(r"<!-- table: \S+ -->")


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    r"""Return a Markdown table; the cells' ``|`` are escaped.

    >>> print(markdown_table(["a", "b"], [["1", "x | y"]]))
    | a | b |
    | --- | --- |
    | 1 | x \| y |
    """
    lines = [header, ["---"] * len(header)]
    lines += [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def parameter_table(section: str) -> str:
    """Return the parameters of a section: name, default, unit, values, meaning."""
    return markdown_table(
        ["parameter", "default", "unit", "values", "meaning"],
        [_parameter_row(p) for p in PARAMETERS.values() if p.section == section],
    )


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
    elif parameter.name == "renderer":
        values = "a string"
    drawable = "; can be drawn" if parameter.declaration.drawable else ""
    meaning = parameter.declaration.meaning
    return [f"`{parameter.name}`", shown, parameter.unit, f"{values}{drawable}", meaning]


def parameter_tables() -> str:
    """Return the tables of all sections, each under its heading."""
    parts = [
        f"#### `[{section}]` ({stage.name})\n\n{parameter_table(section)}\n"
        for section, (_, stage) in SECTIONS.items()
    ]
    return "\n".join(parts).rstrip("\n")


def variable_table() -> str:
    """Return the variables of the dataset: name, stage, inner dimensions, unit, meaning."""
    return markdown_table(
        ["variable", "stage", "dimensions beside the axes", "unit", "meaning", "number"],
        [
            [f"`{v.name}`", v.stage.name, ", ".join(v.inner), v.units, v.meaning, _presence(v)]
            for v in VARIABLES.values()
        ],
    )


def _presence(variable: Variable) -> str:
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
    return f"{'if' if rule.number == 'always' else 'only if'} `{rule.flag}` is {names}"


def _flags() -> dict[str, type[Flag]]:
    """Return the flags of each flag variable."""
    return {v.name: v.flags for v in VARIABLES.values() if v.flags is not None}


def flag_table(variable: str) -> str:
    """Return the flags of a variable: value, name, meaning, and which poses rates count."""
    return markdown_table(
        ["value", "flag", "meaning", "counted"],
        [
            [str(int(flag)), f"`{flag.name}`", flag.meaning, "yes" if flag.counted else "no"]
            for flag in _flags()[variable]
        ],
    )


def flag_tables() -> str:
    """Return the flags of all variables in one table."""
    rows = [
        [f"`{name}`", str(int(flag)), f"`{flag.name}`", flag.meaning,
         "yes" if flag.counted else "no"]
        for name, flags in _flags().items() for flag in flags
    ]
    return markdown_table(["variable", "value", "flag", "meaning", "counted"], rows)


def solver_table() -> str:
    """Return the choices of the estimator's ``solver``."""
    return markdown_table(
        ["solver", "meaning", "from", "guarded"],
        [
            [f"`{name}`", solver.meaning,
             "a file" if solver.recorded else "pixels" if solver.needs_images else "corners",
             "yes" if solver.guarded else "no"]
            for name, solver in SOLVERS.items()
        ],
    )


def effect_table() -> str:
    """Return the effects in physical order: name, the parameter that switches it on, meaning."""
    rows = [
        [
            effect.label, f"`{effect.switch}`", effect.off_text, effect.step,
            "yes" if effect.random else "no", "yes" if effect.in_bound else "no",
            PARAMETERS[effect.switch].declaration.meaning,
        ]
        for effect in EFFECTS
    ]
    return markdown_table(
        ["effect", "switched on by", "absent at", "acts on", "random", "in the bound", "meaning"],
        rows,
    )


def statistics_table() -> str:
    """Return the guide's table of the variables, in Markdown.

    Examples
    --------
    >>> print(statistics_table().splitlines()[2])
    | `looked_for` | poses that were run, visible and modelled |
    """
    rows = [(record.statistic.outputs()[0].name, record.statistic.outputs()[0].meaning)
            for record in POSE_STATISTICS]
    rows += [(f"*_{name}_*", f"error: {heading}") for heading, name in error_headings().items()]
    return "\n".join(["| variable | meaning |", "| --- | --- |",
                      *(f"| `{name}` | {meaning} |" for name, meaning in rows)])


TABLES: dict[str, Callable[[], str]] = {
    "parameters": parameter_tables,
    **{f"parameters.{section}": partial(parameter_table, section) for section in SECTIONS},
    "variables": variable_table,
    "statistics": statistics_table,
    "flags": flag_tables,
    **{f"flags.{name}": partial(flag_table, name) for name in _flags()},
    "solvers": solver_table,
    "effects": effect_table,
}
"""Name in a marker -> the function that makes the table."""


def updated(text: str) -> str:
    r"""Return a Markdown text with the tables between its markers made anew.

    Raises
    ------
    ValueError
        If a marker names no table, or is not closed by ``<!-- /table -->``.

    Examples
    --------
    >>> print(updated("<!-- table: flags.flipped -->\n<!-- /table -->").splitlines()[2])
    | value | flag | meaning | counted |
    """
    if len(_OPENING.findall(text)) != len(_MARKED.findall(text)):
        raise ValueError("a marker <!-- table: NAME --> without <!-- /table --> after it")

    def replaced(match: re.Match[str]) -> str:
        opening, name, _, closing = match.groups()
        if name not in TABLES:
            raise ValueError(f"table: {name}: unknown{nearest(name, [*TABLES])}")
        # Blank lines keep Markdown's parsers from taking the markers for part of the table.
        return f"{opening}\n{TABLES[name]()}\n\n{closing}"

    return _MARKED.sub(replaced, text)


def outdated_tables(text: str) -> list[str]:
    """Return the names of a text's tables that differ from the declarations, in its order.

    Raises
    ------
    ValueError
        As :func:`updated`.
    """
    pairs = zip(_MARKED.findall(text), _MARKED.findall(updated(text)), strict=True)
    return [old[1] for old, new in pairs if old != new]


def main(arguments: Sequence[str]) -> int:
    """Update the tables of files, or with ``--check`` only compare; return the exit status."""
    paths = [Path(argument) for argument in arguments if argument != "--check"]
    if not paths:
        print("\n".join(TABLES))
    status = 0
    for path in paths:
        text = path.read_text(encoding="utf-8")
        try:
            names = outdated_tables(text)
        except ValueError as error:
            print(f"{path}: {error}", file=sys.stderr)
            return 2
        if names and "--check" in arguments:
            print(f"{path}: out of date: {', '.join(names)}", file=sys.stderr)
            status = 1
        elif names:
            path.write_text(updated(text), encoding="utf-8")
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
