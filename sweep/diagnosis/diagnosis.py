"""The answer to "why is mine wrong": table, sentence, JSON and figure of ranked causes."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sweep.diagnosis.causes import AGREE
from sweep.diagnosis.inference import (
    DECIDES,
    Explanation,
    Measurement,
    Ranking,
    measured,
    next_measurement,
    rank,
)
from sweep.diagnosis.observations import (
    READABLE_PX,
    ZERO_SD_M,
    Observations,
    read_observations,
)
from sweep.model.calibration import Calibration
from sweep.report.figure import Figure, write_figure
from sweep.report.output_file import figure_file
from sweep.report.table import UNDECIDED, Column, Findings, Table, Value, number

SHOWN = 6
"""Causes in the table and in the figure."""

LEAST_SHARE = 0.001
"""Posterior probability from which on a cause is shown."""

COMPONENTS = ("x", "y", "z", "tape")

SURPRISING = 16.0
"""Squared misfit beyond the number of rows, in units of its standard deviation sqrt(2 d), at which
even the likeliest cause does not explain the rows: (misfit - d)² > 16 * 2 d."""


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
        What was compared with the tape: "z", the third number of tvec, or "range".
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
    ranking = rank(rows)
    if figure is not None:
        write_figure([residual_figure(rows, ranking)], figure)
    return findings(rows, ranking)


def findings(rows: Observations, ranking: Ranking) -> Findings:
    """Return the answer of a ranking."""
    first, rivals = ranking.explanations[0], ranking.rivals
    measurement = next_measurement(rows, first, rivals[0]) if rivals else None
    sentence = _sentence(rows, ranking, measurement)
    shown = _shown(ranking)
    causes = Table.of(
        "Causes by posterior probability", ("cause", "probability", "misfit", "its size"),
        [(name_of(each), number(share), number(_misfit(each)), size_of(each, rows))
         for each, share in shown], words=True)
    single = {cause.name: cause for each, _ in shown for cause in each.causes}
    tests = Table.of(
        "What they mean, and the test that decides", ("cause", "meaning", "test"),
        [(cause.name, cause.title, cause.test) for cause in single.values()], words=True)
    row, component, value = measured(rows)
    predictions = Table.of(
        "What the tape should have read, m, if it is this cause",
        ("row", "measured", "m", *(f"{k + 1}: {name_of(each)}"
                                   for k, (each, _) in enumerate(shown))),
        [(f"{row[k] + 1}", COMPONENTS[component[k]], f"{value[k]:.4f}",
          *(f"{each.fitted[k]:.4f}" for each, _ in shown)) for k in range(len(row))], stub=2)
    numbers = {
        "sentence": sentence, "decided": not rivals,
        "causes": [{
            "causes": sorted(each.names) or [AGREE], "title": title_of(each),
            "probability": float(share), "size": size_of(each, rows), "misfit": _misfit(each),
            "test": _test(each), "predicted_m": each.fitted} for each, share in shown],
        "cannot_tell": [name_of(each) for each in (first, *rivals)] if rivals else [],
        "measure_next": None if measurement is None else measurement._asdict(),
        "measured_m": value, "row": row + 1, "component": [COMPONENTS[k] for k in component],
        "notes": list(rows.notes),
        "not_looked_for": ranking.missing,
    }
    lines = [f"note: {note}" for note in rows.notes]
    if ranking.missing:
        lines.append("not looked for: " + "; ".join(
            f"{title} (needs {lack})" for title, lack in ranking.missing.items()))
    return Findings([causes, tests, predictions, *lines, sentence], numbers,
                    status=UNDECIDED if rivals else 0)


def name_of(each: Explanation) -> str:
    """Return the names of an explanation's causes."""
    return " and ".join(cause.name for cause in each.causes)


def title_of(each: Explanation) -> str:
    """Return an explanation in words."""
    return " and ".join(cause.title for cause in each.causes)


def size_of(each: Explanation, rows: Observations) -> str:
    """Return how large the causes are, with one standard deviation."""
    texts, first, k = [], 0, each.best
    for cause, spread, ratio in zip(
            each.causes, each.correction.spread[k], each.correction.ratio[k], strict=True):
        width = cause.columns(rows, np.ones((1, 1, 3)), np.ones(1)).shape[-1]
        for number_of_column in range(first, first + width):
            mean = each.numbers[k, number_of_column]
            sd = math.sqrt(each.covariance[k, number_of_column, number_of_column])
            scale, unit = cause.unit
            texts.append(f"said is {ratio / (1.0 + spread * mean):.4g} times the truth "
                         f"(± {100.0 * spread * sd:.2g} %)" if spread else
                         f"{scale * mean:+.3g} ± {scale * sd:.2g} {unit}")
        first += width
    label = each.correction.labels[k]
    return "; ".join([*texts, *([label] if label else [])])


def _misfit(each: Explanation) -> float:
    return float(each.misfit[each.best])


def _test(each: Explanation) -> str:
    return "; ".join(cause.test for cause in each.causes)


def _shown(ranking: Ranking) -> list[tuple[Explanation, float]]:
    pairs = list(zip(ranking.explanations, ranking.probability.tolist(), strict=True))
    return [pair for pair in pairs[:SHOWN] if pair[1] >= LEAST_SHARE] or pairs[:1]


def _sentence(rows: Observations, ranking: Ranking, measurement: Measurement | None) -> str:
    """Return the answer in one sentence, with what to do."""
    first, rivals = ranking.explanations[0], ranking.rivals
    count = len(measured(rows)[0])
    if (_misfit(first) - count) ** 2 > 2.0 * SURPRISING * count and _misfit(first) > count:
        return (f"No known cause explains these rows: even {name_of(first)} misses them by "
                f"{np.sqrt(_misfit(first) / count):.2g} standard deviations; look for a mistaken "
                "row, or state a larger tape_sd_m.")
    if not first.names and (rows.side_px < READABLE_PX).any():
        return ("What was said agrees with what was measured, but no detector reads so small a "
                "square: are size_m and all distances in metres?")
    if not first.names:
        return ("The numbers agree with what is expected: nothing is wrong that these rows could "
                "show.")
    if measurement is None:
        size = size_of(first, rows)
        return f"It is {title_of(first)}{': ' + size if size else ''}. To be sure: {_test(first)}."
    names = [name_of(first), *(name_of(each) for each in rivals)]
    confounded = {"size", "focal_length"} <= set(names) and not np.isfinite(
        rows.position[:, :2]).any()
    open_ = f"Cannot tell between {', '.join(names[:-1])} and {names[-1]}: " + (
        "size and focal length are confounded, distances show their product alone; "
        if confounded else "")
    if measurement.difference < DECIDES:
        return (f"{open_}no further row of this kind would decide (at best "
                f"{measurement.difference:.1f} standard deviations); {_test(first)}.")
    what = {"distance": "the straight distance", "x": "x, to the right of the optical axis",
            "z": "z, along the optical axis"}[measurement.component]
    return (f"{open_}measure {what} at {number(measurement.distance_m)} m, "
            f"{measurement.bearing_deg:.0f} degrees off the axis, where {names[0]} and {names[1]} "
            f"differ by {measurement.difference:.1f} standard deviations; or {_test(first)}.")


def residual_figure(rows: Observations, ranking: Ranking) -> Figure:
    """Return a figure of measured minus predicted, in standard deviations, by cause and value."""
    _, _, value = measured(rows)
    heading = Column("measured - predicted, standard deviations", "residual", level=0.0)
    table = Table.of("What each cause leaves unexplained", (
        "cause", "measured value, in the order of the rows", heading.heading), [
        (name_of(each), k + 1, Value(float(residual)))
        for each, _ in _shown(ranking) for k, residual in enumerate(
            (value - each.fitted) / np.sqrt(each.predicted.variance[each.best]))], stub=2)
    return Figure("residuals", table.caption, "", table, [heading],
                  x=table.headings[1], by="cause")
