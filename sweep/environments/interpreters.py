"""Names of environments: the Python that each stands for, and the virtual environments by name."""

from __future__ import annotations

import os
import re
from pathlib import Path

from sweep.errors import EnvironmentFaultError
from sweep.messages import nearest, plain

INSTALLED = "installed"
"""The environment that is this process's own."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}\Z")


def is_name(text: str) -> bool:
    """Return whether a text may be the name of an environment, and is no path."""
    return _NAME.match(text) is not None and text != INSTALLED


def folder() -> Path:
    """Return where virtual environments are kept: the user's cache folder (XDG base directory)."""
    cache = os.environ.get("XDG_CACHE_HOME", "")
    # The specification: relative paths are invalid, and to be ignored.
    base = Path(cache) if Path(cache).is_absolute() else Path.home() / ".cache"
    return base / "fiducial-sweep" / "environments"


def names() -> list[str]:
    """Return the names of the environments that were made, in order."""
    try:
        found = [path.name for path in folder().iterdir()]
    except OSError:
        return []
    return sorted(name for name in found if is_name(name) and python_of(folder() / name))


def python_of(environment: Path) -> Path | None:
    """Return the interpreter of a virtual environment; None if it is none."""
    python = environment / "bin" / "python"
    return python if python.exists() else None


def find_python(environment: str, start: str) -> str:
    """Return the path of an environment's interpreter.

    Parameters
    ----------
    environment
        A name, or the path of a Python or of a virtual environment.
    start
        The folder at which relative paths start.

    Raises
    ------
    EnvironmentFaultError
        In one line, if there is none.
    """
    if is_name(environment) and os.sep not in environment:
        python = python_of(folder() / environment)
        if python is not None:
            return str(python)
        known = names()
        hint = nearest(environment, known) or (
            f" ({', '.join(known)})" if known else ""
        )
        raise EnvironmentFaultError(
            f"no environment of this name{hint}; make it by `sweep environments add {environment} "
            "REQUIREMENT`, or give the path of a Python"
        )
    path = Path(start, Path(environment).expanduser())
    if path.is_dir():
        python = python_of(path)
        if python is None:
            raise EnvironmentFaultError(f"no virtual environment: {plain(path)} has no bin/python")
        return str(python)
    if not path.exists():
        raise EnvironmentFaultError(f"no file {plain(path)}; expected the path of a Python")
    # Not resolved: a virtual environment's Python is a link, and known by where it lies.
    return str(path.absolute())
