"""Child processes that may crash or hang: started, watched, interrupted."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, Pipe
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from sweep.errors import SweepError
from sweep.evaluation.machine_faults import machine_fault

# --------------------------------------------------------------------------------------------------
# Child processes: how many, on one thread each, and how they ended.

#: Variables of a child process. Parallelism is over blocks: a process computes on one thread.
SINGLE_THREADED = dict.fromkeys((
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")

#: Signals that the system or its users send, too little memory or space among their reasons: what a
#: scene's data may cause is SIGSEGV, SIGABRT, SIGFPE, SIGILL, an exit status.
OUTSIDE_SIGNALS = ("SIGKILL", "SIGTERM", "SIGBUS", "SIGHUP", "SIGINT", "SIGXCPU")

ADVICE = "use fewer workers, or give them more memory"


def default_workers() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


# --------------------------------------------------------------------------------------------------
# Function calls in a child process, which may crash or never return.
#
# The two are connected by a pair of sockets. Only what these two processes of one program send each
# other is unpickled.

#: How long after its limit a child that did not end itself is killed: it may start slowly, and
#: compile, while the limit stands still.
GRACE_S = 600.0

#: How often a child looks whether its caller still lives.
PARENT_S = 1.0


class ChildError(Exception):
    """A call in a child process has no result: it raised (the message is the traceback), or died.

    Attributes
    ----------
    from_outside
        Whether no scene's data can have ended the process: a signal of the system did, or the
        call had not begun.
    timed_out
        Whether it ended because its time limit ran out.
    """

    from_outside = timed_out = False

    @property
    def line(self) -> str:
        """The last line of the traceback, or how the process ended."""
        return str(self).strip().splitlines()[-1]


class ChildDiedError(ChildError):
    """A child process ended during a call.

    Parameters
    ----------
    how
        How it ended: "SIGSEGV", "exit status 3", "time limit of 5 s".
    begun
        Whether the child had what the call needs: its packages, the arguments.
    timed_out
        Whether it ended because its time limit ran out.
    """

    def __init__(self, how: str, *, begun: bool = True, timed_out: bool = False) -> None:
        memory = f", as where memory runs out: {ADVICE}" if how == "SIGKILL" else ""
        super().__init__(f"its process ended: {how}{memory}")
        self.from_outside, self.timed_out = not begun or how in OUTSIDE_SIGNALS, timed_out


Result = TypeVar("Result")


class Child(contextlib.AbstractContextManager["Child"]):
    """A child process that calls functions, one at a time; another one after it ended.

    Parameters
    ----------
    module
        Imported by the child while it waits for the first call; its ``warm_up()`` is called. By
        default the one that computes scenes and blocks, which most calls need.

    Examples
    --------
    >>> with Child() as child:
    ...     child.call(pow, 2, 10, limit_s=60)
    1024
    """

    def __init__(self, module: str = "sweep.execution.block_task") -> None:
        self._module = module
        self._closing = threading.Lock()
        self._start()

    def _start(self) -> None:
        self._connection, theirs = Pipe()
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603  (this program)
                [sys.executable, "-P", "-c", _START, json.dumps(sys.path), self._module,
                 str(theirs.fileno())],
                # Nobody reads the output of libraries.
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()], env={**os.environ, **SINGLE_THREADED},
                start_new_session=True,  # a terminal's Ctrl-C is the caller's to act on
            )

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(
        self, function: Callable[..., Result], *arguments: Any, limit_s: float
    ) -> Result:
        """Call a function of a module in the child and return its result.

        Parameters
        ----------
        function, *arguments
            The call; it is pickled, so a function of a module.
        limit_s
            Time limit in seconds; it stands still while code is compiled.

        Raises
        ------
        ChildDiedError
            If the child crashed, or the call took longer than ``limit_s`` seconds.
        ChildError
            If the call raised, with the traceback; a `SweepError` is raised as it is, and a fault
            of the machine as `MachineFaultError`.
        """
        if self._connection.closed:
            self._start()
        started, begun = time.monotonic(), False
        # It bounds sending, too: a child that hangs while it imports reads nothing.
        last = threading.Timer(limit_s + GRACE_S, self._process.kill)
        last.start()
        try:
            self._connection.send((function, arguments, limit_s))
            while (answer := self._connection.recv()) is None:
                begun = True
        except (EOFError, OSError, pickle.UnpicklingError):
            took_s, code = time.monotonic() - started, self._process.wait()
            self.close()
            # The child ends itself with status 1 (`watchdog.ending_after`).
            timed_out = took_s >= limit_s + (0.0 if code == 1 else GRACE_S)
            how = f"time limit of {limit_s:.3g} s" if timed_out else (
                f"exit status {code}" if code >= 0 else signal.Signals(-code).name)
            raise ChildDiedError(how, begun=begun, timed_out=timed_out) from None
        finally:
            last.cancel()
            last.join()
        raised, result = answer
        if raised:
            raise result if isinstance(result, SweepError) else ChildError(result)
        return cast("Result", result)

    def close(self) -> None:
        """End the child. An interrupt closes it while another thread, whose call ends, does."""
        with self._closing:
            self._process.kill()
            self._process.wait()
            self._connection.close()


_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from sweep.isolation.child_process import serve; serve(*sys.argv[2:])"
)


def serve(module: str, descriptor: str) -> None:
    """Import a module, then answer calls until the caller has closed; what the child runs."""
    end_with(os.getppid())
    connection: Connection[Any, Any] = Connection(int(descriptor))
    os.set_inheritable(connection.fileno(), False)
    with contextlib.suppress(OSError):  # it is killed before others if memory runs out
        Path("/proc/self/oom_score_adj").write_text("1000")
    # It has a session of its own: whoever interrupts, the caller ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Code is compiled while the caller prepares; an error is raised by the call that needs it.
    with contextlib.suppress(Exception):
        importlib.import_module(module).warm_up()
    # Numba is slow to import, and the caller needs none of it.
    from sweep.isolation.watchdog import ending_after  # noqa: PLC0415

    with contextlib.suppress(EOFError):
        while request := connection.recv_bytes():
            try:
                function, arguments, limit_s = pickle.loads(request)  # noqa: S301  (the parent's)
                connection.send(None)
                with ending_after(limit_s):
                    answer = (False, function(*arguments))
            except Exception as error:
                told = error if isinstance(error, SweepError) else machine_fault(error)
                answer = (True, told or traceback.format_exc())
            connection.send(answer)


def end_with(parent: int) -> None:
    """Watch for the end of this process' parent, of this ID, and end then, whatever is computed."""
    threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: int) -> None:
    """End this process when its parent has ended, whatever it computes."""
    while os.getppid() == parent:
        time.sleep(PARENT_S)
    os._exit(1)


# --------------------------------------------------------------------------------------------------
# Ctrl-C that stops a run between two steps, never in the middle of one.

#: How often Ctrl-C is checked while a result is awaited.
POLL_S = 0.2


class Interrupts:
    """While this context is entered, Ctrl-C is noted, and raised by :meth:`check`.

    KeyboardInterrupt inside a client's code can leave one of its locks taken, and the process then
    hangs while it closes the cluster. The second Ctrl-C is raised at once.

    The caller's handler is restored at the end. Nothing is done outside the main thread, where no
    signals arrive, and if the caller ignores Ctrl-C or handles it outside Python.
    """

    def __init__(self) -> None:
        self._noted = False
        self._before: Any = None

    def __enter__(self) -> Self:
        main = threading.current_thread() is threading.main_thread()
        if main and signal.getsignal(signal.SIGINT) not in (None, signal.SIG_IGN):
            self._before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _note(self, *_: object) -> None:
        if self._noted:
            raise KeyboardInterrupt
        self._noted = True

    def check(self) -> None:
        """Raise KeyboardInterrupt if Ctrl-C has been noted."""
        if self._noted:
            raise KeyboardInterrupt
