"""Run benchmarks by name: ``python -m tests.benchmarks [NAME ...] [--quick]``.

``--quick`` runs the smallest size, which shows that a benchmark still runs and no figure; without
names all are run, each in a process of its own. Other arguments go to the one benchmark named. What
it prints at its full size is appended to history.jsonl beside this file, with version, commit,
processor and date.
"""

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.evidence import circumstances

HERE = Path(__file__).parent
TOP = HERE.parents[1]
HISTORY = HERE / "history.jsonl"

QUICK = {
    "analysis": (["1e4", "60"], ["CALLS = dict(list(CALLS.items())[:2])"]),
    "detectors": (["--scenes", "8", "--noise", "0", "--only", "none"], []),
    "engine": (["1"], ["MARKERS, DISTANCES, START_S, REPEATS = 1, 3, 3.0, 1"]),
    "kernel": ([], ["SIZES = BOARD_SIZES = SIZES[:1]", "POSES = {640: 20}", "REPEATS = 1",
                    "BOARD_POSES = {640: 2}", "DISTANCES = DISTANCES[:1]",
                    "BOARDS = dict(list(BOARDS.items())[:1])"]),
    "limit": (["20", "1", "40"], [
        "EXPERIMENT['axes'] = {'dictionary': ['DICT_4X4_50'], 'tilt_deg': [0]}",
        "EXPERIMENT['axes'] |= {'noise_grey': [2], 'side_px': [12, 30]}", "RATES = (0.9,)"]),
    "renderers": ([], ["SIDES, LENSES, SCENES = (8,), ((),), 2"]),
    "scale": (["--workers", "2", "--waves", "2", "--block-s", "0.1"], []),
    "size": (["{folder}", "smallest_marker"], [
        # A coarse question, without the grid.
        ("search_choice = lambda pipeline, *rest, whole=search_choice, **more: whole("
         "Pipeline.from_text(pipeline.text, ['size_m=[0.02, 0.08]', 'tilt_deg=[0]', "
         "'search.max_trials=300']), *rest, **more)"),
        "compared = lambda name, folder: bool(searched(name, folder))"]),
    "stopping": (["--workers", "1"], [
        "CASES = {'paper_fig4': (['distance_m=[0.1, 0.3]', 'tilt_deg=[0]'], 'detection_rate')}",
        "CASES['paper_fig4'][0].append('search.precision={ detection_rate = 0.2 }')",
        "CASES['paper_fig4'][0].append('search.max_trials=40')"]),
    "extremes": ([str(TOP / "pipelines" / "extremes" / "tilt_zero.toml")], []),
    "photometric": ([], ["SCENES, SIDES, TILTS = 3, (20,), (0,)",
                         "PHOTOGRAPHS, REAL_SIDES = 1, (20,)"]),
    "fit": (["1", "3"], []),
}
"""Arguments of the smallest size of each, and statements that make its constants small.

The last two compile most; in CI, tests beside them have done so by then.
"""


def file_of(name: str) -> Path:
    """Return a benchmark's file."""
    return HERE / ("extremes.py" if name == "extremes" else f"bench_{name}.py")


def run(name: str, arguments: list[str], quick: bool) -> None:
    """Run a benchmark in this process."""
    sys.path[:0] = [str(HERE), str(TOP / "tests"), str(TOP)]
    statements: list[str] = []
    if quick:
        more, statements = QUICK[name]
        folder = tempfile.mkdtemp()
        arguments = [*(each.format(folder=folder) for each in more), *arguments]
        os.chdir(folder)  # some leave their stores
    sys.argv[:] = [str(file_of(name)), *arguments]
    module = importlib.import_module(file_of(name).stem)
    exec("\n".join(statements), vars(module))  # noqa: S102  (the table above)
    if quick:
        sys.exit(module.main())
    printed = Printed()
    with contextlib.redirect_stdout(printed):
        status = module.main()
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


def main() -> int:
    """Run what the command line names; return the number of benchmarks that failed."""
    given = sys.argv[1:]
    quick = "--quick" in given
    words = [word for word in given if word != "--quick"]
    names = [word for word in words if word in QUICK]
    if len(names) == 1:
        run(names[0], [word for word in words if word != names[0]], quick)
        return 0
    if not quick or len(names) != len(words):
        print(f"expected one of {', '.join(QUICK)}; or names, or none, and --quick",
              file=sys.stderr)
        return 2
    failed, begun = 0, time.perf_counter()
    for name in names or QUICK:
        start = time.perf_counter()
        ran = subprocess.run(
            [sys.executable, "-m", "tests.benchmarks", name, "--quick"], cwd=TOP, check=False,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        failed += ran.returncode != 0
        print(f"{name}: exit status {ran.returncode}, {time.perf_counter() - start:.1f} s",
              flush=True)
        if ran.returncode:
            print(ran.stdout)
    print(f"{failed} failed, {time.perf_counter() - begun:.0f} s in all")
    return failed


if __name__ == "__main__":
    sys.exit(main())
