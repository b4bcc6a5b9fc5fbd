"""The report written: one HTML page, or Markdown with its figures beside it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shlex
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from sweep.analysis.dataset import sampling_text
from sweep.errors import ArgumentError, StoreError
from sweep.experiment.grid import Axis
from sweep.messages import label, quoted
from sweep.report.answer import Answer, answer
from sweep.report.figure import Figure, Panel, panels_file
from sweep.report.figures import figures_of
from sweep.report.output_file import check_output_file, write_errors_explained, write_output_file
from sweep.report.report_data import ReportData
from sweep.report.scenes import LEGEND, Scene, pipeline_file, scenes_of
from sweep.report.table import Table, coordinates, markdown_text
from sweep.store.files import check_folder_writable, write_whole
from sweep.store.locations import enclosing_store

# --------------------------------------------------------------------------------------------------
# Origin of a report's numbers: versions, dates, axes, and the commands that reproduce it.

def provenance(data: ReportData, output: str) -> dict[str, Any]:
    """Return the origin of a store's numbers; ``output`` is the report's own file.

    Returns
    -------
    dict
        ``facts``: name -> text. ``commands`` that reproduce the store and the report. ``axes``: a
        table, or None for a single pose. ``drawn``: the distributions of drawn parameters.
        ``pipeline`` and ``file``: the pipeline's text, and the name of its file.
    """
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
        "Camera": "; ".join([data.pipeline.facts.camera_line, *data.pipeline.facts.camera_notes]),
        "Run": _dates(data.run_metadata),
        **({"Sampling": sampling} if (sampling := sampling_text(data.results)) else {}),
        "Versions": versions,
        "Processor": str(environment.get("cpu", "unknown")),
        "Seed": str(fingerprint.get("seed", data.pipeline.seed)),
        "Fingerprint": f"{digest[:16]} (numbers {fingerprint.get('numbers', '?')})",
        **({"Files": ", ".join(f"{name} (SHA-256 {sha256[:12]}\u2026)"
                               for name, sha256 in files.items())} if files else {}),
        "Report": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }
    store = shlex.quote(data.store)
    trade = [] if data.trade is None else [quoted("sweep", "tradeoff", data.store, *(
        word for name in map(str, data.trade["cost_ms"].dims) if name != "treatment"
        for word in ("--per", name)))]
    return {
        "facts": facts,
        "commands": (
            f"sweep run {pipeline_file(data.pipeline)} --store {store}", *trade,
            data.command or f"sweep report {store} -o {shlex.quote(output)}"),
        "axes": _axes(data),
        "drawn": "; ".join(f"{name} {distribution}"
                           for name, distribution in data.pipeline.distributions.items()),
        "pipeline": data.pipeline.text,
        "file": f"{data.pipeline.name}.toml",
    }


def _dates(run_metadata: Mapping[str, Any]) -> str:
    created, finished = (
        str(run_metadata.get(name, default)).replace("T", " ").replace("Z", " UTC")
        for name, default in (("created", "unknown"), ("finished_at", ""))
    )
    return f"begun {created}" + (f", finished {finished}" if finished else "")


def _axes(data: ReportData) -> Table | None:
    if not data.pipeline.axes:
        return None
    rows = [[axis.name, len(axis), _values(axis), axis.unit, _meaning(axis)]
            for axis in data.pipeline.axes]
    return Table.of(
        "Axes of the grid", ["axis", "values", "which", "unit", "meaning"], rows, words=True)


def _meaning(axis: Axis) -> str:
    """Return an axis' meaning; of one that explains each choice, only the axis' own choices."""
    choices = [
        text for text in axis.meaning.split("; ")
        if text.partition(": ")[0] in map(str, axis.values)
    ]
    return "; ".join(choices) or axis.meaning


def _values(axis: Axis) -> str:
    """Return an axis' values as text; of many the first three and the last."""
    shown = list(axis.values) if len(axis) <= 7 else [*axis.values[:3], axis.values[-1]]
    texts = coordinates([label(v) if isinstance(v, (tuple, str)) else v for v in shown])
    return ", ".join([*texts[:-1], *(["\u2026"] if len(axis) > 7 else []), texts[-1]])


# --------------------------------------------------------------------------------------------------
# The report as one self-contained HTML page (no network, no script, no other file), or as Markdown
# with its figures and scenes as files in a folder beside it: from the templates beside this module.


def page(
    title: str, answer: Answer, provenance: Mapping[str, Any], figures: Sequence[Figure],
    scenes: Sequence[Scene], require: Sequence[str] = (), folder: str = "",
) -> str:
    """Return the report as HTML; all text is escaped.

    With ``folder``, the name of the folder of figures and scenes, it is Markdown.
    """
    html = not folder
    environment = Environment(
        loader=PackageLoader("sweep.report"), autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined, trim_blocks=not html, lstrip_blocks=not html)
    environment.filters |= {
        "base64": _base64, "code": _code, "md": markdown_text, "quote": quote,
        "sentence_case": str.capitalize, "svg": _svg,
    }
    text = environment.get_template("page.html" if html else "page.jinja").render(
        title=title, answer=answer, provenance=provenance, figures=figures,
        scenes=scenes, require=require, base=quote(folder),
        legend=LEGEND)
    return text.rstrip("\n") + "\n"


def _base64(content: bytes | str) -> str:
    encoded = content.encode() if isinstance(content, str) else content
    return base64.b64encode(encoded).decode()


def _svg(panel: Panel) -> bytes:
    """Return a panel as SVG; hundredths of a point are enough."""
    return re.sub(rb"(\.\d\d)\d+", rb"\1", panels_file([panel], ".svg"))


def _code(text: str, language: str) -> str:
    """Return text as a fenced block of Markdown."""
    fence = "```"
    while fence in text:
        fence += "`"
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"


# --------------------------------------------------------------------------------------------------
# Writing a report: completely, or not at all.

FORMATS = ("html", "md")
PICTURES = (".svg", ".png")

def check_output(output: Path, folders: Sequence[Path]) -> None:
    """Check that a report can be written, before it is computed.

    Raises
    ------
    StoreError
        If the output is a folder, or its folder is missing or not writable; if a folder of figures
        is a file; or if anything would be written into a store.
    """
    for wanted in (output, *folders):
        with write_errors_explained(wanted):
            around = enclosing_store(wanted)
        if around is not None:
            raise StoreError(f"{wanted}: cannot be written: it is inside the store {around}")
    check_output_file(output)
    for folder in folders:
        with write_errors_explained(folder):
            if folder.is_dir():
                check_folder_writable(folder)
            elif os.path.lexists(folder):
                folder.stat()  # a link that leads nowhere, or in a circle
                raise StoreError(f"{folder}: cannot hold figures: it is a file; choose a folder")
            else:
                check_output_file(folder)  # it can be made


def write_page(
    data: ReportData, output: Path, form: str = "html", figures: Path | None = None
) -> tuple[int, Answer]:
    """Write the report of a store; return its number of figures, and the answer.

    Parameters
    ----------
    data
        The store.
    output
        The file to write; an existing one is replaced.
    form
        ``html``: one self-contained page. ``md``: Markdown with its figures and scenes in a folder
        beside it, named as ``output`` with ``_figures`` in place of the suffix.
    figures
        Folder into which each figure is written as an SVG and a PNG file, too.

    Raises
    ------
    ArgumentError
        If ``form`` is neither of these, or for what cannot be required.
    StoreError
        If there are no results, some are missing or cannot be read, or a file cannot be written.
    """
    if form not in FORMATS:
        raise ArgumentError("form", form, f"expected one of {', '.join(FORMATS)}")
    beside = output.with_name(f"{output.stem}_figures") if form == "md" else None
    folders = [folder for folder in (beside, figures) if folder is not None]
    check_output(output, folders)
    if data.results["estimate"].size == 0:
        raise StoreError(f"{data.store}: there are no results")
    title = data.pipeline.heading
    numbers, origin = answer(data), provenance(data, str(output))
    rendered = figures_of(data)
    pictures = {
        f"{figure.name}{suffix}": panels_file(figure.panels, suffix)
        for figure in rendered for suffix in PICTURES if folders}
    scenes = list(scenes_of(data))
    text = page(title, numbers, origin, rendered, scenes, data.require,
                "" if beside is None else beside.name)
    # Files are written after all of them were made.
    for folder in folders:
        _write_pictures(folder, pictures)
    if beside is not None:
        _write_pictures(beside, {
            f"scene-{number}.png": scene.picture for number, scene in enumerate(scenes, 1)
            if scene.picture is not None})
    # Invalid Unicode, which a file's name may hold, is written as a question mark.
    write_output_file(output, text.encode("utf-8", errors="replace"))
    return len(rendered), numbers


def _write_pictures(folder: Path, pictures: Mapping[str, bytes]) -> None:
    """Write files into a folder; files and links of their names are replaced."""
    with write_errors_explained(folder):
        folder.mkdir(exist_ok=True)
        for name, content in pictures.items():
            write_whole(folder / name, content)
