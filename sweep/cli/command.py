"""Commands: functions whose signature and docstring are their help; their output and errors."""

from __future__ import annotations

import argparse
import contextlib
import errno
import inspect
import io
import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from sweep import library
from sweep.errors import ArgumentError, DamagedStoreError, RunError, SweepError
from sweep.messages import notice, plain, quoted

if TYPE_CHECKING:
    from sweep.experiment.pipeline import Pipeline
    from sweep.report.table import Findings

# --------------------------------------------------------------------------------------------------
# A command: a function, with flags and help from its signature and its docstring.

#: Names that are listed behind commas; a flag that may be repeated. None if it is not given.
Names = Sequence[str] | None

#: Whole numbers that are listed behind commas.
Numbers = Sequence[int]

#: A part of numpydoc: names, in place of a type flags and what stands for the value, meaning.
PARAMETER = re.compile(r"^(\w[\w, ]*?)(?: : (.*))?\n((?:    .*\n?|\n)+)", re.MULTILINE)

#: A docstring's text in place of parameters that another command explains.
ELSEWHERE = re.compile(r"As for `(\w+)`\.?")


@dataclass(frozen=True, slots=True)
class Command:
    """One command of ``sweep``.

    Attributes
    ----------
    function
        Runs it; returns findings, which are printed, or an exit status. Parameters before ``*`` are
        positional arguments, those behind it flags.
    group
        The heading that it stands below in the help.
    guide
        Path of the page that explains it, from the top of the repository.
    examples
        Two command lines and what they do, shown at the end of its help.
    """

    function: Callable[..., Findings | int]
    group: str
    guide: str
    examples: Mapping[str, str]

    @property
    def name(self) -> str:
        """As typed after ``sweep``."""
        return self.function.__name__.replace("_", "-")

    @property
    def description(self) -> str:
        """The docstring without its parameters."""
        return (inspect.getdoc(self.function) or "").partition("\nParameters\n---")[0].strip()

    @property
    def summary(self) -> str:
        """Its summary, without a final full stop."""
        line = self.description.partition("\n")[0]
        return line[:1].lower() + line[1:].removesuffix(".")

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the function's parameters to a parser."""
        said = described(self.function)
        for parameter in inspect.signature(self.function).parameters.values():
            flags, metavar, meaning = said[parameter.name]
            names, options = argument(parameter, flags)
            if "action" not in options or options["action"] in ("append", "extend"):
                options["metavar"] = metavar
            parser.add_argument(*names, help=meaning.replace("%", "%%"), **options)
        if self.prints_findings:
            form = parser.add_mutually_exclusive_group()
            for name, meaning in (("json", "one JSON object"), ("markdown", "Markdown")):
                form.add_argument(f"--{name}", dest="printed", action="store_const", const=name,
                                  default="text", help=f"print {meaning}")

    @property
    def prints_findings(self) -> bool:
        """Whether the function returns findings."""
        return str(inspect.signature(self.function).return_annotation) == "Findings"


#: The commands by the name of their function.
DECLARED: dict[str, Command] = {}


def command(
    group: str, guide: str, examples: Mapping[str, str]
) -> Callable[[Callable[..., Findings | int]], Command]:
    """Return a decorator that makes a command of the function that runs it."""
    def declared(function: Callable[..., Findings | int]) -> Command:
        DECLARED[function.__name__] = Command(function, group, guide, examples)
        return DECLARED[function.__name__]

    return declared


def described(function: Callable[..., Any]) -> dict[str, tuple[list[str], str | None, str]]:
    """Return name -> flags, what stands for the value, and meaning, from a function's docstring.

    Of parameters described as "As for `run`." it is what that command's docstring says.
    """
    text = (inspect.getdoc(function) or "").partition("\nParameters\n----------\n")[2]
    found: dict[str, tuple[list[str], str | None, str]] = {}
    for names, spelled, meaning in PARAMETER.findall(text):
        words, parts = " ".join(meaning.split()), spelled.split()
        elsewhere = ELSEWHERE.fullmatch(words)
        other = described(DECLARED[elsewhere[1]].function) if elsewhere else {}
        flags = [part for part in parts if part.startswith("-")]
        one = flags, " ".join(parts[len(flags):]) or None, words.removesuffix(".")
        found |= {name: other.get(name, one) for name in names.split(", ")}
    return found


def names_of(text: str) -> list[str]:
    """Return the names that a flag such as ``--per`` lists.

    >>> names_of("tilt_deg, distance_m"), names_of("")
    (['tilt_deg', 'distance_m'], [])
    """
    return [name for part in text.split(",") if (name := part.strip())]


def whole_numbers(text: str) -> list[int]:
    """Return the numbers that a flag such as ``--views`` lists."""
    return [int(part) for part in text.split(",")]


#: Annotation -> what argparse makes of a flag; others are text.
KINDS: dict[str, dict[str, Any]] = {
    "int": {"type": int}, "float": {"type": float}, "bool": {"action": "store_true"},
    "Sequence[str]": {"action": "append"}, "Names": {"action": "extend", "type": names_of},
    "Numbers": {"type": whole_numbers},
}


def argument(
    parameter: inspect.Parameter, flags: Sequence[str]
) -> tuple[Sequence[str], dict[str, Any]]:
    """Return the names and options of argparse's ``add_argument`` for a parameter."""
    kind = str(parameter.annotation).removesuffix(" | None")
    options: dict[str, Any] = {}
    if kind.startswith("Literal"):
        options["choices"] = re.findall(r"'(.*?)'", kind)
    required = parameter.default is parameter.empty
    default = None if required else parameter.default
    if parameter.kind is not parameter.KEYWORD_ONLY:
        count = "?" if kind != "Sequence[str]" else "+" if required else "*"
        return [parameter.name], options | {"default": default} | (
            {} if required and count == "?" else {"nargs": count})
    names = flags or [f"--{parameter.name.replace('_', '-')}"]
    options |= {"dest": parameter.name, "default": default} | KINDS.get(kind, {})
    if default is True:
        return [names[0].replace("--", "--no-")], options | {"action": "store_false"}
    return names, options | ({"default": []} if kind == "Sequence[str]" else {})


@dataclass
class Session:
    """The command being run: its words, the flag of each argument, what Ctrl-C tells, the form."""

    given: Sequence[str] = ()
    flags: Mapping[str, str] = field(default_factory=dict)
    stopped: str = "stopped"
    form: str = "text"


SESSION = Session()

#: Told after Ctrl-C where it does; a command sets ``SESSION.stopped`` to it.
CONTINUES = "stopped; the same command continues"


# --------------------------------------------------------------------------------------------------
# Before a run: commands read the pipeline.

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
        name, _, width = (part.strip() for part in text.partition("="))
        if not name.isidentifier() or not re.fullmatch(r"[\d.eE+-]+ *%?", width):
            raise ArgumentError(
                "precision", text,
                "expected a quantity and the half-width of its interval, such as "
                "'detection_rate = 0.02'",
            )
        widths.append(f"{name} = " + (f'"{width}"' if width.endswith("%") else width))
    settings = [f"search.precision={{ {', '.join(widths)} }}"] if widths else []
    if max_trials is not None:
        settings.append(f"search.max_trials={max_trials}")
    return settings


def read_pipeline(
    source: str, settings: Sequence[str] = (), precision: Sequence[str] = (),
    max_trials: int | None = None,
) -> Pipeline:
    """Return the pipeline of a command that takes one.

    Raises
    ------
    PipelineError
        If the file or a setting is invalid.
    StoreError
        If it is given as a folder that is no store.
    """
    settings = [*settings, *precision_settings(precision, max_trials)]
    pipeline = library.lifecycle.read_pipeline(source, settings)
    if pipeline.stopping is not None:
        library.rules.make_rule(pipeline)
    return pipeline


# --------------------------------------------------------------------------------------------------
# Output: lines without control characters, and a picture.

#: Lines of each kind that `sweep status` and `sweep verify` print.
MAX_LINES = 50

def say(text: str = "") -> None:
    """Print lines without control characters, whosever names they quote."""
    print("\n".join(plain(line, len(line)) for line in text.split("\n")))


def duration(seconds: float) -> str:
    """Return a time in the largest unit of which there are at least two.

    >>> duration(90.0), duration(150.0), duration(1e6)
    ('90.0 s', '2.5 min', '11.6 days')
    """
    for unit, length in (("days", 86400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.1f} s"


def answer(found: Findings | int) -> int:
    """Print findings as JSON, Markdown or text, and what to do next; return the exit status."""
    if isinstance(found, int):
        return found
    if SESSION.form == "json":
        print(found.to_json())
    elif SESSION.form == "markdown":
        say(found.markdown())
    else:
        if text := str(found):
            say(text)
        following, meaning = found.then
        if following:
            say(f"next: {following}" + (f"  # {meaning}" if meaning else ""))
    return found.status


def findings(
    lines: Sequence[Any], numbers: Any, status: int = 0, then: str = "", meaning: str = ""
) -> Findings:
    """Return the findings of a command: lines and tables, what JSON has, and what to do next."""
    return library.table.Findings(lines, numbers, None, status, (then, meaning))


def command_line() -> str:
    """Return the command line as it was given, quoted for a shell."""
    return quoted("sweep", *SESSION.given)


def hold_streams() -> None:
    """Open the null device where a standard stream is closed: no file or socket gets its number.

    What libraries and plug-ins print there would be among what is read from that.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115


def accept_any_text() -> None:
    """Print characters that the encoding of the terminal lacks as escapes, instead of failing."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def printing() -> Iterator[None]:
    """Write everything that the body prints; OSError that says so if it cannot be."""
    try:
        yield
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            # Python would try again when it ends, and say so.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OSError(error.errno, error.strerror, "standard output cannot be written") from None


def quiet_matplotlib() -> None:
    """Silence what matplotlib says of places for its caches, and drop a choice of windows for it.

    It works without caches, and files need no windows; a choice that it does not know is an error.
    """
    os.environ.pop("MPLBACKEND", None)
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


def listed(texts: Sequence[str], more: str) -> list[str]:
    """Return the first lines of many, and a line on the others, if there are more."""
    return [*texts[:MAX_LINES], *([more] if len(texts) > MAX_LINES else [])]


def executed(
    pipeline: Pipeline, store: str, lines: Sequence[str], workers: int | None, *, overwrite: bool
) -> SimpleNamespace:
    """Run a pipeline into a store, after lines on stderr on what it was made of."""
    notice(*lines)
    SESSION.stopped = CONTINUES
    with library.progress.progress_display() as display:
        return library.runner.execute(
            pipeline, store, workers=workers, overwrite=overwrite, progress=display)


def detected_line(summary: SimpleNamespace) -> str:
    """Return in words how many of the markers that a run looked for were detected."""
    return f"detected {summary.detected:,} of {summary.looked_for:,} looked for"


def summarised(
    summary: SimpleNamespace, line: str, notes: Sequence[str] = (), then: str = "", **numbers: Any
) -> Findings:
    """Return the outcome of a run: ``line``, the dataset, warnings, and what to do next."""
    again = [] if summary.computed_blocks or summary.retried else [
        f"{summary.store} is already finished; --overwrite recomputes it"
        + (" and --retry-failed what failed" if summary.failures and "retry_failed" in SESSION.flags
           else "")]
    return findings(
        [*notes, *again, line, f"xarray.open_zarr({json.dumps(summary.data, ensure_ascii=False)})",
         *summary.warnings],
        vars(summary) | numbers, int(summary.nothing_computed),
        then or summary.advice or f"sweep report {quoted(summary.store)}")


# --------------------------------------------------------------------------------------------------
# Errors as the user of a command reads them: lines that name flags, and an exit status.

MAX_LINE_LENGTH = 2000

#: Advice after an error of the system.
ADVICE = {
    errno.EMFILE: "allow more open files (ulimit -n)",
    errno.EAGAIN: "allow more processes (ulimit -u)",
    errno.ENOMEM: "free memory, or allow more (ulimit -v)",
    errno.ENOSPC: "free space on the disk",
    errno.EFBIG: "allow larger files (ulimit -f)",
}


#: Python's message in a RuntimeError where the system allows no more threads.
NO_THREAD = "can't start new thread"

#: Errors that occur while a command runs (exit status 1); others are those of a request (2).
FAILURES = (RunError, DamagedStoreError)


def print_error(error: SweepError) -> int:
    """Print an error's lines, without terminal control characters; return the exit status.

    An :class:`ArgumentError` names an argument of a Python function, such as ``time_limit_s``; the
    line names the flag that sets it, ``--time-limit``.
    """
    text = str(error)
    if isinstance(error, ArgumentError):
        given = f" {plain(error.value, 300)}" if str(error.value) else ""
        flag = SESSION.flags.get(error.argument, f"--{error.argument.replace('_', '-')}")
        text = f"{flag}{given}: {error.problem}"
    for line in text.split("\n"):
        print(plain(line, MAX_LINE_LENGTH), file=sys.stderr)
    return 1 if isinstance(error, FAILURES) else 2


def print_system_error(error: OSError | MemoryError | RuntimeError) -> int:
    """Print one line if the system refused something; any other RuntimeError is a defect."""
    if isinstance(error, MemoryError):
        line, number = ": ".join(filter(None, ["out of memory", str(error)])), errno.ENOMEM
    elif isinstance(error, OSError):
        cause = str(error.filename or "the system refused a request")
        line, number = f"{cause}: {error.strerror or error}", error.errno or 0
    elif str(error) == NO_THREAD:
        line, number = f"the system refused a request: {error}", errno.EAGAIN
    else:
        raise error
    advice = f"; {ADVICE[number]}" if number in ADVICE else ""
    print(plain(line + advice, MAX_LINE_LENGTH), file=sys.stderr)
    return 1
