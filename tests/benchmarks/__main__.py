"""Run benchmarks by name: ``python -m tests.benchmarks [NAME [ARGUMENT ...]] [--quick]``.

``--quick`` runs the smallest size, which shows that a benchmark still runs and no figure; without a
name all are run, each in a process of its own. What a benchmark prints at its full size is appended
to history.jsonl beside this file, with version, commit, processor and date.
"""

import contextlib
import importlib
import io
import json
import multiprocessing
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
TOP = HERE.parents[1]
sys.path[:0] = [str(TOP / "tests"), str(TOP)]

from support.here import calls_here  # noqa: E402  (found by the path above)
from tests.evidence import circumstances  # noqa: E402

HISTORY = HERE / "history.jsonl"
NAMES = (
    "analysis", "detectors", "engine", "kernel", "renderers", "scale", "size", "stopping",
    "extremes", "detection", "photometric",
)
"""The last compile most; in CI, tests beside them have done so by then."""


def run(name: str, arguments: list[str], quick: bool) -> None:
    """Run a benchmark; if that is wanted, with its ``QUICK`` and without others' processes."""
    module = importlib.import_module(f"benchmarks.bench_{name}")
    if quick:
        vars(module).update(module.QUICK)
        with contextlib.nullcontext() if name == "engine" else calls_here():
            sys.exit(module.main(*arguments))
    printed = Printed()
    with contextlib.redirect_stdout(printed):
        status = module.main(*arguments)
    with HISTORY.open("a", encoding="utf-8") as history:
        history.write(json.dumps({
            "benchmark": name, "arguments": arguments, **circumstances(),
            "printed": printed.getvalue().splitlines()}) + "\n")
    sys.exit(status)


class Printed(io.StringIO):
    """Keeps what is printed, and prints it."""

    def write(self, text: str) -> int:
        """Print a text, and keep it."""
        sys.__stdout__.write(text)
        return super().write(text)


def run_all() -> int:
    """Run every benchmark at its smallest size in a fork of this process; return failures."""
    for common in ("distributed", "sweep.execution.runner", "sweep.report.write_report"):
        importlib.import_module(common)  # once for all
    failed, begun = 0, time.perf_counter()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # for their stores
        for name in NAMES:
            start = time.perf_counter()
            ran = multiprocessing.get_context("fork").Process(target=run, args=(name, [], True))
            ran.start()
            ran.join()
            failed += ran.exitcode != 0
            print(f"{name}: exit status {ran.exitcode}, {time.perf_counter() - start:.1f} s",
                  flush=True)
    print(f"{failed} failed, {time.perf_counter() - begun:.0f} s in all")
    return failed


def main() -> int:
    """Run what the command line names; return the number of benchmarks that failed."""
    words = [word for word in sys.argv[1:] if word != "--quick"]
    quick = len(words) < len(sys.argv) - 1
    if words and words[0] in NAMES:
        run(words[0], words[1:], quick)
    if words or not quick:
        print(f"expected one of {', '.join(NAMES)}, or --quick alone", file=sys.stderr)
        return 2
    return run_all()


if __name__ == "__main__":
    sys.exit(main())
