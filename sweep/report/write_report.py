"""The report written: one HTML page, or Markdown with its figures beside it."""

from __future__ import annotations

import base64
import os
import re
import time
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from sweep.analysis.dataset import sampling_text
from sweep.errors import ArgumentError, StoreError
from sweep.experiment.grid import Axis
from sweep.messages import byte_count, label, quoted
from sweep.report.answer import Answer, answer
from sweep.report.error_model_file import check_error_model_file, written_error_models
from sweep.report.figure import Figure, Panel, panels_file
from sweep.report.figures import figures_of
from sweep.report.output_file import (
    check_output_file,
    standard_stream,
    write_errors_explained,
    write_output_file,
)
from sweep.report.report_data import ReportData, read_report_data
from sweep.report.scenes import LEGEND, Scene, scenes_of
from sweep.report.table import Findings, Table, coordinates, markdown_text, plural
from sweep.store.files import write_whole

#: Suffix of a report -> its form; of a stream, which has none, it is a page.
FORMS = {".html": "html", ".htm": "html", ".md": "md", "": "html"}
PICTURES = (".svg", ".png")

def write_report(
    store: str | PathLike[str], output: str | PathLike[str] | None = None, *,
    require: Sequence[str] = (), per: Sequence[str] | None = None, form: str | None = None,
    figures: str | PathLike[str] | None = None, error_model: Sequence[str] = (),
    command: str = "",
) -> Findings:
    """Write the report of a store: answer, figures, example scenes.

    Parameters
    ----------
    store
        Path or URL of a finished store.
    output
        File to write (default: ``report.html``, or ``report.md`` with the form "md").
    require, per
        As for :func:`require`: the report begins with whether, and how far, it is met.
    form
        "html": one page; "md": Markdown with its figures and scenes in a folder beside it, named
        as the file with ``_figures`` in place of the suffix (default: by the file's suffix).
    figures
        Folder into which each figure is written as SVG and PNG, too.
    error_model
        JSON files of the error models to write, too.
    command
        The command line that asked for it, which the report shows.

    Returns
    -------
    Findings
        The first line and the numbers of the report.

    Raises
    ------
    ArgumentError, StoreError, DatasetError
        For what cannot be required, or written; files are written after all of them were made.

    Examples
    --------
    >>> found = sweep.write_report(folder / "two_sizes.zarr", folder / "report.html")
    >>> found.numbers["figures"], (folder / "report.html").exists()
    (3, True)
    """
    for name, value in (("output", output), ("figures", figures)):
        if value is not None and not os.fspath(value).strip():
            raise ArgumentError(name, repr(value), "expected a name")
    for path in error_model:
        check_error_model_file(path)
    file = Path(output or f"report.{form or 'html'}")
    form = form or FORMS.get(file.suffix.lower())
    if form not in FORMS.values():
        raise ArgumentError("output", str(file), "expected a file that ends in .html or .md")
    beside = file.with_name(f"{file.stem}_figures") if form == "md" else None
    folders = [folder for folder in (beside, Path(figures) if figures else None) if folder]
    data = read_report_data(os.fspath(store), require, per, command)
    if error_model:
        written_error_models(data, error_model)
    check_output_file(file)
    for folder in folders:
        check_output_file(folder / "figure.png" if folder.is_dir() else folder)
    if data.results["estimate"].size == 0:
        raise StoreError(f"{data.store}: there are no results")
    found, drawn, scenes = answer(data), figures_of(data), scenes_of(data)
    pictures = {
        f"{figure.name}{suffix}": panels_file(figure.panels, suffix)
        for figure in drawn for suffix in PICTURES if folders}
    text = page(data.pipeline.heading, found, provenance(data, str(file)), drawn, scenes,
                data.require, "" if beside is None else beside.name)
    for folder in folders:
        _write_pictures(folder, pictures)
    if beside is not None:
        _write_pictures(beside, {
            f"scene-{number}.png": scene.picture for number, scene in enumerate(scenes, 1)
            if scene.picture is not None})
    # Invalid Unicode, which a file's name may hold, is written as a question mark.
    write_output_file(file, text.encode("utf-8", errors="replace"))
    size = f", {byte_count(file.stat().st_size)}" if file.is_file() else ""
    then = (f"look at {file}", "")
    if data.trade is None and data.setting_axes:
        then = (f"sweep tradeoff {quoted(data.store)}", "what each configuration costs")
    content: dict[str, Any] = {
        "report": str(file), "figures": len(drawn), "store": data.store,
        "required": list(data.require), "per": list(data.per)}
    # Into the page's own stream a line more would not be HTML.
    lines = [] if standard_stream(file) else [
        f"{file}: {plural(len(drawn), 'figure')}{size}", *data.warnings, found.headline]
    return Findings(lines, content | found.as_json(), None, 0, then if lines else ("", ""))


def _write_pictures(folder: Path, pictures: Mapping[str, bytes]) -> None:
    """Write files into a folder; files and links of their names are replaced."""
    with write_errors_explained(folder):
        folder.mkdir(exist_ok=True)
        for name, content in pictures.items():
            write_whole(folder / name, content)


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
    run, pipeline = data.run_metadata, data.pipeline
    facts = {
        "Store": data.store,
        "Camera": "; ".join([pipeline.facts.camera_line, *pipeline.facts.camera_notes]),
        "Run": " to ".join(str(run[name]) for name in ("created", "finished_at") if name in run),
        "Sampling": sampling_text(data.results),
        **{name: _recorded(value) for part in ("environment", "fingerprint")
           for name, value in dict(run.get(part, {})).items()},
        "Report": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
    }
    trade = [] if data.trade is None else [quoted("sweep", "tradeoff", data.store, *(
        word for name in map(str, data.trade["cost_ms"].dims) if name != "treatment"
        for word in ("--per", name)))]
    axes = [[axis.name, len(axis), _values(axis), axis.unit, axis.meaning]
            for axis in pipeline.axes]
    return {
        "facts": {name: text for name, text in facts.items() if text},
        "commands": (
            quoted("sweep", "run", f"{pipeline.name}.toml", "--store", data.store), *trade,
            data.command or quoted("sweep", "report", data.store, "-o", output)),
        "axes": Table.of("Axes of the grid", ["axis", "values", "which", "unit", "meaning"], axes,
                         words=True) if axes else None,
        "drawn": "; ".join(f"{name} {distribution}"
                           for name, distribution in pipeline.distributions.items()),
        "pipeline": pipeline.text,
        "file": f"{pipeline.name}.toml",
    }


def _recorded(value: Any) -> str:
    """Return what a run recorded of itself as text; of digests the first digits."""
    return ", ".join(f"{name} {text:.20}" for name, text in value.items()) if isinstance(
        value, Mapping) else str(value)


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
    return base64.b64encode(content.encode() if isinstance(content, str) else content).decode()


def _svg(panel: Panel) -> bytes:
    """Return a panel as SVG; hundredths of a point are enough, but not of a number in a text."""
    return re.sub(rb"(\.\d\d)\d+(?=[^<>]*>)", rb"\1", panels_file([panel], ".svg"))


def _code(text: str, language: str) -> str:
    """Return text as a fenced block of Markdown."""
    fence = "```"
    while fence in text:
        fence += "`"
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"
