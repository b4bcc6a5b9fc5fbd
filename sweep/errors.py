"""The errors that reach a user: their messages say in lines what to change."""

from __future__ import annotations

from collections.abc import Sequence


class SweepError(Exception):
    """An error that the user can correct: one line a fault, shown without a traceback."""


class PipelineError(SweepError):
    """A pipeline that is not valid; the error has all faults at once.

    Parameters
    ----------
    faults
        One line a fault, each naming file, key, value and what was expected.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        super().__init__("\n".join(faults))
        self.faults = tuple(faults)

    def __reduce__(self) -> tuple[type[PipelineError], tuple[tuple[str, ...]]]:
        """Return how to make it again in another process."""
        return PipelineError, (self.faults,)


class ArgumentError(SweepError, ValueError):
    """An argument that is not valid; it is a ValueError, too. The commands name their flag instead.

    Parameters
    ----------
    argument
        Python's name of the argument, such as ``time_limit_s``.
    value
        The given value.
    problem
        The fault, or the expectation: "expected seconds above 0".

    Examples
    --------
    >>> print(ArgumentError("workers", 0, "expected at least 1"))
    workers = 0: expected at least 1
    """

    def __init__(self, argument: str, value: object, problem: str) -> None:
        given = f" = {value}" if str(value) else ""
        super().__init__(f"{argument}{given}: {problem}")
        self.argument, self.value, self.problem = argument, value, problem

    def __reduce__(self) -> tuple[type[ArgumentError], tuple[str, object, str]]:
        """Return how to make it again in another process."""
        return ArgumentError, (self.argument, self.value, self.problem)


class MissingPackageError(SweepError):
    """An optional package that was asked for is not installed."""


class StoreError(SweepError):
    """A store that cannot be written, read or continued as asked."""


class DatasetError(StoreError):
    """A dataset that lacks what an analysis needs, or two that do not fit together.

    It is a StoreError because analyses raised that in 0.5: deprecated since 0.6.
    """


class OtherExperimentError(StoreError):
    """A store that holds another experiment than the one that is to be run into it.

    Parameters
    ----------
    url
        The store.
    differences
        One line for each difference.
    reusable
        Whether a run into another store could reuse its cells.
    """

    def __init__(self, url: str, differences: Sequence[str], reusable: bool) -> None:
        advice = (
            "its cells can be reused: give another store, and this one as reuse"
            if reusable else "choose another store, or overwrite it"
        )
        super().__init__(
            "\n".join([
                f"{url}: holds another experiment; {advice}", *(f"  {d}" for d in differences)
            ])
        )
        self.url, self.differences, self.reusable = url, tuple(differences), reusable

    def __reduce__(self) -> tuple[type[OtherExperimentError], tuple[str, tuple[str, ...], bool]]:
        """Return how to make it again in another process."""
        return OtherExperimentError, (self.url, self.differences, self.reusable)


class StoreReplacedError(StoreError):
    """A store that was moved, deleted or replaced by another run's while a run wrote it."""


class RunError(SweepError):
    """A run that failed; finished blocks stay in the store, and another run continues."""


class MachineFaultError(RunError):
    """A fault of a machine, which no scene's data can cause: it is not a result of the scene.

    Parameters
    ----------
    fault
        One line: "OSError: [Errno 28] No space left on device".
    machine
        The name of the machine.
    """

    def __init__(self, fault: str, machine: str) -> None:
        super().__init__(f"machine fault on {machine}: {fault}")
        self.fault, self.machine = fault, machine

    def __reduce__(self) -> tuple[type[MachineFaultError], tuple[str, str]]:
        """Return how to make it again in another process."""
        return MachineFaultError, (self.fault, self.machine)


class PluginError(SweepError):
    """A plug-in that cannot be used, or that returned what it must not; one line."""
