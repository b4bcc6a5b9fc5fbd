"""The parser of the command line, assembled from the commands' own declarations."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import NoReturn

from sweep.cli.answers import (
    calibration,
    compare,
    error_model,
    limit,
    reference,
    report,
    require,
    size,
    tradeoff,
)
from sweep.cli.command import Command, argument, command, flushed
from sweep.cli.experiments import plan, repro, run, show, status, verify
from sweep.cli.programs import diagnose, export, fit, photos, plugins, score
from sweep.errors import MissingPackageError
from sweep.messages import MAX_LINE_LENGTH, nearest, plain
from sweep.version import __version__

# --------------------------------------------------------------------------------------------------
# ``sweep completion``: a script by which a shell completes commands, options and files.

SHELLS = ("bash", "zsh", "fish")

FILES = ("OBSERVATIONS", "PIPELINE", "STORE", "STORE|PIPELINE", "SIMULATION", "FOLDER", "DIR",
         "FILE", "FIGURE", "PNG")
"""Arguments for which names of files and folders are offered."""


@command(
    "pipelines/README.md", {
        "sweep completion bash": "prints it for bash: source <(sweep completion bash)",
        "sweep completion fish": "prints it for fish: sweep completion fish | source"},
    argument("shell", metavar="SHELL", choices=SHELLS, help="bash, zsh or fish"))
def completion(options: argparse.Namespace) -> int:
    """Print a script by which a shell completes commands and files."""
    try:
        import shtab  # noqa: PLC0415
    except ImportError:
        raise MissingPackageError("sweep completion needs shtab: pip install shtab") from None
    parser, commands = build_parser()
    for added in commands:
        for action in added._actions:  # noqa: SLF001  (argparse offers no other list)
            if action.metavar in FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    print(shtab.complete(parser, options.shell))
    return 0


# --------------------------------------------------------------------------------------------------
# The parser of the command line, assembled from the commands' own declarations.

COMMANDS = (
    run, plan, size, limit, show, repro, tradeoff, report, require, error_model, calibration,
    verify, status, export, score, photos, fit, diagnose, compare, plugins, reference, completion,
)
"""Every command, in the order in which the help lists them."""

REMOVED = {
    "check-detector": "`sweep plugins check NAME` tries a detector or a solver",
    "environments": "to compare versions of OpenCV, run `sweep run` in each virtual environment, "
    "then `sweep compare A.zarr B.zarr`",
}
"""Commands of earlier versions -> what to do instead."""

REMOVED_FLAGS = {
    "--durable": "blocks are written whole; what a power failure takes, "
    "`sweep verify STORE --repair` computes again",
}
"""Flags of earlier versions -> what does their work."""

INVALID_COMMAND = re.compile(r"argument COMMAND: invalid choice: '([^']*)'")
"""Beginning of argparse's message for a command that does not exist."""

GUIDES = ("README.md", "sweep/README.md")
"""Pages for all commands: a first answer; architecture, development and the glossary."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors say what may be meant."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and an error with a hint, and exit with status 2.

        A command or flag of earlier versions gives one line that says what to do instead.
        """
        chosen = INVALID_COMMAND.match(message)
        if chosen is not None and chosen[1] in REMOVED:
            self.exit(2, f"sweep {chosen[1]} is no longer a command; {REMOVED[chosen[1]]}\n")
        for word in message.removeprefix("unrecognized arguments: ").split():
            if word in REMOVED_FLAGS:
                self.exit(2, f"{word} is no longer a flag; {REMOVED_FLAGS[word]}\n")
        super().error(plain(message + _hint(message), MAX_LINE_LENGTH))


def _hint(message: str) -> str:
    """Return what may be meant in place of what argparse refuses; empty if nothing is similar."""
    if chosen := INVALID_COMMAND.match(message):
        if chosen[1] == "help":
            return "; `sweep --help` and `sweep COMMAND --help` print the help"
        return nearest(chosen[1], [each.name for each in COMMANDS])
    if unknown := re.match(r"unrecognized arguments: (.*)", message):
        return "".join(dict.fromkeys(_meant(word) for word in unknown[1].split()))
    return ""


def _meant(word: str) -> str:
    if word in ("--dry-run", "--dryrun", "-n"):
        return "; `sweep plan PIPELINE` shows what would run"
    if word.startswith("-"):
        name, flags = word.partition("=")[0], set[str]()
        for each in COMMANDS:
            parser = argparse.ArgumentParser(add_help=False)
            each.add_arguments(parser)
            flags.update(_flags(parser).values())
        return "" if name in flags else nearest(name, sorted(flags))
    if "=" in word:
        return f"; did you mean --set {word}?"
    return "; values are set by --set KEY=VALUE, in quotes if there are spaces in it"


def build_parser() -> tuple[argparse.ArgumentParser, list[argparse.ArgumentParser]]:
    """Return the parser of ``sweep``, and those of the commands.

    Parsed, ``command`` is the chosen :class:`Command`, or None.
    """
    parser = Parser(
        prog="sweep",
        description="How well will I know the pose? Experiments with fiducial markers.",
        epilog="`sweep COMMAND --help` explains a command, with examples.\n"
        f"guides: {', '.join(GUIDES)}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sweep {__version__}")
    parser.set_defaults(command=None)
    commands = parser.add_subparsers(metavar="COMMAND")
    for each in COMMANDS:
        added = commands.add_parser(
            each.name, help=each.summary, description=each.execute.__doc__,
            epilog=_epilog(each), formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        each.add_arguments(added)
        added.set_defaults(command=each, flags=_flags(added))
    return parser, list(commands.choices.values())


def parse(
    parser: argparse.ArgumentParser, arguments: Sequence[str] | None
) -> argparse.Namespace:
    """Return the parsed arguments.

    Raises
    ------
    SystemExit
        After the help, the version, or an error was printed.
    OSError
        If it could not be printed.
    """
    try:
        return parser.parse_args(arguments)
    except SystemExit:
        flushed(0)
        raise


def _epilog(declared: Command) -> str:
    examples = "\n".join(
        f"  {example.line}\n      {example.meaning}" for example in declared.examples
    )
    return f"examples:\n{examples}\n\nguide: {declared.guide}"


def _flags(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return the name of each argument on the command line, by the Python argument that it sets."""
    return {
        action.dest: action.option_strings[-1] if action.option_strings else str(action.metavar)
        for action in parser._actions  # noqa: SLF001  (argparse offers no other list)
    }
