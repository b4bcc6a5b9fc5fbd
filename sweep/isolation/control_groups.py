"""What Linux says of the control groups of this process, which limit memory, processes, threads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

MOUNT = Path("/sys/fs/cgroup")


def control_groups(controller: str) -> Iterator[Path]:
    """Yield the folder of this process's group, and of those around it; none without such groups.

    In a container, its own group may be seen as the root.

    Parameters
    ----------
    controller
        "memory" or "pids".
    """
    for line in text_of(Path("/proc/self/cgroup")).splitlines():
        _, controllers, path = (line + "::").split(":")[:3]
        if controllers == "":
            top = MOUNT
        elif controller in controllers.split(","):
            top = MOUNT / controller
        else:
            continue
        group = top / path.strip("/")
        yield group
        yield from (folder for folder in group.parents if folder.is_relative_to(top))


def number_in(path: Path) -> int | None:
    """Return the number that a file holds; None if it holds none, such as "max"."""
    text = text_of(path).strip()
    return int(text) if text.isdecimal() else None


def text_of(path: Path) -> str:
    """Return a file's text, empty if it cannot be read."""
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError):
        return ""
