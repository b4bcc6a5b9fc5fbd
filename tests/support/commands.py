"""Commands in processes of their own, which leave no process behind."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

INSTANTS = Path(__file__).parent / "poisoned" / "instants.py"


@contextlib.contextmanager
def started(arguments, **options):
    """Start a command of Python as a group of its own; end the whole group afterwards."""
    with subprocess.Popen(
        [sys.executable, *map(str, arguments)], start_new_session=True, **options
    ) as process:
        try:
            yield process
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def command(*arguments, timeout=300, **options):
    """Run ``sweep`` with arguments; return what ended, with its output."""
    with started(
        ["-m", "sweep", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options,
    ) as running:
        out, err = running.communicate(timeout=timeout)
    return subprocess.CompletedProcess(running.args, running.returncode, out, err)


def complaints(ran):
    """Return the lines of a run's standard error that are not progress, told on slow machines."""
    return [line for line in ran.stderr.splitlines() if not (
        line.endswith(" poses") or line.startswith("no block was finished for "))]


def pieces(work, url, file, step=1):
    """Run pieces of work that are each killed an instant later; return how many were."""
    with started(
        ["-W", "ignore", INSTANTS, work, url, file, step],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as running:
        out, err = running.communicate()
    assert running.returncode == 0, err
    assert int(out) > 2
    return int(out)
