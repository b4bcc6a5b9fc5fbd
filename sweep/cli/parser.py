"""The parser of the command line, assembled from the commands' own declarations."""

from __future__ import annotations

import argparse
import itertools
import re
from functools import cache
from typing import Literal, NoReturn

from sweep.cli import commands  # noqa: F401  (it declares them)
from sweep.cli.command import DECLARED, Command, command, printing
from sweep.errors import SweepError
from sweep.messages import MAX_LINE_LENGTH, nearest, plain
from sweep.version import __version__

#: Arguments for which names of files and folders are offered.
FILES = ("OBSERVATIONS", "PIPELINE", "STORE", "STORE|PIPELINE", "SIMULATION", "FOLDER", "DIR",
         "FILE", "FIGURE", "PNG")


@command("help", "pipelines/README.md", {
    "sweep completion bash": "prints it for bash: source <(sweep completion bash)",
    "sweep completion fish": "prints it for fish: sweep completion fish | source"})
def completion(shell: Literal["bash", "zsh", "fish"]) -> int:
    """Print a script by which a shell completes commands and files.

    Parameters
    ----------
    shell : SHELL
        Bash, zsh or fish.
    """
    try:
        import shtab  # noqa: PLC0415
    except ImportError:
        raise SweepError("sweep completion needs shtab: pip install shtab") from None
    parser, every = build_parser()
    for added in every:
        for action in added._actions:  # noqa: SLF001  (argparse offers no other list)
            if action.metavar in FILES:
                action.complete = shtab.FILE  # type: ignore[attr-defined]
    with printing():
        print(shtab.complete(parser, shell))
    return 0


#: Every command, in the order in which the help lists them, by group.
COMMANDS = sorted(DECLARED.values(), key=lambda each: (
    "experiments", "answers", "your camera", "other programs", "help").index(each.group))

#: Title of the list that argparse makes of the commands.
UNGROUPED = "all commands"

#: What a flag expects, by the name of the function that reads it, which argparse tells.
EXPECTED = {"int": "a whole number", "float": "a number",
            "whole_numbers": "whole numbers between commas, such as 10,20"}

#: Pages for all commands: a first answer; questions and the command that answers each;
#: architecture, development and the glossary.
GUIDES = ("README.md", "pipelines/questions/README.md", "sweep/README.md")


class Parser(argparse.ArgumentParser):
    """A parser whose errors say what may be meant, and whose help has commands by group."""

    def format_help(self) -> str:
        """Return the help, without the list of all commands, which stands in groups below."""
        return re.sub(f"{UNGROUPED}:\n.*?\n\n", "", super().format_help(), flags=re.DOTALL)

    def error(self, message: str) -> NoReturn:
        """Print the usage and an error with a hint, and exit with status 2."""
        super().error(plain(message + _hint(message), MAX_LINE_LENGTH))

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """Exit once everything printed is written; OSError if it cannot be."""
        with printing():  # what argparse printed
            pass
        super().exit(status, message)


def _hint(message: str) -> str:
    """Return a hint at words similar to the ones that argparse refuses; empty without any."""
    if wrong := re.search(r"invalid (\w+) value: ", message):
        return f"; expected {EXPECTED[wrong[1]]}"
    if chosen := re.match(r"argument COMMAND: invalid choice: '([^']*)'", message):
        if chosen[1] == "help":
            return "; `sweep --help` and `sweep COMMAND --help` print the help"
        return nearest(chosen[1], [each.name for each in COMMANDS])
    if unknown := re.match(r"unrecognized arguments: (.*)", message):
        return "".join(dict.fromkeys(_meant(word) for word in unknown[1].split()))
    return ""


def _meant(word: str) -> str:
    if word.startswith("-"):
        flags = {name for added in build_parser()[1] for name in _flags(added).values()}
        name = word.partition("=")[0]
        return "" if name in flags else nearest(name, sorted(flags))
    if "=" in word:
        return f"; did you mean --set {word}?"
    return "; values are set by --set KEY=VALUE, in quotes if there are spaces in it"


@cache
def build_parser() -> tuple[Parser, list[argparse.ArgumentParser]]:
    """Return the parser of ``sweep``, and the commands' parsers.

    Parsed, ``command`` is the chosen :class:`Command`, or None.
    """
    groups = "".join(
        f"{group}:\n" + "".join(f"    {each.name:12} {each.summary}\n" for each in group_commands)
        for group, group_commands in itertools.groupby(COMMANDS, lambda each: each.group))
    parser = Parser(
        prog="sweep",
        description="How well will I know the pose? Experiments with fiducial markers.",
        epilog=f"{groups}\n`sweep COMMAND --help` explains a command, with examples.\n"
        "first run: sweep run --example smoke\n"
        f"which command answers which question: {GUIDES[1]}\n"
        f"guides: {GUIDES[0]}, {GUIDES[2]}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"sweep {__version__}")
    parser.set_defaults(command=None)
    every = parser.add_subparsers(metavar="COMMAND", title=UNGROUPED)
    for each in COMMANDS:
        added = every.add_parser(
            each.name, help=each.summary, description=each.description,
            epilog=_epilog(each), formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        each.add_arguments(added)
        added.set_defaults(command=each, flags=_flags(added))
    return parser, list(every.choices.values())


def _epilog(declared: Command) -> str:
    examples = "\n".join(
        f"  {line}\n      {meaning}" for line, meaning in declared.examples.items())
    return f"examples:\n{examples}\n\nguide: {declared.guide}"


def _flags(parser: argparse.ArgumentParser) -> dict[str, str]:
    """Return the name of each argument on the command line, by the Python argument that it sets."""
    return {
        action.dest: action.option_strings[-1] if action.option_strings else str(action.metavar)
        for action in parser._actions  # noqa: SLF001  (argparse offers no other list)
    }
