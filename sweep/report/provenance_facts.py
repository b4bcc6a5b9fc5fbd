"""Where a report's numbers come from: versions, dates, axes, and the commands that make it."""

from __future__ import annotations

import hashlib
import json
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sweep.messages import label
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.parameters import PARAMETERS
from sweep.report.gallery import pipeline_file
from sweep.report.report_data import Subject, texts_of
from sweep.report.table import Table


@dataclass(frozen=True, slots=True)
class Provenance:
    """Facts by name, the commands that make store and report again, and tables of the axes."""

    facts: Mapping[str, str]
    commands: tuple[str, ...]
    axes: Table | None
    drawn: str
    pipeline: str
    file: str


def provenance(subject: Subject, output: str) -> Provenance:
    """Return where a store's numbers come from; ``output`` is the report's own file."""
    about = subject.about
    fingerprint: dict[str, Any] = dict(about.get("fingerprint", {}))
    environment: dict[str, Any] = dict(about.get("environment", {}))
    versions = ", ".join(
        f"{name} {value}" for name, value in (
            ("sweep", environment.get("sweep")), ("OpenCV", fingerprint.get("opencv")),
            ("NumPy", fingerprint.get("numpy")), ("Numba", fingerprint.get("numba")),
            ("Python", environment.get("python")),
        ) if value
    )
    files = dict(fingerprint.get("files", {}))
    digest = hashlib.sha256(json.dumps(fingerprint, sort_keys=True).encode()).hexdigest()
    facts = {
        "Store": subject.store,
        "Run": _dates(about),
        "Versions": versions,
        "Processor": str(environment.get("cpu", "unknown")),
        "Seed": str(fingerprint.get("seed", subject.pipeline.seed)),
        "Fingerprint": f"{digest[:16]} (numbers {fingerprint.get('numbers', '?')})",
        **({"Files": ", ".join(f"{name} (SHA-256 {some[:12]}\u2026)"
                               for name, some in files.items())} if files else {}),
        "Report": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }
    store = shlex.quote(subject.store)
    trade = [f"sweep tradeoff {store}{_per(subject)}"] if subject.trade is not None else []
    return Provenance(
        facts,
        (f"sweep run {pipeline_file(subject.pipeline)} --store {store}", *trade,
         f"sweep report {store} -o {shlex.quote(output)}"),
        _axes(subject),
        "; ".join(f"{name} {distribution}"
                  for name, distribution in subject.pipeline.distributions.items()),
        subject.pipeline.text,
        f"{subject.pipeline.name}.toml",
    )


def _dates(about: Mapping[str, Any]) -> str:
    made = str(about.get("created", "unknown")).replace("T", " ").replace("Z", " UTC")
    finished = str(about.get("finished_at", "")).replace("T", " ").replace("Z", " UTC")
    return f"begun {made}" + (f", finished {finished}" if finished else "")


def _per(subject: Subject) -> str:
    """Return the options that tell the regimes of the trade apart."""
    if subject.trade is None:
        return ""
    return "".join(
        f" --per {name}" for name in map(str, subject.trade["cost_ms"].dims) if name != "treatment"
    )


def _axes(subject: Subject) -> Table | None:
    if not subject.pipeline.axes:
        return None
    rows = [
        [axis.name, f"{len(axis):,}", _values(axis), axis.unit,
         "draws" if axis.name == TRIAL else PARAMETERS[axis.name].section, axis.meaning]
        for axis in subject.pipeline.axes
    ]
    return Table("Axes of the grid", ["axis", "values", "which", "unit", "of", "meaning"], rows,
                 words=True)


def _values(axis: Axis) -> str:
    """Return an axis' values as text, the middle ones left out where they are many."""
    if len(axis) <= 7:
        return ", ".join(_texts(axis.values))
    texts = _texts([*axis.values[:3], axis.values[-1]])
    return f"{', '.join(texts[:3])}, \u2026, {texts[-1]}"


def _texts(values: Sequence[Any]) -> list[str]:
    return texts_of([label(v) if isinstance(v, (tuple, str)) else v for v in values])
