"""Origin of a report's numbers: versions, dates, axes, and the commands that reproduce it."""

from __future__ import annotations

import hashlib
import json
import shlex
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sweep.analysis.described import sampling_text
from sweep.messages import label
from sweep.plan.axes import TRIAL, Axis
from sweep.plan.camera_facts import camera_facts, notes
from sweep.report.formatting import coordinates
from sweep.report.gallery import pipeline_file
from sweep.report.report_data import ReportData
from sweep.report.table import Table


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a report's numbers.

    Attributes
    ----------
    facts
        Name -> fact, as text.
    commands
        Command lines that reproduce the store and the report.
    axes
        Table of the grid's axes; None for a single pose.
    drawn
        The distributions of drawn parameters, as text.
    pipeline, file
        Text of the pipeline, and the name of its file.
    """

    facts: Mapping[str, str]
    commands: tuple[str, ...]
    axes: Table | None
    drawn: str
    pipeline: str
    file: str


def provenance(data: ReportData, output: str) -> Provenance:
    """Return the origin of a store's numbers; ``output`` is the report's own file."""
    fingerprint: dict[str, Any] = dict(data.run_metadata.get("fingerprint", {}))
    environment: dict[str, Any] = dict(data.run_metadata.get("environment", {}))
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
        "Store": data.store,
        "Camera": "; ".join([camera_facts(data.pipeline).line(), *notes(data.pipeline)]),
        "Run": _dates(data.run_metadata),
        **({"Sampling": sampling} if (sampling := sampling_text(data.results)) else {}),
        "Versions": versions,
        **({"Environments": "; ".join(
            f"{name}: {what}" for name, what in fingerprint["environments"].items()
        )} if fingerprint.get("environments") else {}),
        "Processor": str(environment.get("cpu", "unknown")),
        "Seed": str(fingerprint.get("seed", data.pipeline.seed)),
        "Fingerprint": f"{digest[:16]} (numbers {fingerprint.get('numbers', '?')})",
        **({"Files": ", ".join(f"{name} (SHA-256 {sha256[:12]}\u2026)"
                               for name, sha256 in files.items())} if files else {}),
        "Report": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }
    store = shlex.quote(data.store)
    trade = [f"sweep tradeoff {store}{_per(data)}"] if data.trade is not None else []
    return Provenance(
        facts,
        (f"sweep run {pipeline_file(data.pipeline)} --store {store}", *trade,
         data.command or f"sweep report {store} -o {shlex.quote(output)}"),
        _axes(data),
        "; ".join(f"{name} {distribution}"
                  for name, distribution in data.pipeline.distributions.items()),
        data.pipeline.text,
        f"{data.pipeline.name}.toml",
    )


def _dates(run_metadata: Mapping[str, Any]) -> str:
    created, finished = (
        str(run_metadata.get(name, default)).replace("T", " ").replace("Z", " UTC")
        for name, default in (("created", "unknown"), ("finished_at", ""))
    )
    return f"begun {created}" + (f", finished {finished}" if finished else "")


def _per(data: ReportData) -> str:
    """Return the options of `sweep tradeoff` that give the trade its conditions."""
    if data.trade is None:
        return ""
    return "".join(
        f" --per {name}" for name in map(str, data.trade["cost_ms"].dims) if name != "treatment"
    )


def _axes(data: ReportData) -> Table | None:
    if not data.pipeline.axes:
        return None
    rows = [
        [axis.name, f"{len(axis):,}", _values(axis), axis.unit,
         _section(axis), _meaning(axis)]
        for axis in data.pipeline.axes
    ]
    return Table("Axes of the grid", ["axis", "values", "which", "unit", "of", "meaning"], rows,
                 words=True)


def _section(axis: Axis) -> str:
    """Return the sections of an axis' parameters."""
    names = [name for name in axis.columns if name != TRIAL]
    return ", ".join(dict.fromkeys(axis.parameter(name).section for name in names)) or "draws"


def _meaning(axis: Axis) -> str:
    """Return an axis' meaning; of one that explains each choice, only the axis' own choices."""
    choices = [
        text for text in axis.meaning.split("; ")
        if text.partition(": ")[0] in map(str, axis.values)
    ]
    return "; ".join(choices) or axis.meaning


def _values(axis: Axis) -> str:
    """Return an axis' values as text; of many the first three and the last."""
    if len(axis) <= 7:
        return ", ".join(_texts(axis.values))
    texts = _texts([*axis.values[:3], axis.values[-1]])
    return f"{', '.join(texts[:3])}, \u2026, {texts[-1]}"


def _texts(values: Sequence[Any]) -> list[str]:
    return coordinates([label(v) if isinstance(v, (tuple, str)) else v for v in values])
