"""The report of a store: figures and tables, the answer, and the page that begins with it."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import xarray as xr

from sweep import analysis
from sweep.analysis import requirements as judged
from sweep.analysis.dataset import is_grid_axis, of_photographs, sampling_text
from sweep.analysis.estimator import Bins
from sweep.analysis.requirements import Decision, Reached, Verdict, requirement_limits
from sweep.analysis.summaries import ThresholdChoice
from sweep.errors import ArgumentError, DatasetError, StoreError, path_of, texts_of
from sweep.experiment.parameters import Stage
from sweep.measure.flags import BoundStatus, Flag, outcomes, present_values
from sweep.messages import quoted
from sweep.report import findings, output_file, report_data
from sweep.report import table as tables
from sweep.report.figure import MAX_DOTS, MAX_LINES, Figure, panels_file
from sweep.report.report_data import AREA, CARDS, CONFIGURATION, IDS, Groups, ReportData, grouped
from sweep.report.scenes import LEGEND, Scene, scenes_of
from sweep.report.table import Column, Findings, Table, caption_of, column, sentences, table_of
from sweep.store.files import write_whole

# --------------------------------------------------------------------------------------------------
# Columns that several figures share.

DETECTED, SOLVED, _, _, _, RANGE_BIAS, _ = CARDS
LOOKED_FOR = column("looked_for")
SOLVED_COUNT = Column("n solved", "solved")
FLIPS = Column("flips, % of the solved", "flip_rate", 100)
RATES = (LOOKED_FOR, DETECTED)
ERROR_CURVES = tuple(map(column, (
    "rotation_median_deg", "rotation_p95_deg", "range_median_percent", "range_p95_percent")))
ERRORS = (
    SOLVED, *ERROR_CURVES[:2], column("rotation_rmse_unflipped_deg"), *ERROR_CURVES[2:],
    column("range_rmse_unflipped_percent"), RANGE_BIAS, column("position_median_m"),
    column("position_p95_m"), FLIPS)

#: Bias and standard deviation along the camera's axes and about the angles.
SIGNED_COLUMNS = (SOLVED_COUNT, RANGE_BIAS, *(
    column(f"{name}_{statistic}_{unit}")
    for names, unit in (("xyz", "m"), (("yaw", "pitch", "roll"), "deg"))
    for name in names for statistic in ("bias", "sd")))
#: Of these, kinds of errors as `sweep.analysis.error_statistics` takes them.
SIGNED_GROUPS = ("range", "camera_frame", "yaw_pitch_roll")

EFFICIENCIES = tuple(column(f"{quantity}_efficiency") for quantity in ("rotation", "range"))

#: Angles that are lines of one configuration, and panels of several.
MAX_ANGLES, MAX_ANGLE_PANELS = 6, 2


# --------------------------------------------------------------------------------------------------
# A figure, or a table alone, of an analysis by configuration and groups of poses.


def figure(
    data: ReportData, summary: xr.Dataset, groups: Groups, name: str, title: str, text: str,
    columns: Sequence[Column], curves: Sequence[Column], *, by: str = "",
    covers: Sequence[str] = (),
) -> Figure:
    """Return a figure of `grouped`, the last of whose groups are along x.

    Its caption also names pooled axes, and values that are not drawn.
    """
    dims, count = list(groups), summary.sizes[CONFIGURATION]
    if not by and (count > 1 or len(dims) > 1):
        by = CONFIGURATION if count > 1 else data.label(dims[0])
    return Figure(
        name, title, sentences(
            text,
            caption_of("first_lines", drawn=MAX_LINES, count=count)
            if dims and count > MAX_LINES else "",
            report_data.notes_of(data, groups),
            data.pooled(*dims, *report_data.configurations(data).axes)),
        configuration_table(data, summary, dims, title, columns), curves,
        data.label(dims[-1]) if dims else "", by, covers=covers)


def configuration_table(
    data: ReportData, summary: xr.Dataset, dims: Sequence[str], caption: str,
    columns: Sequence[Column], counted: str = "looked_for",
) -> Table:
    """Return the table of an analysis (configuration, *dims), with 95 % intervals."""
    if summary.sizes[CONFIGURATION] > 1 or not dims:
        dims = [CONFIGURATION, *dims]
    else:
        summary = summary.isel({CONFIGURATION: 0})
    return table_of(summary, f"{caption}, with 95 % intervals", dims, columns, data.results,
                    counted=counted)


# --------------------------------------------------------------------------------------------------
# The figures.


def _along(data: ReportData, name: str) -> Figure:
    """Return the figure of rates and errors along an axis, the area, or a drawn parameter.

    Along the size each angle is apart: a line of one configuration, a panel of several.
    """
    axis = data.pipeline.axis(name)
    meaning = axis.meaning if axis is not None else (
        "in the image" if name == AREA else data.pipeline.parameters[name].meaning)
    groups = data.along(name)
    if data.angle_axis and name == data.size:
        several = data.setting_axes or data.pipeline.experiment.target_axes
        most = MAX_ANGLE_PANELS if several else MAX_ANGLES
        groups = {**data.along(data.angle_axis, most), **groups}
    return figure(
        data, grouped(data, analysis.error_statistics, groups), groups, f"by-{name}",
        f"Rates and errors by {data.words(name)}",
        caption_of("along", target=data.pipeline.target_word, axis=name, meaning=meaning),
        (*RATES, *ERRORS), [DETECTED, *ERROR_CURVES, FLIPS, RANGE_BIAS], covers=tuple(groups))


#: From this many values on, an axis of numbers has a figure along it beside its configurations.
MIN_DRAWN = 3


def _configurations(data: ReportData) -> Figure | None:
    known = report_data.configurations(data)
    if len(known.names) == 1:
        return None
    covers = [
        axis.name for axis in data.pipeline.axes
        if len(known.axes.get(axis.name, ())) == len(axis)
        and (not axis.is_numeric or len(axis) < MIN_DRAWN)]
    return figure(
        data, known.summary, {}, "configurations",
        f"Configurations compared: {', '.join(known.axes)}",
        caption_of("configurations"), (LOOKED_FOR, *ERRORS),
        (SOLVED, *ERROR_CURVES[::2], FLIPS), covers=covers)


def _trade(data: ReportData) -> Figure | None:
    if data.trade is None:
        return None
    lines = report_data.trade_lines(data, data.trade, data.trade.attrs.get("budget_ms"))
    return findings.trade_figure(data.trade, lines=lines)


def _outcomes(data: ReportData) -> Figure:
    names = [name for name in (data.size_axis, *data.scene_axes, data.size)
             if name is not None and name != IDS
             and data.pipeline.axis(name) not in data.pipeline.experiment.target_axes]
    groups = data.along(names[0]) if names else {}
    summary = grouped(data, analysis.failure_composition, groups)
    counts = summary["count"].sum(
        [name for name in summary["count"].dims if name != "outcome"]).to_series()
    excluded = counts[list(outcomes(counted=False))]
    left_out = ", ".join(f"{count:,} {name}" for name, count in excluded.items() if count)
    total = summary["count"].where(summary["share"].notnull(), 0).sum("outcome").astype(int)
    happened = summary.sel(outcome=[
        name for name, count in counts.items() if count and name not in excluded])
    share = Column("share, %", "share", 100)
    return figure(
        data, happened.assign(looked_for=total),
        {"outcome": None, **groups}, "failures", "Outcomes of the poses",
        caption_of("outcomes", by=data.words(names[0]) if names else "", left_out=left_out),
        (LOOKED_FOR, share), [share], by="outcome")


def _ranking(data: ReportData) -> Figure | None:
    """Return the detection rates of marker IDs, the weak ones first."""
    if data.results.sizes.get(IDS, 1) < 2:
        return None

    def ranking(results: xr.Dataset, per: Sequence[str], **_: Bins) -> xr.Dataset:
        # IDs are kept apart anyway.
        return analysis.marker_ranking(results, [name for name in per if name != IDS])

    table = configuration_table(
        data, grouped(data, ranking, {IDS: None}, [Stage.detection]), [IDS],
        "IDs by detection rate",
        (*RATES, *map(column, ("expected_rate", "p_adjusted", "weak"))))
    rates, weak = (table.frame[name].tolist() for name in (DETECTED.heading, "weak"))
    order = sorted(range(len(weak)), key=lambda k: (not weak[k], rates[k]))
    return Figure(
        "ranking", "Marker IDs, the weakest first", sentences(
            caption_of("ranking", shown=min(MAX_DOTS, len(weak)), weak=sum(weak), count=len(weak)),
            data.pooled(IDS, *report_data.configurations(data).axes)),
        dataclasses.replace(table, frame=table.frame.iloc[order]), [DETECTED], by="weak",
        covers=[IDS])


def _bound(data: ReportData) -> Figure | None:
    if "bound" not in data.results or not bool(
            data.results["bound"].isin(present_values(BoundStatus)).any()):
        return None
    along = data.size_axis or data.angle_axis
    groups = data.along(along) if along else {}
    return figure(
        data, grouped(data, analysis.efficiency, groups), groups, "bound",
        "Efficiency: the accuracy bound over the errors", caption_of("bound"),
        EFFICIENCIES, EFFICIENCIES)


# --------------------------------------------------------------------------------------------------
# The figures of a store, in the order in which they stand.

#: Makers of figures, None for a store that a figure does not fit; add one here.
FIGURES: tuple[Callable[[ReportData], Figure | None], ...] = (
    lambda data: None if data.size is None else _along(data, data.size), _configurations, _trade,
    _outcomes, _ranking, _bound,
)


def figures_of(data: ReportData) -> list[Figure]:
    """Return the figures of a store, such that one shows each axis and drawn parameter.

    Where no pose was looked for there may be nothing to draw, and no figure.
    """
    made = [figure for make in FIGURES if (figure := make(data)) is not None]
    covered = {name for figure in made for name in figure.covers}
    # Of one draw, or of trials that were not run (NaN), there is nothing along it.
    drawn = [name for name in data.pipeline.distributions if name in data.results.variables
             and data.results[name].min() < data.results[name].max()]
    made += [_along(data, name) for name in (*data.scene_axes, *data.setting_axes, *drawn)
             if name not in covered]
    return [figure for figure in made if figure.panels]


# --------------------------------------------------------------------------------------------------
# Tables of signed errors, of boards' markers, of thresholds, and of the precision that was reached.

#: The threshold on the ambiguity that many programs use, and what it keeps.
USUAL = 0.2
KEPT_AT_USUAL = (
    Column("solved", "solved"), Column("flips", "flipped"),
    Column(f"kept at {USUAL:g}, %", "kept_rate", 100),
    Column(f"flips kept at {USUAL:g}", "kept_flipped"),
    Column(f"right of the rejected at {USUAL:g}, %", "rejected_right_rate", 100),
    Column("threshold found?", "choice"), Column("threshold", "chosen_threshold"),
    Column("kept there, %", "chosen_kept_rate", 100),
    Column("flips there, %", "chosen_flip_rate", 100),
    Column("right poses rejected there, %", "chosen_right_rejected_rate", 100))

#: The most sizes, or angles, that a table of thresholds tells apart.
MAX_SIZES = 8


def tables_of(data: ReportData) -> list[Table]:
    """Return the tables below a report's figures."""
    rule, boards = data.pipeline.stopping, "marker_detection" in data.results
    return [
        *([board_table(data)] if boards else []),
        configuration_table(
            data, grouped(data, partial(analysis.error_statistics, quantities=SIGNED_GROUPS)), (),
            "Bias and spread of the solved poses without flips", SIGNED_COLUMNS, "solved"),
        *threshold_tables(data),
        *([precision_table(data)]
          if rule is not None and rule.precision else [])]


def board_table(data: ReportData) -> Table:
    """Return the rates of boards' single markers, by board and detector setting."""
    axes = (*data.pipeline.experiment.target_axes, *data.pipeline.axes_of(Stage.detection))
    dims = [axis.name for axis in axes if len(axis) > 1]
    return table_of(
        analysis.detection_rate(analysis.per_marker(data.results), dims),
        "Markers of boards, each counted by itself, with 95 % intervals", dims, RATES,
        data.results)


def threshold_tables(data: ReportData) -> list[Table]:
    """Return what thresholds on the ambiguity keep, where poses have a mirror and some are flips.

    At each size: the poses that the usual threshold keeps, and the largest that is shown to keep
    few flips.
    """
    if "alternative_reprojection_error_px" not in data.results:
        return []
    along = data.size or data.angle_axis
    groups = data.along(along, MAX_SIZES) if along else {}
    table = grouped(data, analysis.ambiguity, groups)
    if not ((table["without_alternative"] < table["solved"]) & (table["flipped"] > 0)).any():
        return []
    choice = in_words(table["choice"], ThresholdChoice)
    wanted = 100 * float(table.attrs["flip_rate"])
    return [table_of(
        table.sel(threshold=USUAL, drop=True).assign(choice=choice),
        f"Thresholds on the ambiguity, with 95 % intervals; wanted: {wanted:g} % flips",
        [CONFIGURATION, *groups], KEPT_AT_USUAL, data.results)]


def precision_table(data: ReportData) -> Table:
    """Return a row for each quantity, configuration and condition of a wanted precision."""
    table = analysis.precision_reached(data.results)
    columns = [*map(column, ("reached", "value", "half_width", "wanted", "run"))]
    dims = ["quantity", *(str(dim) for dim in table["reached"].dims if dim != "quantity")]
    return table_of(
        table.assign(reached=in_words(table["reached"], Reached)),
        "Precision: of rates the half-width of the interval, of others relative to the value "
        "(bias: to the RMSE); poses that were run", dims, columns, data.results)


def in_words(flags: xr.DataArray, kind: type[Flag]) -> xr.DataArray:
    """Return flags as words."""
    words: xr.DataArray = xr.apply_ufunc(
        lambda flag: kind(flag).name.replace("_", " "), flags, vectorize=True,
        output_dtypes=[object])
    return words


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
            "tables": [table.as_json() for table in (*self.tables, *self.details)]}


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
        line, compared, first, details, numbers = required(data) if data.require else (
            "", report_data.comparison(data), [], [], {})
    except DatasetError as error:
        raise StoreError(f"{data.store}: {error}") from None
    known = compared.known
    one = known.summary.isel({CONFIGURATION: compared.best})
    tiles = [_tile(one, card) for card in CARDS]
    name = compared.name if len(known.names) > 1 else ""
    line = line or (f"{compared.line}." if compared.line else _in_numbers(tiles))
    if not int(known.summary["looked_for"].sum()):
        line = caption_of("unseen", target=data.pipeline.target_word)
    notes = sentences(
        *(f"{text.strip()[:1].upper()}{text.strip()[1:]}." for text in data.warnings),
        caption_of(
            "notes", photographs=of_photographs(data.results), boards=data.pipeline.shows_boards,
            own=[name for name in known.axes if is_grid_axis(name, data.results)]),
        report_data.notes_of(data, {}), data.pooled(*known.axes))
    return Answer(
        line, notes, name, tiles, [*first, compared.table()], [*details, *tables_of(data)],
        {"comparison": compared.as_json(), **numbers})


# --------------------------------------------------------------------------------------------------
# Requirements on a report's store: the decision, how far it holds, with which configuration.

#: Decisions, the best first.
ORDER = (Decision.met, Decision.undecided, Decision.not_applicable, Decision.not_met)


def required(
    data: ReportData,
) -> tuple[str, report_data.Comparison, list[Table], list[Table], dict[str, Any]]:
    """Return the decisions on the requirements of a store.

    The configuration that is named meets all requirements, or else follows them farthest along the
    axis of the conditions; of equals it is the one that the comparison on the same images names.

    Returns
    -------
    The answer in one line; the configuration that is named against each; tables of how far, and of
    the decisions, by configuration; those at each condition, of the configuration that is named;
    and for JSON the decision on all together of this configuration, verdicts as `sweep require` and
    limits as `sweep limit` prints them.

    Raises
    ------
    ArgumentError, DatasetError
        As `sweep.analysis.check_requirements`.
    """
    known = report_data.configurations(data, targets=False)
    results = data.results.isel(known.axes)
    table = judged.check_requirements(results, data.require, data.per)
    places = [{name: [k] for name, k in at.items()} for at in known.combinations]
    found = [judged.verdicts(table.isel(at)) for at in places]
    combined = [Decision(int(judged.combined_decision(table["decision"].isel(at).to_numpy())))
                for at in places]
    along, others = report_data.course_of(data)
    # At all other conditions together, and at each of them.
    courses = [((), others), *([(others, ())] if others else [])] if along else []
    limits = [requirement_limits(results, data.require, str(along), per=per, at_all=at_all)
              for per, at_all in courses]
    rows = [[findings.limit_rows(part.isel(at)) for part in limits] for at in places]
    ranks = [(known.wrong[k], ORDER.index(combined[k]),
              *(-sum(row["count"] for row in part) for part in rows[k]))
             for k in range(len(places))]
    equal = [k for k in range(len(places)) if ranks[k] == min(ranks)]
    compared = report_data.comparison(data, equal)
    best = compared.best
    whose = f", with {known.names[best]}" if len(known.names) > 1 else ""
    stopping = data.pipeline.stopping
    if stopping is not None and stopping.kind == "cheapest" and combined[best] is Decision.met:
        # Costs are measured where they are asked for: the store has none.
        whose = caption_of("cheapest", met=combined.count(Decision.met), count=len(places),
                           command=quoted("sweep", "size", data.store))
    line = f"{' and '.join(data.require)}: {_decided(found[best], combined[best])}"
    if limits:
        line += f"; along {along}{_reached(rows[best], others)}"
    every = judged.verdicts(table)
    return (
        f"{line}{whose}.", compared,
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
    parts = [f"{tile['name']} {tile['text']}{f' ({detail})' if (detail := tile['detail']) else ''}"
             for tile in (median, rmse) if not math.isnan(tile["value"])]
    return "; ".join([f"Detected in {detected['text']} ({detected['detail']})", *parts]) + "."


def _tile(one: xr.Dataset, column: Column) -> dict[str, Any]:
    """Return a number of one configuration, with its name and a detail."""
    name, _, unit = column.heading.rpartition(", ")
    unit = {"deg": "\u00b0"}.get(unit, f" {unit}")
    (found,) = column.cells(one)
    known = math.isfinite(found.low) and not math.isnan(found.high)
    details = [f"{tables.number(found.low)} to {tables.number(found.high)}{unit}"] if known else []
    counted = {name: int(one[name]) for name in COUNTED.get(column.variable, ())}
    details += [f"of {count:,} {of.replace('_', ' ')}" for of, count in counted.items()]
    text = tables.number(found.value) + (unit if math.isfinite(found.value) else "")
    if math.isinf(found.value):
        details = ["more than half not solved"]
    return {"name": name, "text": text, "detail": ", ".join(details), **found._asdict(),
            "unit": unit.strip(), **counted}


# --------------------------------------------------------------------------------------------------
# The report written.

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
        Folder into which each figure is written as SVG and PNG, too, and each scene as PNG.
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
        if value is not None and not path_of(name, value).strip():
            raise ArgumentError(name, repr(value), "expected a name")
    models = findings.error_model_files(texts_of("error_model", error_model))
    file = Path(output or f"report.{form or 'html'}")
    form = form or FORMS.get(file.suffix.lower())
    if form not in FORMS.values():
        raise ArgumentError("output", str(file), "expected a file that ends in .html or .md")
    beside = file.with_name(f"{file.stem}_figures") if form == "md" else None
    folders = [folder for folder in (beside, Path(figures) if figures else None) if folder]
    data = report_data.read_report_data(path_of("store", store), require, per, command)
    if models:
        findings.model_findings(data, models)
    output_file.check_output_file(file)
    for folder in folders:
        output_file.check_output_file(folder / "figure.png" if folder.is_dir() else folder)
    if data.results["estimate"].size == 0:
        raise StoreError(f"{data.store}: there are no results")
    found, drawn, scenes = answer(data), figures_of(data), scenes_of(data)
    pictures = {
        f"{figure.name}{suffix}": panels_file(figure.panels, suffix)
        for figure in drawn for suffix in PICTURES if folders}
    pictures |= {f"scene-{number}.png": scene.picture for number, scene in enumerate(scenes, 1)
                 if scene.picture is not None}
    text = page(data.pipeline.heading, found, provenance(data, str(file)), drawn, scenes,
                data.require, "" if beside is None else beside.name)
    for folder in folders:
        with output_file.write_errors_explained(folder):
            folder.mkdir(exist_ok=True)
            for name, content in pictures.items():  # in place of files and links of these names
                write_whole(folder / name, content)
    # Invalid Unicode, which a file's name may hold, is written as a question mark.
    output_file.write_output_file(file, text.encode("utf-8", errors="replace"))
    then = (f"look at {file}", "")
    if data.trade is None and data.setting_axes:
        then = (f"sweep tradeoff {quoted(data.store)}", "what each configuration costs")
    numbers: dict[str, Any] = {
        "report": str(file), "figures": len(drawn), "store": data.store,
        "required": list(data.require), "per": list(data.per)}
    # Into the page's own stream a line more would not be HTML.
    lines = [] if output_file.standard_stream(file) else [
        f"{file}: {tables.plural(len(drawn), 'figure')}", *data.warnings, found.headline]
    return Findings(lines, numbers | found.as_json(), None, 0, then if lines else ("", ""))


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
        # Of digests the first digits.
        **{name: ", ".join(f"{key} {text:.20}" for key, text in value.items())
           if isinstance(value, Mapping) else str(value)
           for part in ("environment", "fingerprint")
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
    return str(tables.template("page.jinja" if folder else "page.html").render(
        title=title, answer=answer, provenance=provenance, figures=figures, scenes=scenes,
        require=require, folder=folder, legend=LEGEND)).rstrip("\n") + "\n"
