"""The parser of the command line, assembled from the commands' own declarations."""

from __future__ import annotations

import argparse
import re
from collections.abc import Sequence
from typing import NoReturn

from sweep.cli.calibration import CALIBRATION
from sweep.cli.check_detector import CHECK_DETECTOR
from sweep.cli.command import Command
from sweep.cli.compare import COMPARE
from sweep.cli.completion import COMPLETION
from sweep.cli.environments import ENVIRONMENTS
from sweep.cli.error_model import ERROR_MODEL
from sweep.cli.export import EXPORT
from sweep.cli.fit import FIT
from sweep.cli.limit import LIMIT
from sweep.cli.output import flushed
from sweep.cli.photos import PHOTOS
from sweep.cli.plan import PLAN
from sweep.cli.plugins import PLUGINS
from sweep.cli.report import REPORT
from sweep.cli.repro import REPRO
from sweep.cli.require import REQUIRE
from sweep.cli.run import RUN
from sweep.cli.score import SCORE
from sweep.cli.show import SHOW
from sweep.cli.size import SIZE
from sweep.cli.status import STATUS
from sweep.cli.tradeoff import TRADEOFF
from sweep.cli.verify import VERIFY
from sweep.messages import nearest
from sweep.version import __version__

COMMANDS = (
    RUN, PLAN, SIZE, LIMIT, SHOW, REPRO, TRADEOFF, REPORT, REQUIRE, ERROR_MODEL, CALIBRATION,
    VERIFY, STATUS, EXPORT, SCORE, PHOTOS, FIT, COMPARE, CHECK_DETECTOR, PLUGINS, ENVIRONMENTS,
    COMPLETION,
)
"""Every command, in the order in which the help lists them."""

GUIDES = ("README.md", "sweep/README.md")
"""Pages for all commands: a first answer; architecture, development and the glossary."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors say what may be meant."""

    def error(self, message: str) -> NoReturn:
        """Print the usage and an error with a hint, and exit with status 2."""
        super().error(message + _hint(message))


def _hint(message: str) -> str:
    """Return what may be meant in place of what argparse refuses; empty if nothing is similar."""
    if chosen := re.match(r"argument COMMAND: invalid choice: '([^']*)'", message):
        if chosen[1] == "help":
            return "; `sweep --help` and `sweep COMMAND --help` print the help"
        return nearest(chosen[1], [command.name for command in COMMANDS])
    if unknown := re.match(r"unrecognized arguments: (.*)", message):
        return "".join(dict.fromkeys(_meant(word) for word in unknown[1].split()))
    return ""


def _meant(word: str) -> str:
    if word in ("--dry-run", "--dryrun", "-n"):
        return "; `sweep plan PIPELINE` shows what would run"
    if word.startswith("-"):
        options = {command.name: _options(command) for command in COMMANDS}
        flags = {flag: [name for name, listed in options.items() if flag in listed]
                 for each in options.values() for flag in each if flag.startswith("--")}
        name = word.partition("=")[0]
        if name in flags:
            return f"; {name} is a flag of {', '.join(f'sweep {each}' for each in flags[name])}"
        return nearest(name, sorted(flags))
    if "=" in word:
        return f"; did you mean --set {word}?"
    return "; values are set by --set KEY=VALUE, in quotes if there are spaces in it"


def _options(command: Command) -> list[str]:
    """Return the option strings of a command."""
    parser = argparse.ArgumentParser(add_help=False)
    command.add_arguments(parser)
    return list(parser._option_string_actions)  # noqa: SLF001  (argparse offers no other list)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of ``sweep``; ``command`` is the chosen :class:`Command`, or None."""
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
    for command in COMMANDS:
        added = commands.add_parser(
            command.name, help=command.summary, description=_sentence(command.summary),
            epilog=_epilog(command), formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.add_arguments(added)
        added.set_defaults(command=command, flags=_flags(added))
    return parser


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


def _sentence(summary: str) -> str:
    return f"{summary[0].upper()}{summary[1:]}."


def _epilog(command: Command) -> str:
    examples = "\n".join(
        f"  {example.line}\n      {example.meaning}" for example in command.examples
    )
    return f"examples:\n{examples}\n\nguide: {command.guide}"


def _flags(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return the name of each argument on the command line, by the Python argument that it sets."""
    return {
        action.dest: action.option_strings[-1] if action.option_strings else str(action.metavar)
        for action in parser._actions  # noqa: SLF001  (argparse offers no other list)
    }
