"""Which tests run and in which order, what they take, and the cluster that they share."""

import gc
import os
import resource
import signal
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from distributed import LocalCluster

# Hundreds of processes import the same modules: they are compiled once, wherever the tests run.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# Who starts the tests may ignore Ctrl-C (`nohup`, a job in the background), and the commands that
# they start would, too.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest.register_assert_rewrite("support")

SLOW = Path(__file__).parent / "slow.txt"
"""Names the test functions that ``-m quick`` leaves out; ``--record-slow`` writes it."""

QUICK_LIMIT_S = 0.5
"""Processor time of all default cases of a test function, in seconds, from which on it is slow."""

FIRST = (
    "measure/test_photometric.py", "analysis/", "execution/", "integrity/", "isolation/",
    "report/", "store/", "tradeoff/", "test_guides",
)
"""The order of files: what compiles most, what compiles nothing, what takes longest, the rest."""


def pytest_addoption(parser):
    parser.addoption(
        "--record-slow", action="store_true",
        help=f"write tests/{SLOW.name} from this run; run once before, so that code is compiled")


def function_of(nodeid):
    """Return the name of a test without its case, below tests/."""
    return nodeid.partition("[")[0].removeprefix("tests/")


def turn(item):
    """Return an item's place in the order of files.

    In a fresh clone one process compiles while the other runs what needs no compiled code; in
    alphabetical order both would compile the same functions. Short files come last, so that the
    processes end together.
    """
    name = function_of(item.nodeid)
    return next((k for k, start in enumerate(FIRST) if name.startswith(start)), len(FIRST))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark the quick tests; deselect the long ones unless the command line asks for them."""
    items.sort(key=turn)
    slow = set(SLOW.read_text().splitlines())
    for item in items:
        if not item.get_closest_marker("long") and function_of(item.nodeid) not in slow:
            item.add_marker("quick")
    asked = config.getoption("-m") or any("::" in argument for argument in config.args)
    if not asked:
        skipped = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if item not in skipped]
        config.hook.pytest_deselected(items=skipped)


def pytest_collection_finish():
    """Keep the collector of garbage from what was imported and collected, which stays."""
    gc.collect()
    gc.freeze()


def processor_s():
    """Return the processor time of this process and of children that it waited for, in seconds."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in used)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    item.stash["begun_s"] = processor_s()
    return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item):
    result = yield
    item.user_properties.append(("processor_s", processor_s() - item.stash["begun_s"]))
    return result


def pytest_terminal_summary(terminalreporter, config):
    """Write or name the test functions that take too long to be quick."""
    recorded, quick = config.getoption("--record-slow"), config.getoption("-m") == "quick"
    if not (recorded or quick):
        return
    taken = defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            properties = dict(getattr(report, "user_properties", ()))
            if getattr(report, "when", None) == "teardown" and "processor_s" in properties:
                taken[function_of(report.nodeid)] += properties["processor_s"]
    if recorded:
        slow = sorted(name for name, seconds in taken.items() if seconds >= QUICK_LIMIT_S)
        SLOW.write_text("".join(f"{name}\n" for name in slow))
        terminalreporter.write_line(f"{SLOW}: {len(slow)} of {len(taken)} test functions")
    for name, seconds in sorted(taken.items(), key=lambda entry: -entry[1]) if quick else ():
        if seconds > 4 * QUICK_LIMIT_S:
            terminalreporter.write_line(f"{seconds:.1f} s of processor time: {name}")


@pytest.fixture
def claim(record_property):
    """Record what a test shows: ``claim(what, against, worst, unit)``; the worst of cases counts.

    `tests/evidence.py` gathers the claims of the long tests into the table of tests/README.md.
    """
    def recorded(what, against, worst, unit=""):
        print(f"\n{what}, against {against}: {worst:.2g} {unit}")
        record_property("claim", {
            "what": what, "against": against, "worst": float(worst), "unit": unit})

    return recorded


@pytest.fixture
def no_child():
    """Small runs are computed in this process, for tests to which it does not matter where."""
    from support.here import calls_here  # noqa: PLC0415  (its assertions are rewritten by then)

    with calls_here():
        yield


@pytest.fixture(scope="session")
def cluster():
    """A cluster of two worker processes, for tests to which it does not matter whose it is."""
    with LocalCluster(
        n_workers=2, threads_per_worker=2, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as running:
        yield running
