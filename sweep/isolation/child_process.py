"""Functions called in a child process, which may die of them.

The child reads calls from its standard input and writes results to its standard output. Nothing
else is unpickled than what these two processes of one program tell each other.
"""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import signal
import struct
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, Self

from sweep.errors import SweepError
from sweep.isolation.watchdog import ending_after

SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
}
"""Parallelism is over blocks: a process computes on one thread."""

GRACE_S = 30.0
"""How long after its limit a child that does not even end itself is killed."""

_LENGTH = struct.Struct("<Q")


class DiedError(Exception):
    """A child process ended; the message says how: "SIGSEGV", "time limit of 5 s"."""


class RaisedError(Exception):
    """A call raised in the child; the message is the traceback."""


class Child:
    """A child process that calls functions, one at a time."""

    def __init__(self) -> None:
        self._given_up = False
        self._process = subprocess.Popen(  # noqa: S603  (this program)
            [sys.executable, "-P", "-c", _START, json.dumps(sys.path)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            env={**os.environ, **SINGLE_THREADED},
            start_new_session=True,  # a terminal's Ctrl-C is the caller's to act on
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def call(self, function: Callable[..., Any], *arguments: Any, limit_s: float) -> Any:
        """Call a function of a module there and return what it returns.

        Raises
        ------
        DiedError
            Where the child died of it, or it took longer than ``limit_s`` seconds.
        RaisedError
            Where it raised; the errors that reach a user are raised as they are.
        """
        started = time.monotonic()
        stuck = threading.Timer(limit_s + GRACE_S, self._give_up)
        stuck.daemon = True
        stuck.start()
        try:
            _send(self._process.stdin, (function, arguments, limit_s))
            raised, result = _receive(self._process.stdout)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise DiedError(self._end(time.monotonic() - started, limit_s)) from None
        finally:
            stuck.cancel()
        if raised:
            raise result if isinstance(result, SweepError) else RaisedError(result)
        return result

    def _give_up(self) -> None:
        self._given_up = True
        self._process.kill()

    def _end(self, took_s: float, limit_s: float) -> str:
        code = self._process.wait()
        self.close()
        if self._given_up or (code == 1 and took_s >= limit_s):
            return f"time limit of {limit_s:.3g} s"
        if code < 0:
            with contextlib.suppress(ValueError):
                return signal.Signals(-code).name
        return f"exit status {code}"

    def close(self) -> None:
        """End the child."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()


_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from sweep.isolation.child_process import serve; serve()"
)


def serve() -> None:
    """Answer calls until the caller is gone."""
    # What libraries print must not get among the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # Where memory runs out, this process is the one to go.
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    while True:
        try:
            function, arguments, limit_s = _receive(sys.stdin.buffer)
        except EOFError:
            return
        answer: tuple[bool, Any]
        try:
            with ending_after(limit_s):
                answer = (False, function(*arguments))
        except SweepError as error:
            answer = (True, error)
        except Exception:
            answer = (True, traceback.format_exc())
        _send(answers, answer)


def _send(pipe: IO[bytes] | None, content: Any) -> None:
    encoded = pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL)
    if pipe is None:
        raise EOFError
    pipe.write(_LENGTH.pack(len(encoded)))
    pipe.write(encoded)
    pipe.flush()


def _receive(pipe: IO[bytes] | None) -> Any:
    if pipe is None:
        raise EOFError
    header = pipe.read(_LENGTH.size)
    if len(header) < _LENGTH.size:
        raise EOFError
    (length,) = _LENGTH.unpack(header)
    encoded = pipe.read(length)
    if len(encoded) < length:
        raise EOFError
    return pickle.loads(encoded)  # noqa: S301  (from this program's own child or parent)
