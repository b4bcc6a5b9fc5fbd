"""The parser of the command line, assembled from the commands' own declarations."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from sweep.cli.command import Command
from sweep.cli.output import flushed
from sweep.cli.plan import PLAN
from sweep.cli.report import REPORT
from sweep.cli.repro import REPRO
from sweep.cli.run import RUN
from sweep.cli.show import SHOW
from sweep.cli.status import STATUS
from sweep.cli.tradeoff import TRADEOFF
from sweep.cli.verify import VERIFY
from sweep.version import __version__

COMMANDS = (RUN, PLAN, SHOW, REPRO, TRADEOFF, REPORT, VERIFY, STATUS)
"""Every command, in the order in which the help lists them."""

GUIDES = ("README.md", "sweep/README.md")
"""Pages for all commands: a first answer; architecture, development and the glossary."""


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of ``sweep``; ``command`` is the chosen :class:`Command`, or None."""
    parser = argparse.ArgumentParser(
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
