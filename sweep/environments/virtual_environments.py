"""Virtual environments by name, each with an OpenCV of its own: made, listed, removed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sweep.environments.interpreters import INSTALLED, folder, is_name, names, python_of
from sweep.environments.process import NOT_INHERITED, DetectorProcess
from sweep.errors import ArgumentError, EnvironmentFaultError
from sweep.messages import nearest, plain

INSTALL_S = 1800.0
"""How long pip may take."""

OLD_NUMPY = "numpy<2"
"""What OpenCV before 4.10 was built for."""


@dataclass(frozen=True, slots=True)
class ListedEnvironment:
    """An environment by name, and what its Python said of itself; or why it cannot be used."""

    name: str
    python: str
    python_version: str = ""
    opencv: str = ""
    numpy: str = ""
    fault: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON has it, without what is empty."""
        return {key: value for key, value in asdict(self).items() if value}


def add(
    name: str, requirements: Sequence[str], python: str | None = None
) -> ListedEnvironment:
    """Make a virtual environment and install requirements into it.

    Parameters
    ----------
    name
        Letters, digits, ``.``, ``_``, ``+`` and ``-``.
    requirements
        As pip takes them: ``opencv-contrib-python-headless==4.8.1.78``. NumPy comes with OpenCV; if
        that one needs NumPy before 2 and none is named, it is installed.
    python
        The Python that makes it; default: this one.

    Raises
    ------
    ArgumentError
        If there is one of that name, or it cannot be a name.
    EnvironmentFaultError
        In one line, if it cannot be made, or has no OpenCV with ArUco.
    """
    if not is_name(name):
        raise ArgumentError(
            "name", plain(name), "expected letters, digits, '.', '_', '+' and '-' "
            f"(and not {INSTALLED})"
        )
    if name in names():
        raise ArgumentError(
            "name", name, f"there is one already; `sweep environments remove {name}` first"
        )
    home = folder()
    try:
        home.mkdir(parents=True, exist_ok=True)
        (home / ".gitignore").write_text("*\n")
        # Known by its name only once it is whole: a link's environment may be moved.
        made = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=home))
    except OSError as error:
        raise EnvironmentFaultError(f"{home}: {error.strerror or error}") from None
    try:
        _run([python or sys.executable, "-m", "venv", str(made)], "venv")
        _install(made, requirements)
        listed = _describe(name, str(made / "bin" / "python"))
        if listed.fault and not any("numpy" in each.lower() for each in requirements):
            _install(made, [*requirements, OLD_NUMPY])
            listed = _describe(name, str(made / "bin" / "python"))
        if listed.fault:
            raise EnvironmentFaultError(f"{name}: it {listed.fault}")
        shutil.rmtree(home / name, ignore_errors=True)  # what is no environment
        made.rename(home / name)
    except OSError as error:
        raise EnvironmentFaultError(f"{home / name}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(made, ignore_errors=True)
    return _describe(name, str(home / name / "bin" / "python"))


def remove(name: str) -> None:
    """Remove a virtual environment.

    Raises
    ------
    ArgumentError
        If there is none of that name.
    """
    known = names()
    if name not in known:
        raise ArgumentError("name", plain(name), f"no such environment{nearest(name, known)}")
    # Renamed first: what is removed by half is no environment.
    gone = Path(tempfile.mkdtemp(prefix=f".{name}-", dir=folder()))
    (folder() / name).rename(gone / name)
    shutil.rmtree(gone, ignore_errors=True)


def listed() -> list[ListedEnvironment]:
    """Return every environment by name, in order; each is started to ask what it is."""
    return [_describe(name, str(python_of(folder() / name))) for name in names()]


def _describe(name: str, python: str) -> ListedEnvironment:
    try:
        process = DetectorProcess(python)
    except EnvironmentFaultError as error:
        return ListedEnvironment(name, python, fault=str(error))
    process.close()
    said = process.identity
    return ListedEnvironment(name, python, said["python"], said["opencv"], said["numpy"])


def _install(environment: Path, requirements: Sequence[str]) -> None:
    # A wheel or nothing: OpenCV takes an hour to build.
    _run(
        [str(environment / "bin" / "python"), "-m", "pip", "install", "--quiet", "--no-input",
         "--disable-pip-version-check", "--only-binary=:all:", "--retries=2", *requirements],
        f"pip install {' '.join(requirements)}",
    )


def _run(command: Sequence[str], what: str) -> None:
    """Run a command; EnvironmentFaultError with the line that says what failed."""
    variables = {key: text for key, text in os.environ.items() if key not in NOT_INHERITED}
    try:
        done = subprocess.run(  # noqa: S603  (venv and pip, with what the user asked for)
            command, capture_output=True, text=True, errors="replace", env=variables,
            stdin=subprocess.DEVNULL, timeout=INSTALL_S, check=False,
        )
    except subprocess.TimeoutExpired:
        raise EnvironmentFaultError(f"{what}: not done within {INSTALL_S:g} s") from None
    except OSError as error:
        raise EnvironmentFaultError(
            f"{plain(command[0])}: cannot be started: {error.strerror or error}"
        ) from None
    if done.returncode:
        lines = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        errors = [line for line in lines if line.startswith("ERROR:")] or lines
        reason = errors[-1].removeprefix("ERROR:").strip()
        raise EnvironmentFaultError(f"{plain(what, 200)}: {plain(reason, 300)}")
