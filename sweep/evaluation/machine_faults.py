"""Exceptions that a scene's data cannot cause: faults of the machine, which are never results."""

from __future__ import annotations

import contextlib
import pickle
import sys
from collections.abc import Iterator
from typing import Any

from sweep.errors import MachineFaultError, SweepError, local_fault
from sweep.messages import exception_line

# --------------------------------------------------------------------------------------------------
# Exceptions that a scene's data cannot cause: faults of the machine, which are never results.
#
# Values that faulty hardware computes without an exception cannot be told from sound ones here;
# `sweep verify` finds those that its sample meets.

#: Types of exceptions that say nothing about a scene; Numba's errors are others.
MACHINE_FAULTS: tuple[type[Exception], ...] = (
    OSError, MemoryError, ImportError, EOFError, pickle.PickleError,
)


def machine_fault(error: BaseException) -> MachineFaultError | None:
    """Return the fault of this machine that an exception tells of, or None.

    An exception that was raised because of a machine's fault, or while one was handled, tells of
    it too.

    Examples
    --------
    >>> machine_fault(ValueError("singular matrix")) is None
    True
    >>> str(machine_fault(MemoryError())).endswith(": MemoryError")
    True
    """
    if isinstance(error, MachineFaultError):
        return error
    if isinstance(error, SweepError):
        return None  # it names the fault itself
    for cause in _chain(error):
        if isinstance(cause, MachineFaultError):
            return cause
        if _is_fault(cause):
            return local_fault(exception_line(cause))
    return None


def _chain(error: BaseException | None) -> list[BaseException]:
    """Return an exception, the one that it was raised because of or during, and so on."""
    chain: list[BaseException] = []
    while error is not None and error not in chain:
        chain.append(error)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return chain


def raise_machine_fault(error: BaseException) -> None:
    """Raise MachineFaultError if an exception tells of a fault of this machine."""
    fault = machine_fault(error)
    if fault is not None:
        raise fault from None  # it may be `error` itself, which must not become its own cause


@contextlib.contextmanager
def machine_faults_raised() -> Iterator[None]:
    """Raise MachineFaultError for exceptions of the body that tell of a fault of this machine."""
    try:
        yield
    except Exception as error:
        raise_machine_fault(error)
        raise


def _is_fault(error: BaseException) -> bool:
    if isinstance(error, MACHINE_FAULTS):
        return True
    # Who raised an error of these packages has imported them; they are slow to import.
    opencv: Any = sys.modules.get("cv2")
    numba: Any = sys.modules.get("numba.core.errors")
    if opencv is not None and isinstance(error, opencv.error):
        return bool(getattr(error, "code", None) == opencv.Error.StsNoMem)
    if numba is not None and isinstance(error, numba.NumbaError):
        return True
    return isinstance(error, RuntimeError) and "can't start new thread" in str(error)
