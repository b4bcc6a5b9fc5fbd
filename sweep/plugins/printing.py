"""What plug-ins print goes to the standard error: the standard output is that of the command."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def printing_to_stderr() -> Iterator[None]:
    """Turn the standard output of the process into its standard error, also for compiled code.

    It holds for all threads, so it is not for every call: Python's own prints are redirected there
    (:func:`sweep.plugins.calls.call`).
    """
    with contextlib.redirect_stdout(sys.stderr):
        try:
            kept = os.dup(1)
        except OSError:  # there is none
            yield
            return
        try:
            with contextlib.suppress(OSError, ValueError, AttributeError):
                if sys.__stdout__ is not None:
                    sys.__stdout__.flush()
            with contextlib.suppress(OSError):
                os.dup2(2, 1)
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)
