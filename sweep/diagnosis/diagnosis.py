"""The answer to "why is mine wrong": table, sentence, JSON and figure of ranked causes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sweep.diagnosis import inference
from sweep.diagnosis.observations import ZERO_SD_M, Observations, read_observations
from sweep.model.calibration import Calibration
from sweep.report.figure import Figure, write_figure
from sweep.report.output_file import figure_file
from sweep.report.table import UNDECIDED, Column, Findings, Table, Value, number

# Causes in the table and in the figure, and their least posterior probability.
SHOWN, LEAST_SHARE = 6, 0.001

UNEXPLAINED = "No known cause explains these rows"


def diagnose(
    observations: str | os.PathLike[str] | Mapping[str, Sequence[Any]], *,
    camera: str | os.PathLike[str] | Calibration | None = None, size_m: float | None = None,
    dictionary: str = "", refinement: str = "", zero_sd_m: float = ZERO_SD_M, compared: str = "z",
    output: str | None = None,
) -> Findings:
    """Find why a program's poses are not what a tape says.

    Parameters
    ----------
    observations
        A CSV file, or its columns by name: what the program said (``tvec_x_m``, ``tvec_y_m``,
        ``tvec_z_m``, or ``range_m``, ``rvec_x`` ...; or corners, ``corner0_x_px`` ...), what was
        measured (``tape_m`` from lens to marker, ``x_m``, ``y_m``, ``z_m``, ``yaw_deg``), with
        standard deviations (``tape_sd_m``, ``position_sd_m``). Empty cells are unknown.
    camera
        The file of the calibration that the program believes.
    size_m, dictionary
        As the program believes them.
    refinement
        none, subpix, contour or apriltag; its bias and noise are expected.
    zero_sd_m
        Standard deviation of the tape's zero point, in metres.
    compared
        The number that was compared with the tape: "z", the third number of tvec, or "range". Where
        z was measured, too, z was compared with that.
    output
        A PNG or SVG file for the figure of residuals.

    Returns
    -------
    Findings
        Causes by posterior probability, what each predicts, the test that would decide, and one
        sentence. ``numbers`` has the same; ``status`` is 3 if the rows cannot tell.

    Raises
    ------
    ArgumentError
        One line on rows, columns or numbers that cannot be.

    Examples
    --------
    >>> rows = {"range_m": [1.8, 3.6], "tape_m": [1.0, 2.0]}
    >>> found = sweep.diagnose(rows, dictionary="tagStandard41h12")
    >>> found.numbers["causes"][0]["causes"]
    ['size']
    """
    figure = figure_file(output)
    rows = read_observations(
        observations, camera=camera, size_m=size_m, dictionary=dictionary, refinement=refinement,
        zero_sd_m=zero_sd_m, compared=compared)
    ranked = inference.rank(rows)
    shown = [each for each in ranked[:SHOWN] if each.probability >= LEAST_SHARE]
    if figure is not None:
        write_figure([residual_figure(shown)], figure)
    first, open_ = ranked[0], inference.rivals(ranked)
    measurement = inference.next_measurement(rows, first, open_[0]) if open_ else None
    sentence = _sentence(rows, first, open_, measurement)
    causes = Table.of(
        "Causes by posterior probability", ("cause", "probability", "misfit", "its size"),
        [(each.words("name"), number(each.probability), number(each.misfit[0]),
          size_of(each, rows)) for each in shown], words=True)
    tests = Table.of(
        "What they mean, and the test that decides", ("cause", "meaning", "test"),
        [(cause.name, cause.title, cause.test) for cause in dict.fromkeys(
            cause for each in shown for cause in each.causes)], words=True)
    row, component = rows.cells
    value, components = rows.measured[rows.cells], [("x", "y", "z", "tape")[k] for k in component]
    predictions = Table.of(
        "What the tape should have read, m, if it is this cause",
        ("row", "measured", "m",
         *(f"{k}: {each.words('name')}" for k, each in enumerate(shown, 1))),
        [(f"{row[k] + 1}", components[k], f"{value[k]:.4f}",
          *(f"{each.fitted[k]:.4f}" for each in shown)) for k in range(len(row))], stub=2)
    missing = {cause.title: lack for cause in inference.CAUSES if (lack := cause.lacks(rows))}
    numbers = {
        "sentence": sentence, "decided": not open_ and UNEXPLAINED not in sentence,
        "causes": [{
            "causes": sorted(each.names) or [inference.AGREE], "size": size_of(each, rows),
            "title": each.words("title", " and "), "probability": each.probability,
            "misfit": float(each.misfit[0]), "test": each.words("test", "; "),
            "predicted_m": each.fitted} for each in shown],
        "cannot_tell": [each.words("name") for each in (first, *open_)] if open_ else [],
        "measure_next": measurement,
        "measured_m": value, "row": row + 1, "component": components,
        "notes": list(rows.notes), "not_looked_for": missing,
    }
    lines = [*(f"note: {note}" for note in rows.notes), *(
        f"not looked for: {title} (needs {lack})" for title, lack in missing.items())]
    return Findings([causes, tests, predictions, *lines, sentence], numbers,
                    status=0 if numbers["decided"] else UNDECIDED)


def size_of(each: inference.Explanation, rows: Observations) -> str:
    """Return how large the causes are, with one standard deviation."""
    texts = []
    numbers = zip(each.numbers, np.sqrt(np.diagonal(each.covariance)), strict=True)
    for cause, way in zip(each.causes, each.way, strict=True):
        (scale, unit), ratio, spread = cause.unit, way["ratio"][0], way["spread"][0]
        columns = cause.columns(rows, np.ones((1, 1, 3)), np.ones(1))
        sizes = [
            f"said is {ratio / (1.0 + spread * mean):.4g} times the truth "
            f"(± {100.0 * spread * sd:.2g} %)" if spread else
            f"{f'{axis} ' * (len(columns) > 1)}{scale * mean:+.2f} ± {scale * sd:.2g} {unit}"
            * bool(unit) for axis, _, (mean, sd) in zip("xyz", columns, numbers, strict=False)]
        if sizes := [*filter(None, [*sizes, label_of(way)])]:
            named = len(each.causes) > 1 and cause.name != inference.ROWS
            texts.append(f"{cause.name}: " * named + ", ".join(sizes))
    return "; ".join(texts)


def label_of(ways: inference.Ways) -> str:
    """Return the names of the three likeliest ways; empty if the likeliest has none."""
    return " or ".join([*filter(None, dict.fromkeys(ways["label"]))][:3]) * bool(ways["label"][0])


def _sentence(
    rows: Observations, first: inference.Explanation, open_: Sequence[inference.Explanation],
    measurement: Mapping[str, Any] | None,
) -> str:
    """Return the answer in one sentence, with what to do."""
    test, size = first.words("test", "; "), size_of(first, rows)
    # Which row stands apart: its cause is the last of an explanation.
    names = [each.words("name").replace(
        inference.ROWS, f"no listed cause ({label_of(each.way[-1])})") for each in (first, *open_)]
    count = len(rows.cells[0]) + 3 * np.isfinite(rows.yaw_off[:, 0]).sum()
    # Even the likeliest does not explain rows that misfit by 4 standard deviations. A yaw that may
    # be mirrored is expected to cost 1 + 2 ln 2.
    if (inference.ROWS in first.names and not open_) or (
            float(first.misfit[0]) - count > 4.0 * np.sqrt(2.0 * count)):
        nearest = [f"nearest: {names[0]}"] * (inference.ROWS not in first.names)
        return (f"{UNEXPLAINED} ({', '.join(filter(None, [*nearest, size]))}): measure again, look "
                "for a wrong sign of yaw_deg, or state larger standard deviations.")
    if not first.names and (rows.side_px < inference.SIDE_LIMITS_PX[0]).any():
        return ("What was said agrees with what was measured, but no detector reads a square of "
                f"{rows.side_px.min():.2g} px: are size_m and all distances in metres?")
    if not first.names:
        return "All agrees with what is expected: nothing is wrong that these rows could show."
    if measurement is None:
        return (f"It is {first.words('title', ' and ')}{': ' + size if size else ''}. "
                f"To be sure: {test}.")
    between = (f"Cannot tell between {', '.join(names[:-1])} and {names[-1]}, confounded in these "
               "rows: ")
    if measurement["difference"] < inference.DECIDES:
        return f"{between}no further row of this kind would decide; {test}."
    what = {"distance": "the straight distance", "x": "x, to the right of the optical axis",
            "z": "z, along the optical axis"}[measurement["component"]]
    return (f"{between}measure {what} at {number(measurement['distance_m'])} m, "
            f"{measurement['bearing_deg']:.0f} degrees off the axis, where {names[0]} and "
            f"{names[1]} differ by {measurement['difference']:.1f} standard deviations; or {test}.")


def residual_figure(shown: Sequence[inference.Explanation]) -> Figure:
    """Return a figure of measured minus predicted, in standard deviations, by cause and value."""
    heading = Column("measured - predicted, standard deviations", "residual", level=0.0)
    table = Table.of("What each cause leaves unexplained", (
        "cause", "measured value, in the order of the rows", heading.heading), [
        (each.words("name"), k + 1, Value(float(residual)))
        for each in shown for k, residual in enumerate(each.residuals)], stub=2)
    return Figure("residuals", table.caption, "", table, [heading],
                  x=table.headings[1], by="cause")
