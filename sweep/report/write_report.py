"""The report of a store: its answer, and the page, HTML or Markdown, that begins with it."""

from __future__ import annotations

import base64
import math
import os
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from sweep.analysis import requirements as judged
from sweep.analysis.dataset import of_photographs, sampling_text
from sweep.analysis.requirements import Decision, Verdict, requirement_limits
from sweep.errors import ArgumentError, DatasetError, StoreError
from sweep.messages import byte_count, quoted
from sweep.report import figures as drawings
from sweep.report import findings
from sweep.report.error_model_file import check_error_model_file, model_findings
from sweep.report.figure import Figure, Panel, caption_of, panels_file, sentences
from sweep.report.output_file import (
    check_output_file,
    standard_stream,
    write_errors_explained,
    write_output_file,
)
from sweep.report.report_data import (
    CARDS,
    CONFIGURATION,
    ReportData,
    comparison,
    configurations,
    course_of,
    notes_of,
    read_report_data,
    store_errors,
)
from sweep.report.scenes import LEGEND, Scene, scenes_of
from sweep.report.table import (
    Column,
    Findings,
    Table,
    interval_text,
    markdown_text,
    number,
    plural,
)
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
        model_findings(data, error_model)
    check_output_file(file)
    for folder in folders:
        check_output_file(folder / "figure.png" if folder.is_dir() else folder)
    if data.results["estimate"].size == 0:
        raise StoreError(f"{data.store}: there are no results")
    with store_errors(data.store):
        found, drawn, scenes = answer(data), drawings.figures_of(data), scenes_of(data)
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
# Origin of a report's numbers: versions, dates, and the commands that reproduce it.

def provenance(data: ReportData, output: str) -> dict[str, Any]:
    """Return the origin of a store's numbers; ``output`` is the report's own file.

    Returns
    -------
    dict
        ``facts``: name -> text. ``commands`` that reproduce the store and the report. ``pipeline``
        and ``file``: the pipeline's text, and the name of its file.
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
    return {
        "facts": {name: text for name, text in facts.items() if text},
        "commands": (
            quoted("sweep", "run", f"{pipeline.name}.toml", "--store", data.store), *trade,
            data.command or quoted("sweep", "report", data.store, "-o", output)),
        "pipeline": pipeline.text,
        "file": f"{pipeline.name}.toml",
    }


def _recorded(value: Any) -> str:
    """Return what a run recorded of itself as text; of digests the first digits."""
    return ", ".join(f"{name} {text:.20}" for name, text in value.items()) if isinstance(
        value, Mapping) else str(value)


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


# --------------------------------------------------------------------------------------------------
# The answer: whether requirements are met, how far, and with which configuration.

@dataclass(frozen=True, slots=True)
class Answer:
    """The answer that a reader wants first.

    Attributes
    ----------
    headline
        One line.
    paragraph
        Warnings, and what the numbers do not tell.
    of
        The configuration that is named, of the tiles; empty if there is only one.
    tiles
        Its numbers over the whole grid, as cards and as JSON have them: ``name``, ``text`` and
        ``detail``, ``value`` with ``low``, ``high`` and ``unit``, and what a share is of.
    tables
        By configuration, shown at once.
    details
        Tables that stand further below.
    numbers
        The numbers behind the line, for JSON.
    """

    headline: str
    paragraph: str
    of: str
    tiles: Sequence[Mapping[str, Any]]
    tables: Sequence[Table]
    details: Sequence[Table]
    numbers: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON values: numbers, and tables of text as a page shows them."""
        return {
            "answer": self.headline, "text": self.paragraph, "configuration": self.of or None,
            "numbers": self.tiles, **self.numbers,
            "tables": [table.as_json() for table in (*self.tables, *self.details)],
        }


def answer(data: ReportData) -> Answer:
    """Return the answer: the decision on requirements, else the comparison of configurations.

    Raises
    ------
    ArgumentError
        For requirements, and conditions, that cannot be.
    StoreError
        If the store lacks what the requirements are of.
    """
    try:
        decided = required(data) if data.require else None
    except DatasetError as error:
        raise StoreError(f"{data.store}: {error}") from None
    compared = comparison(data, None if decided is None else (decided.best,))
    known = compared.known
    one = known.summary.isel({CONFIGURATION: compared.best})
    tiles = [_tile(one, card) for card in CARDS]
    name = compared.name if known.several else ""
    line = decided.line if decided else f"{compared.line}." if compared.line else _in_numbers(tiles)
    if not int(known.summary["looked_for"].sum()):
        line = (f"The {data.pipeline.target_word} was looked for in no pose: it was visible and "
                "modelled in none.")
    warnings = [f"{text.strip()[:1].upper()}{text.strip()[1:]}." for text in data.warnings]
    notes = sentences(
        *warnings,
        "A board counts as detected if at least one of its markers is."
        if data.pipeline.shows_boards else "",
        caption_of("intervals", photographs=of_photographs(data.results)),
        notes_of(data, {}), data.pooled(*known.axes))
    return Answer(
        line, notes, name, tiles,
        [*(decided.tables if decided else ()), compared.table()],
        [*(decided.details if decided else ()), *drawings.tables_of(data)],
        {"comparison": compared.as_json(), **(decided.numbers if decided else {})})


# --------------------------------------------------------------------------------------------------
# Requirements on a report's store: the decision, how far it holds, with which configuration.

#: Decisions, the best first.
ORDER = (Decision.met, Decision.undecided, Decision.not_applicable, Decision.not_met)


class Required(NamedTuple):
    """The decisions on all requirements.

    Attributes
    ----------
    line
        The answer in one line.
    best
        Number of the configuration that is named.
    tables
        How far, and the decisions, by configuration.
    details
        The decisions at each condition, of the configuration that is named.
    numbers
        For JSON: the decision on all together of the configuration that is named, verdicts as
        `sweep require` and limits as `sweep limit` prints them.
    """

    line: str
    best: int
    tables: Sequence[Table]
    details: Sequence[Table]
    numbers: Mapping[str, Any]


def required(data: ReportData) -> Required:
    """Return the decisions on the requirements of a store.

    The configuration that is named meets all requirements, or else follows them farthest along the
    axis of the conditions; of equals it is the one that the comparison on the same images names.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    known = configurations(data, targets=False)
    results = data.results.isel(known.axes)
    table = data.once("required", lambda: judged.check_requirements(
        results, data.require, data.per))
    places = [{name: [k] for name, k in at.items()} for at in known.combinations]
    found = [judged.verdicts(table.isel(at)) for at in places]
    combined = [judged.combined(each) for each in found]
    along, others = course_of(data)
    # At all other conditions together, and at each of them.
    courses = [((), others), *([(others, ())] if others else [])] if along else []
    limits = [
        data.once(("limits", per), partial(
            requirement_limits, results, data.require, str(along), per=per, at_all=at_all))
        for per, at_all in courses]

    rows = [[findings.limit_rows(part.isel(at)) for part in limits] for at in places]
    ranks = [(known.wrong[k], ORDER.index(combined[k]),
              *(-sum(row["count"] for row in part) for part in rows[k]))
             for k in range(len(places))]
    equal = [k for k in range(len(places)) if ranks[k] == min(ranks)]
    best = comparison(data, tuple(equal)).best if len(equal) > 1 else equal[0]
    whose = f", with {known.names[best]}" if len(known.names) > 1 else ""
    line = f"{' and '.join(data.require)}: {_decided(found[best], combined[best])}"
    if limits:
        line += f"; along {along}{_reached(rows[best], others)}"
    every = judged.verdicts(table)
    return Required(
        f"{line}{whose}.", best,
        [*map(findings.limit_table, limits), findings.decision_table(every)],
        [findings.condition_table(found[best], table, every=True)],
        {"decision": combined[best], "requirements": every,
         "limits": findings.limits_as_json(limits[0]) if limits else None})


def _decided(found: Sequence[Verdict], decision: Decision) -> str:
    """Return the decision, at how many conditions, and the value that decides a single one."""
    one = next((each for each in found if each.decision is decision), found[0])
    words = findings.WORDS[decision]
    if one.conditions > 1:
        words += " at all " if decision is Decision.met else (
            f" at {one.counts.get(one.decision, 0):,} of ")
        words += f"{one.conditions:,} conditions"
    elif one.decision is not Decision.not_applicable:
        words += f" ({findings.valued(one.value, one.low, one.high, one.units)})"
    return "; ".join(filter(None, (words, findings.needs(one))))


def _reached(rows: Sequence[Sequence[Mapping[str, Any]]], others: Sequence[str]) -> str:
    """Return how far along the axis: at all conditions, else at the one that reaches farthest."""
    def met(row: Mapping[str, Any]) -> str:
        return f"{row['text']} ({row['interval']})" if row["count"] else str(row["text"])

    (together,), *by_condition = rows
    line = f"{' at all values of ' * bool(others)}{', '.join(others)}: {met(together)}"
    if not by_condition or together["count"]:
        return line
    farthest = max(by_condition[0], key=lambda row: row["count"])
    at = {name: farthest["condition"][name] for name in others}
    return f"{line}; at {judged.described(at)}: {met(farthest)}" if farthest["count"] else line


# --------------------------------------------------------------------------------------------------
# The numbers in the cards, and the line that they make where there is nothing to compare.

#: Share -> the number of poses that it is of.
COUNTED = {"detection_rate": ["looked_for"], "solved_rate": ["looked_for"], "flip_rate": ["solved"]}


def _in_numbers(tiles: Sequence[Mapping[str, Any]]) -> str:
    """Return the answer of a single configuration in one line."""
    detected, _, median, _, rmse, *_ = tiles
    errors = "".join(
        f"; {tile['name']} {tile['text']}{f' ({detail})' if (detail := tile['detail']) else ''}"
        for tile in (median, rmse) if not math.isnan(tile["value"]))
    return f"Detected in {detected['text']} ({detected['detail']}){errors}."


def _tile(one: xr.Dataset, column: Column) -> dict[str, Any]:
    """Return a number of one configuration, with its name and a detail."""
    name, _, unit = column.heading.rpartition(", ")
    unit = {"deg": "\u00b0"}.get(unit, f" {unit}")
    (found,) = column.cells(one)
    known = math.isfinite(found.low) and not math.isnan(found.high)
    details = [interval_text(found.low, found.high, unit)] if known else []
    counted = {name: int(one[name]) for name in COUNTED.get(column.variable, ())}
    details += [f"of {count:,} {of.replace('_', ' ')}" for of, count in counted.items()]
    text = number(found.value) + (unit if math.isfinite(found.value) else "")
    if math.isinf(found.value):
        details = ["more than half not solved"]
    return {"name": name, "text": text, "detail": ", ".join(details), **found._asdict(),
            "unit": unit.strip(), **counted}
