"""Run the long tests as a whole or in shards, and write down what was claimed and measured.

    python -m tests.evidence run FILE.json [--shard K/N] [PYTEST ARGUMENT ...]
    python -m tests.evidence table FILE.json ...

``run`` runs the long tests of one shard (files in turn: the first of N is 1/N; without ``--shard``
also on several processors, ``-n 2 --dist loadfile``), and writes outcome and duration of every test
function, what tests claim by the fixture ``claim``, and on what they ran: version and commit of the
project, versions of libraries, processor, date. It writes after each test, so that a run that is
stopped keeps what it found. ``table`` joins the files of one commit, writes the table of claims
into tests/claims.txt, and prints seconds by folder; it exits with 1 where a test failed, or a shard
is missing or did not end.
"""

from __future__ import annotations

import datetime as dt
import json
import platform
import subprocess
import sys
from collections import Counter, defaultdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from sweep.evaluation.results import processor
from sweep.version import __version__

HERE = Path(__file__).parent
CLAIMS = HERE / "claims.txt"
BEGIN, END = "<!-- claims: python -m tests.evidence table -->", "<!-- end of claims -->"
LIBRARIES = ("opencv-contrib-python-headless", "numpy", "numba", "scipy", "xarray", "zarr", "dask")


class Recorder:
    """Selects a shard of the long tests; writes their outcomes, durations and claims to a file."""

    def __init__(self, file: Path, shard: int, shards: int) -> None:
        self.file, self.circumstances = file, circumstances()
        self.shard, self.shards = shard, shards
        self.outcomes: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.claims: list[dict[str, Any]] = []

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        """Keep the test files whose turn it is."""
        files = sorted({item.nodeid.partition("::")[0] for item in items})
        kept = set(files[self.shard - 1 :: self.shards])
        dropped = [item for item in items if item.nodeid.partition("::")[0] not in kept]
        items[:] = [item for item in items if item not in dropped]
        config.hook.pytest_deselected(items=dropped)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Count the outcome of a test, add its time, and keep its claims."""
        name = report.nodeid.partition("[")[0]
        self.seconds[name] += report.duration
        if report.when == "call" or report.outcome != "passed":
            self.outcomes[name][report.outcome] += 1
        if report.when == "teardown":
            self.claims += [{**value, "test": name} for key, value in report.user_properties
                            if key == "claim"]
            self.write(None)

    def write(self, status: int | None) -> None:
        """Write the file; ``status`` is pytest's exit status, None before the end."""
        self.file.write_text(json.dumps({
            **self.circumstances, "shard": self.shard, "shards": self.shards, "status": status,
            "seconds": {name: round(spent, 1) for name, spent in self.seconds.items()},
            "outcomes": self.outcomes, "claims": self.claims,
        }, indent=1) + "\n", encoding="utf-8")


def commit() -> str:
    """Return the commit of the tree, with a plus sign where it was changed since."""
    asked = ("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "--untracked-files=no")
    head, changed = (
        subprocess.run(["git", "-C", str(HERE), *words], capture_output=True, text=True,
                       check=False).stdout.strip() for words in asked)
    return head + ("+" if changed else "")


def circumstances() -> dict[str, Any]:
    """Return version and commit of the project, date, processor, and versions of libraries."""
    return {
        "version": __version__, "commit": commit(),
        "date": dt.datetime.now(dt.UTC).date().isoformat(), "processor": processor(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in LIBRARIES}}


def run(file: str, *arguments: str) -> int:
    """Run a shard; return pytest's exit status."""
    shard, shards = 1, 1
    others = list(arguments)
    if "--shard" in others:
        place = others.index("--shard")
        shard, shards = (int(number) for number in others[place + 1].split("/"))
        del others[place : place + 2]
        if "-n" in others:  # pytest's workers do not know of shards
            raise SystemExit("expected --shard or -n, not both")
    recorder = Recorder(Path(file), shard, shards)
    status = int(pytest.main(["-m", "evidence", *others], plugins=[recorder]))
    recorder.write(status)
    return status


def joined(claims: list[dict[str, Any]]) -> list[list[str]]:
    """Return a row a claim: words, reference, and the worst of the figures of its test cases."""
    rows = {}
    for each in claims:
        key = each["what"], each["against"], each["unit"]
        figure = rows.get(key)
        rows[key] = each["worst"] if figure is None else max(figure, each["worst"])
    return [[what, against, f"{worst:.3g} {unit}".strip()]
            for (what, against, unit), worst in rows.items()]


def table(*files: str, page: Path = CLAIMS) -> int:
    """Write the table of claims; return 1 where a test failed or a shard is missing, else 0."""
    parts = [json.loads(Path(file).read_text(encoding="utf-8")) for file in files]
    if len({(part["commit"], part["shards"]) for part in parts}) != 1:
        raise SystemExit("expected the shards of one commit")
    first = parts[0]
    ended = {part["shard"] for part in parts if part["status"] is not None}
    missing = set(range(1, first["shards"] + 1)) - ended
    outcomes: Counter[str] = sum((Counter(each) for part in parts for each in
                                  part["outcomes"].values()), Counter())
    failed = [name for part in parts for name, each in part["outcomes"].items()
              if each.get("failed")]
    hours = sum(sum(part["seconds"].values()) for part in parts) / 3600
    rows = joined([claim for part in parts for claim in part["claims"]])
    ran = (
        f"Commit {first['commit']} (version {first['version']}), {first['date']}, Python "
        f"{first['python']}, OpenCV {first['libraries'][LIBRARIES[0]]}, {first['processor']}: "
        f"{', '.join(f'{count:,} {word}' for word, count in sorted(outcomes.items()))}, "
        f"{hours:.1f} hours.")
    lines = [
        "| what | against | worst case |", "| --- | --- | --- |",
        *(f"| {' | '.join(row)} |" for row in rows), "", ran]
    text = page.read_text(encoding="utf-8")
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    page.write_text("\n".join([f"{head}{BEGIN}", "", *lines, "", f"{END}{tail}"]),
                    encoding="utf-8")
    folders: Counter[str] = Counter()
    for part in parts:
        for name, spent in part["seconds"].items():
            folders[name.partition("::")[0].rpartition("/")[0]] += spent
    for folder, spent in folders.most_common():
        print(f"{folder}: {spent:.0f} s")
    for name in failed:
        print(f"failed: {name}")
    if missing:
        numbers = ", ".join(map(str, sorted(missing)))
        print(f"missing, or not ended: shards {numbers} of {first['shards']}")
    return int(bool(failed or missing))


if __name__ == "__main__":
    sys.exit({"run": run, "table": table}[sys.argv[1]](*sys.argv[2:]))
