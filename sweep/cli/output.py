"""Output that commands share: lines, JSON, and a picture."""

from __future__ import annotations

import argparse
import io
import json
import logging
import os
import shlex
import sys
from pathlib import Path
from typing import Any

AS_MODULE = ("sweep", "__main__.py")
"""How the program's path ends if Python was told to run the package."""

MAX_LINES = 50
"""Lines of each kind that `sweep status` and `sweep verify` print."""


OTHER_FORMATS = {
    ".jpg", ".jpeg", ".svg", ".pdf", ".gif", ".tif", ".tiff", ".bmp", ".webp", ".html", ".toml",
    ".zarr", ".csv", ".json",
}
"""Suffixes of files that a PNG image would not be taken for."""


def say(text: str = "") -> None:
    """Print lines without control characters, whosever names and texts they quote."""
    from sweep.messages import plain  # noqa: PLC0415

    for line in text.split("\n"):
        print(plain(line, len(line)))


def say_next(command: str, meaning: str = "") -> None:
    """Print the last line of a command: what to do next."""
    say(f"next: {command}" + (f"  # {meaning}" if meaning else ""))


def command_line(options: argparse.Namespace) -> str:
    """Return the command line as it was given, quoted for a shell, with how sweep was called."""
    called = "python -m sweep" if Path(sys.argv[0]).parts[-2:] == AS_MODULE else "sweep"
    return shlex.join([*called.split(), *options.given])


def accept_any_text() -> None:
    """Print characters that the encoding of the terminal lacks as escapes, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def flushed(status: int) -> int:
    """Return a status once everything printed is written; OSError if it cannot be."""
    if sys.stdout is not None:
        sys.stdout.flush()
    return status


def is_refused_output() -> bool:
    """Return whether standard output cannot be written; what it holds back is dropped then.

    It is tried with an empty line, in case nothing is held back.
    """
    if sys.stdout is None:
        return False
    try:
        print(flush=True)
    except OSError:
        # Python would try again when it ends, and say so.
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)
        return True
    return False


def quiet_matplotlib() -> None:
    """Silence what matplotlib says of places for its caches, and drop a choice of windows for it.

    It works without caches, and files need no windows; a choice that it does not know is an error.
    """
    os.environ.pop("MPLBACKEND", None)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object."""
    print(json.dumps(content, indent=2))


def check_png(output: str) -> None:
    """Check that a picture can be written, before it is computed.

    Raises
    ------
    ArgumentError
        If its name is that of another format.
    StoreError
        If it cannot be.
    """
    from sweep.errors import ArgumentError  # noqa: PLC0415
    from sweep.report.output_file import check_output_file  # noqa: PLC0415

    if Path(output).suffix.lower() in OTHER_FORMATS:
        raise ArgumentError("output", output, "expected a file that ends in .png")
    check_output_file(Path(output))


def write_png(output: str, image: Any) -> None:
    """Write an image (h, w) or (h, w, 3), blue-green-red, as a PNG file.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    import cv2  # noqa: PLC0415

    from sweep.report.output_file import write_output_file  # noqa: PLC0415

    _, encoded = cv2.imencode(".png", image)
    write_output_file(Path(output), encoded.tobytes())
