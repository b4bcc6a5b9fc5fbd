"""The few errors that reach a user: each prints as lines that say what to change."""

from __future__ import annotations

from collections.abc import Sequence


class SweepError(Exception):
    """Something the user can mend; the message is one line a fault, and no traceback is shown."""


class PipelineError(SweepError):
    """A pipeline that cannot be run; it carries all its faults at once.

    Parameters
    ----------
    faults
        One line a fault, each naming file, key, value and what was expected.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = tuple(faults)

    def __reduce__(self) -> tuple[type[PipelineError], tuple[tuple[str, ...]]]:
        """Return how it is made anew in another process."""
        return PipelineError, (self.faults,)


class ArgumentError(SweepError, ValueError):
    """An argument of a function that cannot be; the commands name their flag in its place.

    Parameters
    ----------
    argument
        Python's name of the argument, such as ``time_limit_s``.
    value
        What was given.
    problem
        What is wrong, or what was expected instead: "expected seconds above 0".

    Examples
    --------
    >>> print(ArgumentError("workers", 0, "expected at least 1"))
    workers = 0: expected at least 1
    """

    def __init__(self, argument: str, value: object, problem: str) -> None:
        super().__init__(f"{argument} = {value}: {problem}")
        self.argument, self.value, self.problem = argument, value, problem

    def __reduce__(self) -> tuple[type[ArgumentError], tuple[str, object, str]]:
        """Return how it is made anew in another process."""
        return ArgumentError, (self.argument, self.value, self.problem)


class DatasetError(SweepError):
    """A dataset that lacks what an analysis needs, or two that do not fit together."""


class StoreError(SweepError):
    """A store that cannot be written, read or continued as asked."""


class StoreReplacedError(StoreError):
    """A store that is no longer where a run had it: another run's is there, or nothing."""


class RunError(SweepError):
    """A run that could not go on; what is finished stays in the store."""
