"""Errors as the user of a command reads them: lines that name flags, and an exit status."""

from __future__ import annotations

import argparse
import errno
import itertools
import shlex
import sys
from collections.abc import Sequence

from sweep.errors import (
    ArgumentError,
    OtherExperimentError,
    PipelineError,
    PluginError,
    StoreError,
    SweepError,
)
from sweep.messages import plain

MAX_LINE_LENGTH = 2000

ADVICE = {
    errno.EMFILE: "allow more open files (ulimit -n)",
    errno.EAGAIN: "allow more processes (ulimit -u)",
    errno.ENOMEM: "free memory, or allow more (ulimit -v)",
    errno.ENOSPC: "free space on the disk",
    errno.EFBIG: "allow larger files (ulimit -f)",
}
"""What to change after an error of the system."""


OUTPUT_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""What writing may end with."""

NO_THREAD = "can't start new thread"
"""What Python says in a RuntimeError where the system allows no more threads."""

REFUSALS = (ArgumentError, PipelineError, PluginError, StoreError)
"""Errors of what was asked for (exit status 2); others occur while a command runs (1)."""


def print_error(error: SweepError, options: argparse.Namespace) -> int:
    """Print an error's lines, without terminal control characters; return the exit status.

    An :class:`ArgumentError` names an argument of a Python function, such as ``time_limit_s``; the
    line names the flag that sets it, ``--time-limit``.
    """
    text = str(error)
    if isinstance(error, ArgumentError):
        given = f" {error.value}" if str(error.value) else ""
        text = f"{flag_of(error.argument, options)}{given}: {error.problem}"
    if isinstance(error, OtherExperimentError) and error.reusable and "reuse" in options:
        command = _reusing_command(options.given, error.url)
        text = "\n".join([
            f"{error.url}: holds another experiment; reuse its cells in a new store: {command}",
            *(f"  {line}" for line in error.differences)])
    for line in text.splitlines():
        print(plain(line, MAX_LINE_LENGTH), file=sys.stderr)
    return 2 if isinstance(error, REFUSALS) else 1


def _reusing_command(given: Sequence[str], url: str) -> str:
    """Return the command that runs the same into a new store, and reuses the cells of another."""
    from sweep.store.locations import exists  # noqa: PLC0415

    stem = url.removesuffix(".zarr")
    new = next(name for name in (f"{stem}-{number}.zarr" for number in itertools.count(2))
               if not exists(name))
    at = [k for k, word in enumerate(given) if word.partition("=")[0] == "--store"]
    left_out = {*at, *(k + 1 for k in at if "=" not in given[k])}
    words = [word for k, word in enumerate(given) if k not in left_out]
    return shlex.join(["sweep", *words, "--store", new, "--reuse", url])


def print_import_error(error: ImportError) -> int:
    """Print one line if OpenCV cannot be imported; raise any other error, which is a defect."""
    if error.name is None or error.name.partition(".")[0] != "cv2":
        raise error
    print(
        f"OpenCV cannot be imported: {error}; reinstall it with "
        "`pip install --force-reinstall opencv-contrib-python-headless`",
        file=sys.stderr,
    )
    return 2


def print_system_error(error: OSError | MemoryError | RuntimeError) -> int:
    """Print one line if the system refused a file, memory, a thread or a process.

    Any other RuntimeError is a defect, and raised.
    """
    from sweep.cli.output import is_refused_output  # noqa: PLC0415

    if isinstance(error, MemoryError):
        line, number = "out of memory", errno.ENOMEM
    elif isinstance(error, OSError):
        if error.filename is None and error.errno in OUTPUT_ERRORS and is_refused_output():
            cause = "standard output cannot be written"
        else:
            cause = str(error.filename or "the system refused a request")
        line, number = f"{cause}: {error.strerror or error}", error.errno or 0
    elif str(error) == NO_THREAD:
        line, number = f"the system refused a request: {error}", errno.EAGAIN
    else:
        raise error
    advice = f"; {ADVICE[number]}" if number in ADVICE else ""
    print(plain(line + advice, MAX_LINE_LENGTH), file=sys.stderr)
    return 1


def flag_of(argument: str, options: argparse.Namespace) -> str:
    """Return the flag that sets an argument of a Python function, in the command being run.

    A command declares flags under the names of these arguments (``dest``); an argument without a
    declared flag is named as a flag usually is, with ``-`` for ``_``.
    """
    flags: dict[str, str] = getattr(options, "flags", {})
    return flags.get(argument, f"--{argument.replace('_', '-')}")
