"""The reference of parameters in Markdown, from where each is declared.

>>> python -m sweep.plan.parameter_reference        # doctest: +SKIP
"""

from __future__ import annotations

from sweep.plan.axes import label
from sweep.plan.parameters import PARAMETERS, SECTIONS, Parameter


def reference() -> str:
    """Return a table of each section's parameters: name, default, unit, values, meaning."""
    lines: list[str] = []
    for section, (_, stage) in SECTIONS.items():
        lines += [
            f"#### `[{section}]` ({stage.name})", "",
            "| parameter | default | unit | values | meaning |", "| --- | --- | --- | --- | --- |",
        ]
        lines += [_row(p) for p in PARAMETERS.values() if p.section == section]
        lines.append("")
    return "\n".join(lines)


def _row(parameter: Parameter) -> str:
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
    meaning = parameter.declaration.meaning.replace("|", "\\|")
    return (
        f"| `{parameter.name}` | {shown} | {parameter.unit} | {values}{drawable} | {meaning} |"
    )


if __name__ == "__main__":
    print(reference())  # noqa: T201  (a command)
