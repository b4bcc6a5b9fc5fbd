"""A process of another Python that searches images with that Python's OpenCV."""

from __future__ import annotations

import atexit
import contextlib
import json
import mmap
import os
import signal
import struct
import subprocess
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sweep.errors import EnvironmentFaultError
from sweep.messages import plain
from sweep.processes import SINGLE_THREADED, ending

SCRIPT = Path(__file__).with_name("child.py")

START_S = 60.0
"""How long another Python may take to import NumPy and OpenCV."""

MAX_ANSWER_BYTES = 1 << 31
"""What is longer is no answer of ours: what was started is another program."""

NOT_INHERITED = ("PYTHONHOME", "PYTHONPATH", "PYTHONINSPECT", "__PYVENV_LAUNCHER__")
"""Variables that would give another Python this one's modules."""

_LENGTH = struct.Struct("<Q")

_SHARED_START_BYTES = 1 << 20


class DetectorProcessError(Exception):
    """The process ended during a search; the message says how."""


class SearchDefinition(NamedTuple):
    """What is searched for, and how: a dictionary, and fields of ``DetectorParameters``."""

    dictionary: str
    parameters: tuple[tuple[str, Any], ...]


class Answer(NamedTuple):
    """What a search of one image gave.

    Attributes
    ----------
    corners, rejected
        (n, 4, 2) and (m, 4, 2) float32 px, of the decoded and of the rejected quadrilaterals.
    ids
        (n,) int32.
    seconds
        What the search took there.
    error
        How it raised; empty if it did not.
    of_the_machine
        Whether no image can have caused the error, but too little memory or a signal.
    died
        Whether it ended the process.
    """

    corners: NDArray[np.float32]
    ids: NDArray[np.int32]
    rejected: NDArray[np.float32]
    seconds: float
    error: str = ""
    of_the_machine: bool = False
    died: bool = False

    @classmethod
    def without(cls, error: str, *, of_the_machine: bool, died: bool) -> Answer:
        """Return the answer of a search that gave nothing but an error."""
        empty = np.empty((0, 4, 2), np.float32)
        return cls(empty, np.empty(0, np.int32), empty, 0.0, error, of_the_machine, died)


class DetectorProcess:
    """A process of another Python, which ends with this one.

    Parameters
    ----------
    python
        The interpreter.

    Attributes
    ----------
    identity
        What it said of itself: versions, builds, fields, dictionaries.

    Raises
    ------
    EnvironmentFaultError
        If it cannot be started, is no Python, or lacks NumPy or an OpenCV with ArUco; in one line.
    """

    def __init__(self, python: str) -> None:
        self.python = python
        self._numbers: dict[SearchDefinition, int] = {}
        self._lock = threading.Lock()
        self._shared = _shared_file()
        self._size = 0
        with tempfile.TemporaryFile() as errors:
            try:
                self._process = subprocess.Popen(  # noqa: S603  (the Python that was asked for)
                    [python, str(SCRIPT), str(self._shared)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
                    pass_fds=[self._shared], env=_variables(),
                    start_new_session=True,  # a terminal's Ctrl-C is this process's to act on
                )
            except (OSError, ValueError) as error:
                os.close(self._shared)
                reason = getattr(error, "strerror", None) or error
                raise EnvironmentFaultError(f"cannot be started: {reason}") from None
            atexit.register(self.close)
            try:
                self.identity = self._greeting(errors)
                self._grow(_SHARED_START_BYTES)
            except BaseException:
                self.close()
                raise

    def search(
        self, images: Sequence[NDArray[np.uint8]], definitions: Sequence[SearchDefinition]
    ) -> list[Answer]:
        """Search images, each by its own definition.

        Raises
        ------
        DetectorProcessError
            If the process ended.
        """
        with self._lock:
            new = {
                each: len(self._numbers) + k
                for k, each in enumerate(dict.fromkeys(
                    each for each in definitions if each not in self._numbers))
            }
            self._numbers.update(new)
            starts = np.cumsum([0, *(image.size for image in images)]).tolist()
            if starts[-1] > self._size:
                self._grow(max(starts[-1], 2 * self._size))
            pixels = np.frombuffer(self._map, np.uint8)
            rows = []
            for image, definition, start in zip(images, definitions, starts, strict=False):
                height, width = image.shape
                pixels[start : start + image.size].reshape(height, width)[:] = image
                rows.append((self._numbers[definition], height, width, start))
            del pixels
            request = {"size": self._size, "images": rows, "new": {
                number: {"dictionary": each.dictionary, "parameters": dict(each.parameters)}
                for each, number in new.items()
            }}
            try:
                self._send(request)
                return self._answers(self._receive())
            except (EOFError, OSError, ValueError):
                raise DetectorProcessError(self._death()) from None

    @property
    def process_id(self) -> int:
        """The number by which the system knows it."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Whether it cannot be asked any more."""
        return self._process.poll() is not None

    def close(self) -> None:
        """End the process; again is allowed."""
        atexit.unregister(self.close)
        self._kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        if self._shared >= 0:
            os.close(self._shared)
            self._shared = -1

    def _kill(self) -> None:
        """End the process and those that it has started."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def _grow(self, size: int) -> None:
        """Make the file that both processes map at least ``size`` bytes long."""
        os.ftruncate(self._shared, size)
        self._map = mmap.mmap(self._shared, size)
        self._size = size

    def _greeting(self, errors: IO[bytes]) -> Mapping[str, Any]:
        """Return what the process says of itself, or raise why it cannot be used."""
        killer = threading.Timer(START_S, self._kill)
        killer.daemon = True
        killer.start()
        try:
            identity = self._receive()
            if not isinstance(identity, dict) or "python" not in identity:
                raise ValueError
        except (EOFError, OSError, ValueError):
            late = not killer.is_alive()
            self._kill()
            code = self._process.wait()
            errors.seek(0)
            lines = errors.read(1 << 16).decode(errors="replace").strip().splitlines()
            said = plain(lines[-1]) if lines else (
                f"it says nothing within {START_S:g} s" if late else ending(code)
            )
            raise EnvironmentFaultError(f"is no Python from 3.8 on that works: {said}") from None
        finally:
            killer.cancel()
        if "fault" in identity:
            raise EnvironmentFaultError(plain(str(identity["fault"])))
        return identity

    def _send(self, message: Mapping[str, Any]) -> None:
        encoded = json.dumps(message).encode()
        pipe = self._process.stdin
        if pipe is None:
            raise EOFError
        pipe.write(_LENGTH.pack(len(encoded)) + encoded)
        pipe.flush()

    def _receive(self) -> Any:
        (length,) = _LENGTH.unpack(self._read(_LENGTH.size))
        if length > MAX_ANSWER_BYTES:
            raise ValueError(length)
        return json.loads(self._read(length))

    def _read(self, count: int) -> bytes:
        pipe = self._process.stdout
        content = b"" if pipe is None else pipe.read(count)
        if len(content) < count:
            raise EOFError
        return content

    def _answers(self, header: Mapping[str, Any]) -> list[Answer]:
        counts, errors = header["counts"], header["errors"]
        quads = sum(found + rejected for found, rejected, _ in counts)
        ids_count = sum(found for found, _, _ in counts)
        corners = np.frombuffer(self._read(32 * quads), np.float32).reshape(quads, 4, 2)
        ids = np.frombuffer(self._read(4 * ids_count), np.int32)
        answers, quad, marker = [], 0, 0
        for index, (found, rejected, seconds) in enumerate(counts):
            error, of_the_machine = errors.get(str(index), ("", False))
            answers.append(Answer(
                corners[quad : quad + found], ids[marker : marker + found],
                corners[quad + found : quad + found + rejected], seconds, error, of_the_machine,
            ))
            quad, marker = quad + found + rejected, marker + found
        return answers

    def _death(self) -> str:
        """Return how the process ended; wait until it did."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        code = self._process.poll()
        self.close()
        return "it sent what is no answer" if code is None else ending(code)


def _variables() -> dict[str, str]:
    return {
        **{name: value for name, value in os.environ.items() if name not in NOT_INHERITED},
        **SINGLE_THREADED,
    }


def _shared_file() -> int:
    """Return the descriptor of a file that both processes map: in memory where Linux has it."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("sweep-images")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
