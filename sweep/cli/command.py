"""What a command declares: its name, its help, its arguments, and the function that runs it."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass

CONTINUES = "stopped; the same command continues"
"""Told after Ctrl-C where it does; a command sets ``options.stopped`` to it."""


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
    add_arguments
        Declares its arguments. The ``dest`` of each is the name of the Python function's argument
        that it sets, so that an :class:`~sweep.errors.ArgumentError` can be reported by its flag.
    execute
        Runs it; returns the exit status.
    """

    name: str
    summary: str
    guide: str
    examples: tuple[Example, Example]
    add_arguments: Callable[[argparse.ArgumentParser], None]
    execute: Callable[[argparse.Namespace], int]
