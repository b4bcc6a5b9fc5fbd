"""Which tests run, in which order, and that unit tests start no process."""

import contextlib
import gc
import multiprocessing.util
import os
import signal
import sys

import pytest

# Many processes import the same modules: they are compiled once, wherever the tests run.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Who starts the tests may ignore Ctrl-C (`nohup`, a job in the background), and the commands that
# they start would, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest.register_assert_rewrite("support")

FIRST = (
    "measure/test_photometric.py", "analysis/", "execution/", "integrity/", "isolation/",
    "report/", "store/", "tradeoff/", "test_guides",
)
"""The order of files: what compiles most, what compiles nothing, what takes longest, the rest."""

STARTED = []
"""Processes that this one started since the last test, as far as they are seen."""


def seen(event, arguments):
    """Note a process that is started, but Matplotlib's of `fc-list` where it lists fonts once."""
    if event in {"subprocess.Popen", "os.fork", "os.posix_spawn"} and "fc-list" not in arguments:
        STARTED.append(" ".join(map(str, arguments[1])) if len(arguments) > 1 else event)


sys.addaudithook(seen)
spawn = multiprocessing.util.spawnv_passfds


def spawned(path, arguments, passed):
    """Start a process as `multiprocessing` does, which is not audited."""
    STARTED.append("multiprocessing")
    return spawn(path, arguments, passed)


multiprocessing.util.spawnv_passfds = spawned


def turn(item):
    """Return an item's place in the order of files.

    In a fresh clone one process compiles while the other runs what needs no compiled code; in
    alphabetical order both would compile the same functions. Short files come last, so that the
    processes end together.
    """
    name = item.nodeid.removeprefix("tests/")
    return next((k for k, start in enumerate(FIRST) if name.startswith(start)), len(FIRST))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark unit tests; deselect evidence unless the command line asks for it."""
    items.sort(key=turn)
    for item in items:
        if item.get_closest_marker("long"):
            item.add_marker("evidence")
        if not any(item.get_closest_marker(name) for name in ("system", "evidence")):
            item.add_marker("unit")
    asked = "evidence" in config.getoption("-m") or any("::" in each for each in config.args)
    if not asked:
        skipped = [item for item in items if item.get_closest_marker("evidence")]
        items[:] = [item for item in items if item not in skipped]
        config.hook.pytest_deselected(items=skipped)


def pytest_collection_finish():
    """Keep the collector of garbage from what was imported and collected, which stays."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """Run a unit test, with its fixtures, without child processes."""
    from support.here import calls_here  # noqa: PLC0415  (its assertions are rewritten by then)

    with calls_here() if item.get_closest_marker("unit") else contextlib.nullcontext():
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Let a unit test fail that started a process all the same."""
    STARTED.clear()
    result = yield
    if STARTED and item.get_closest_marker("unit"):
        pytest.fail(f"not marked `system`, and it started {', '.join(STARTED)}", pytrace=False)
    return result


@pytest.fixture
def claim(record_property):
    """Record what a test shows: ``claim(what, against, worst, unit)``; the worst of cases counts.

    `tests/evidence.py` gathers the claims of the evidence into the table of tests/README.md.
    """
    def recorded(what, against, worst, unit=""):
        print(f"\n{what}, against {against}: {worst:.2g} {unit}")
        record_property("claim", {
            "what": what, "against": against, "worst": float(worst), "unit": unit})

    return recorded
