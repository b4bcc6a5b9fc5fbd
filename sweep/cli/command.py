"""What commands share: their declaration, arguments, printing, and messages of errors."""

from __future__ import annotations

import argparse
import errno
import io
import itertools
import logging
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweep import library
from sweep.errors import (
    ArgumentError,
    OtherExperimentError,
    PipelineError,
    PluginError,
    StoreError,
    SweepError,
)
from sweep.messages import plain, quoted, to_json

if TYPE_CHECKING:
    from sweep.experiment.pipeline import Pipeline
    from sweep.report.table import Findings


# --------------------------------------------------------------------------------------------------
# What a command declares: its name, its help, its arguments, and the function that runs it.

CONTINUES = "stopped; the same command continues"
"""Told after Ctrl-C where it does; a command sets ``options.stopped`` to it."""


@dataclass(frozen=True, slots=True)
class Argument:
    """One argument of a command: names and options of argparse's ``add_argument``."""

    names: tuple[str, ...]
    options: Mapping[str, Any]


def argument(*names: str, **options: Any) -> Argument:
    """Return an argument. One that may be repeated is empty by default.

    Its ``dest`` is the name of the Python function's argument that it sets, so that an
    :class:`~sweep.errors.ArgumentError` can be reported by its flag.
    """
    if options.get("action") == "append":
        options.setdefault("default", [])
    return Argument(names, options)


@dataclass(frozen=True, slots=True)
class Example:
    """A command line and what it does."""

    line: str
    meaning: str


@dataclass(frozen=True, slots=True)
class Command:
    """One command of ``sweep``.

    Attributes
    ----------
    name
        As typed after ``sweep``.
    summary
        What it does, without a final full stop.
    guide
        Path of the page that explains it, from the top of the repository.
    examples
        Two command lines, shown at the end of its help.
    arguments
        Its arguments; of those in a tuple only one may be given.
    execute
        Runs it; returns the exit status.
    """

    name: str
    summary: str
    guide: str
    examples: tuple[Example, ...]
    arguments: tuple[Argument | tuple[Argument, ...], ...]
    execute: Callable[[argparse.Namespace], int]

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments to a parser."""
        for entry in self.arguments:
            group = parser.add_mutually_exclusive_group() if isinstance(entry, tuple) else parser
            for each in entry if isinstance(entry, tuple) else (entry,):
                group.add_argument(*each.names, **each.options)


def command(
    guide: str, examples: Mapping[str, str], *arguments: Argument | tuple[Argument, ...]
) -> Callable[[Callable[[argparse.Namespace], int]], Command]:
    """Return a decorator that makes a command of the function that runs it.

    The function's name is that of the command, its docstring says what the command does.
    ``examples`` has command line -> what it does.
    """
    def declared(execute: Callable[[argparse.Namespace], int]) -> Command:
        text = (execute.__doc__ or " ").strip()
        return Command(
            execute.__name__.replace("_", "-"), text[:1].lower() + text[1:].removesuffix("."),
            guide, tuple(Example(*each) for each in examples.items()), arguments, execute)

    return declared


# --------------------------------------------------------------------------------------------------
# Arguments that several commands share.

def settings_argument(meaning: str) -> Argument:
    """Return the argument of TOML values that replace or give others."""
    return argument(
        "--set", action="append", metavar="KEY=VALUE", dest="settings",
        help=f"{meaning}; may be repeated")


PIPELINE = (
    argument("pipeline", metavar="PIPELINE",
             help="TOML file of the experiment, or a store that was made from it"),
    settings_argument("replace a value of the file by this TOML value; a list makes an axis"),
)
PRECISION = (
    argument(
        "--precision", action="append", metavar="NAME=WIDTH",
        help="compute trials until the interval of this quantity is as narrow at each condition: "
        "half-width of a rate, of another quantity as a share of it, such as "
        "'detection_rate = 0.02' or 'rotation_error_rmse_deg = 5 %%'; may be repeated"),
    argument("--max-trials", type=int, metavar="N", help="the most trials of a condition"),
)
STORE = argument("store", metavar="STORE", help="path or URL of the store")
WORKERS = argument(
    "--workers", type=int, metavar="N",
    help="number of worker processes (default: one for each processor)")
OVERWRITE = argument("--overwrite", action="store_true", help="replace an existing store")
SCHEDULER = argument("--scheduler", metavar="ADDRESS", help="address of a Dask scheduler")


def new_store(default: str = "runs/NAME.zarr") -> tuple[Argument, ...]:
    """Return where a store is written, whether it replaces another one, and the processes."""
    place = f"path or URL of the store (default: {default})"
    return argument("--store", metavar="STORE", help=place), OVERWRITE, WORKERS


LARGE_RUN = (
    argument(
        "--reuse", action="append", metavar="STORE",
        help="copy the finished cells that this store shares with the experiment; may be "
        "repeated"),
    argument(
        "--yes", action="store_true",
        help="run also what would take more than a day, or more than is free on the disk"),
)
PHOTOGRAPHS = (
    argument(
        "folders", metavar="FOLDER", nargs="+",
        help="photographs (PNG, JPEG, BMP, PGM) of one camera; with --stereo two folders, or one "
        "of images whose halves are the left and the right camera's"),
    argument(
        "--camera", metavar="FILE",
        help="file of the camera's calibration, or `calibrate`: from the board in the "
        "photographs"),
    argument(
        "--board", metavar="FILE",
        help="TOML file of the board; the truth of a marker is the pose by all corners but its "
        "own"),
    argument("--poses", metavar="FILE", help="the true poses, CSV as `sweep score` reads it"),
    argument(
        "--stereo", metavar="FILE",
        help="calibration of a stereo camera (K1, D1, K2, D2, R, T); the truth is the pose in the "
        "other camera's image"),
)


def cell_argument(meaning: str, others: str = ", with other names") -> Argument:
    """Return the argument that selects one cell, or several."""
    return argument(
        "--at", metavar="NAME=VALUE,...", action="append",
        help=f"{meaning}; an axis that is not named takes its first value; may be "
        f"repeated{others}")


def picture(default: str | None = None) -> tuple[Argument, ...]:
    """Return where and how one scene is drawn; without a default, nothing is unless asked for."""
    written = f"default: {default}" if default else "default: no file is written"
    return (
        argument("-o", "--output", default=default, metavar="PNG",
                 help=f"file to write the image to ({written})"),
        argument("--plain", action="store_true", help="draw the image without annotations"),
        argument("--full", action="store_true",
                 help="draw the whole frame instead of the marker's surroundings"),
    )


def seconds(default: float, meaning: str) -> Argument:
    """Return the time limit of a measurement."""
    return argument(
        "--seconds", type=float, default=default, metavar="S", dest="limit_s",
        help=f"{meaning}, in seconds (default: {default:g})")


def figure_argument(meaning: str) -> Argument:
    """Return the file of a figure."""
    return argument("-o", "--output", metavar="FIGURE", help=f"{meaning} into this PNG or SVG file")


JSON = argument("--json", action="store_true", help="print one JSON object")
MARKDOWN = argument("--markdown", action="store_true", help="print Markdown")
FORM = (JSON, MARKDOWN)
"""The choice of JSON or Markdown on standard output."""


def precision_settings(precision: Sequence[str], max_trials: int | None) -> list[str]:
    """Return settings, as ``--set`` takes them, that say how well quantities are to be known.

    Raises
    ------
    ArgumentError
        If one has not the form of such.

    Examples
    --------
    >>> precision_settings(["detection_rate = 2 %"], 2400)
    ['search.precision={ detection_rate = "2 %" }', 'search.max_trials=2400']
    """
    widths = []
    for text in precision:
        name, equals, width = (part.strip() for part in text.partition("="))
        if not equals or not name.isidentifier() or not width:
            raise ArgumentError(
                "precision", text,
                "expected a quantity and the half-width of its interval, such as "
                "'detection_rate = 0.02'",
            )
        quoted = width if not width.endswith("%") else f'"{width}"'
        widths.append(f"{name} = {quoted}")
    settings = [f"search.precision={{ {', '.join(widths)} }}"] if widths else []
    if max_trials is not None:
        settings.append(f"search.max_trials={max_trials}")
    return settings


def read_pipeline(options: argparse.Namespace) -> Pipeline:
    """Return the pipeline of a command that takes one.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid.
    StoreError
        If it is given as a folder that is no store.
    """
    source = plain(options.pipeline)
    options.settings = [*options.settings, *precision_settings(
        getattr(options, "precision", ()), getattr(options, "max_trials", None))]
    try:
        pipeline = library.lifecycle.read_pipeline(options.pipeline, options.settings)
    except PipelineError as error:
        if (
            options.settings
            and any(line.endswith(library.sampling.NO_TRIALS) for line in error.faults)
            and (getattr(options, "precision", ()))
        ):
            raise ArgumentError(
                "max_trials",
                "",
                f"expected {library.sampling.NO_TRIALS}, such as 2400; beside --precision",
            ) from None
        if texts := library.lifecycle.texts_required(options.pipeline, options.settings):

            library.requirements.check_required(texts, source, error)
        raise
    if pipeline.requirements:

        library.requirements.check_required(pipeline.requirements, source)
    if pipeline.stopping is not None:

        library.rules.make_rule(pipeline)
    return pipeline


def names_of(text: str | None) -> list[str] | None:
    """Return the names that a flag such as ``--per`` lists, None if it is not given.

    >>> names_of("tilt_deg, distance_m"), names_of("")
    (['tilt_deg', 'distance_m'], [])
    """
    if text is None:
        return None
    return [name for part in text.split(",") if (name := part.strip())]


# --------------------------------------------------------------------------------------------------
# Output that commands share: lines, JSON, and a picture.

AS_MODULE = ("sweep", "__main__.py")
"""How the program's path ends if Python was told to run the package."""

MAX_LINES = 50
"""Lines of each kind that `sweep status` and `sweep verify` print."""


OTHER_FORMATS = {
    ".jpg", ".jpeg", ".svg", ".pdf", ".gif", ".tif", ".tiff", ".bmp", ".webp", ".html", ".toml",
    ".zarr", ".csv", ".json",
}
"""Suffixes of files that a PNG image would not be taken for."""


def lines_of(text: str) -> list[str]:
    """Return the lines of a text without control characters, whosever names they quote."""
    return [plain(line, len(line)) for line in text.split("\n")]


def say(text: str = "") -> None:
    """Print lines without control characters."""
    print("\n".join(lines_of(text)))


def answered(options: argparse.Namespace, found: Findings) -> int:
    """Print findings as JSON, Markdown or text, and what to do next; return the exit status."""
    if getattr(options, "json", False):
        print(found.to_json())
        return found.status
    if getattr(options, "markdown", False):
        say(found.markdown())
        return found.status
    if text := str(found):
        say(text)
    if found.then[0]:
        say_next(*found.then)
    return found.status


def say_next(command: str, meaning: str = "") -> None:
    """Print the last line of a command: what to do next."""
    say(f"next: {command}" + (f"  # {meaning}" if meaning else ""))


def command_line(options: argparse.Namespace) -> str:
    """Return the command line as it was given, quoted for a shell, with how sweep was called."""
    called = "python -m sweep" if Path(sys.argv[0]).parts[-2:] == AS_MODULE else "sweep"
    return f"{called} {quoted(*options.given)}"


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


def print_json(content: Any) -> None:
    """Print one JSON object, of a mapping or a dataclass."""
    print(to_json(content))


def check_png(output: str) -> None:
    """Check that a picture can be written, before it is computed.

    Raises
    ------
    ArgumentError
        If its name is that of another format.
    StoreError
        If it cannot be.
    """
    if Path(output).suffix.lower() in OTHER_FORMATS:
        raise ArgumentError("output", output, "expected a file that ends in .png")
    library.output_file.check_output_file(Path(output))


def write_png(output: str, image: Any) -> None:
    """Write an image (h, w) or (h, w, 3), blue-green-red, as a PNG file.

    Raises
    ------
    StoreError
        If the file cannot be written.
    """
    import cv2  # noqa: PLC0415

    _, encoded = cv2.imencode(".png", image)
    library.output_file.write_output_file(Path(output), encoded.tobytes())


# --------------------------------------------------------------------------------------------------
# Errors as the user of a command reads them: lines that name flags, and an exit status.

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
    for line in lines_of(text):
        print(plain(line, MAX_LINE_LENGTH), file=sys.stderr)
    return 2 if isinstance(error, REFUSALS) else 1


def _reusing_command(given: Sequence[str], url: str) -> str:
    """Return the command that runs the same into a new store, and reuses the cells of another."""
    stem = url.removesuffix(".zarr")
    new = next(name for name in (f"{stem}-{number}.zarr" for number in itertools.count(2))
               if not library.locations.exists(name))
    at = [k for k, word in enumerate(given) if word.partition("=")[0] == "--store"]
    left_out = {*at, *(k + 1 for k in at if "=" not in given[k])}
    words = [word for k, word in enumerate(given) if k not in left_out]
    return quoted("sweep", *words, "--store", new, "--reuse", url)


def print_system_error(error: OSError | MemoryError | RuntimeError) -> int:
    """Print one line if the system refused a file, memory, a thread or a process.

    Any other RuntimeError is a defect, and raised.
    """
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
