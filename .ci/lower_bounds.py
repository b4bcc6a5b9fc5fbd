"""Print the lower bound of every dependency of pyproject.toml, as pip installs it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).parent.parent / "pyproject.toml"


def lower_bounds(requirements: list[str]) -> list[str]:
    """Return ``name==version`` for each requirement ``name>=version``.

    Raises
    ------
    ValueError
        If a requirement has no lower bound.
    """
    pinned = []
    for requirement in requirements:
        found = re.match(r"([\w.-]+)>=([\w.]+)", requirement)
        if found is None:
            raise ValueError(f"{requirement}: expected a lower bound")
        pinned.append("==".join(found.groups()))
    return pinned


if __name__ == "__main__":
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    print(*lower_bounds(project["dependencies"]), sep="\n")
