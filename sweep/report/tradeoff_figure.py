"""Cost and accuracy of every configuration: the panels, and tables."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import xarray as xr

from sweep.report.charts import Panel, Series, draw_points
from sweep.report.table import Columns, Table, column_texts, each_cell
from sweep.tradeoff.pareto import (
    CRITERIA,
    UNITS,
    advice,
    budget_advice,
    by_condition,
    configuration_label,
    digits,
    heading_of,
    interval,
    mark_front,
)

# --------------------------------------------------------------------------------------------------
# The chart of cost against error of every configuration, with a panel for each condition.

def trade_panels(
    trade: xr.Dataset, criterion: str = "", budget_ms: float | None = None
) -> list[Panel]:
    """Return charts of cost, ms a frame, against an error, both logarithmic, one a condition.

    Points have the numbers of `tradeoff_table`; those of the Pareto front are filled, named and
    joined by steps. The accuracy bound is dashed, the budget dotted.

    Parameters
    ----------
    trade
        As measured by `sweep.tradeoff`.
    criterion, budget_ms
        An error of ``trade``, and the most milliseconds a frame (default: those asked for when it
        was measured).

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms`` or the criterion.
    """
    criterion = criterion or trade_criterion(trade)
    budget_ms = budget_ms if budget_ms is not None else trade.attrs.get("budget_ms")
    names = [str(name) for name in trade["treatment"].values]
    panels = []
    for label, condition in by_condition(mark_front(trade, criterion), criterion):
        cost, error = (
            Series("", values, values, *interval(condition, name))
            for name in ("cost_ms", criterion)
            for values in [condition[name].to_numpy().astype(np.float64)])
        panels.append(Panel(
            label or "Cost and accuracy",
            f"Cost in milliseconds a frame against {heading_of(criterion)}"
            f"{f', {label}' if label else ''}.",
            partial(draw_points, names=names, x=cost, y=error,
                    labels=("cost, ms a frame", heading_of(criterion)),
                    marked=condition["on_front"].to_numpy(), level=_bound(condition, criterion),
                    limit=budget_ms),
            wide=trade[criterion].ndim == 1))
    return panels


def _bound(condition: xr.Dataset, criterion: str) -> float | None:
    """Return the bound of the criterion's quantity, in its unit; None without a bound."""
    quantity = criterion.partition("_")[0]
    values = np.ravel(condition.get(f"bound_{quantity}_{UNITS[quantity]}", np.empty(0)))
    return float(values.min()) if (values := values[np.isfinite(values)]).size else None


# --------------------------------------------------------------------------------------------------
# Tables of cost and accuracy of every configuration, and of the renderers' cost.

STATISTICS = ("bias", "rmse", "rmse_unflipped", "median", "p95", "p99")
"""Statistics in the names of the variables of rotation and range."""

COSTS: Columns = {
    "ms a frame": ("cost_ms", 1.0), "x baseline": ("cost_ratio", 1.0),
    "detected, %": ("detection_rate", 100.0), "flips, %": ("flip_rate", 100.0)}

FEW: Columns = COSTS | {
    "rotation median, deg": ("rotation_median_deg", 1.0),
    "rotation p95, deg": ("rotation_p95_deg", 1.0),
    "range RMSE, %": ("range_rmse_percent", 1.0),
}
"""Columns of a report's table."""

CRITERION = "rotation_p95_deg"
OTHER_CRITERION = "rotation_median_deg"
"""Used if the first is infinite or NaN for every configuration of some condition."""


def tradeoff_table(trade: xr.Dataset, criterion: str, columns: Columns | None = None) -> Table:
    """Return a row for each condition and configuration, the cheapest first.

    Times are in ms a frame, rotations in degrees, ranges in percent; values have their 95 %
    intervals. Columns, by default all, whose variables ``trade`` lacks are left out.

    Raises
    ------
    KeyError
        If ``trade`` lacks ``cost_ms``, ``cost_ratio`` or the criterion.
    """
    found: dict[str, list[str]] = {}
    stub = ["configuration", "condition", "number", "on the front"]
    for label, condition in by_condition(mark_front(trade, criterion), criterion):
        order = np.argsort(condition["cost_ms"].to_numpy(), kind="stable")
        ordered = condition.isel(treatment=order)
        texts = {
            "configuration": [str(name) for name in ordered["treatment"].values],
            "condition": [label] * len(order), "number": [str(k + 1) for k in order],
            "on the front": ["yes" if front else "" for front in ordered["on_front"].values],
        } | column_texts(ordered, columns or _all_columns(criterion))
        if columns is None:
            texts |= _covariance_columns(ordered)
        for heading, values in texts.items():
            found.setdefault(heading, []).extend(values)
    if not any(found["condition"]):
        del found["condition"]
        stub.remove("condition")
    return Table.of(
        "Cost and accuracy, the cheapest first, with 95 % intervals", list(found),
        list(zip(*found.values(), strict=True)), stub=len(stub))


def _all_columns(criterion: str) -> Columns:
    columns = COSTS | {heading_of(criterion): (criterion, 1.0)}
    for quantity, unit in UNITS.items():
        names = [f"{quantity}_{statistic}_{unit}" for statistic in STATISTICS]
        columns |= {heading_of(name): (name, 1.0) for name in names}
        columns[f"{quantity} efficiency"] = f"{quantity}_efficiency", 1.0
    return columns | {"NEES": ("nees_mean", 1.0)}


def _covariance_columns(condition: xr.Dataset) -> dict[str, list[str]]:
    """Return how much each level of the predicted covariance covers, and whether to trust it."""
    found = {}
    if "covariance_coverage" in condition:
        for level in condition["level"].to_numpy().tolist():
            covered = 100 * condition["covariance_coverage"].sel(level=level)
            found[f"in {100 * level:g} % ellipsoid, %"] = list(map(digits, covered.to_numpy()))
    if "covariance_trusted" in condition:
        found["covariance"] = [
            ("trusted" if trusted else "not trusted") if count else "-" for trusted, count in zip(
                condition["covariance_trusted"].to_numpy(), condition["nees_count"].to_numpy(),
                strict=True)]
    return found


def trade_criterion(trade: xr.Dataset) -> str:
    """Return the error that ranks configurations: that asked for, if it is finite everywhere."""
    asked = str(trade.attrs.get("criterion", CRITERION))
    names = [name for name in (asked, CRITERION, OTHER_CRITERION)
             if name in CRITERIA and name in trade]
    return next(
        (name for name in names
         if np.isfinite(trade[name].values).any(axis=trade[name].dims.index("treatment")).all()),
        names[0],
    )


def trade_table_and_text(trade: xr.Dataset) -> tuple[Table, str]:
    """Return the table of a report's figure, and its caption."""
    criterion, budget_ms = trade_criterion(trade), trade.attrs.get("budget_ms")
    lines = [*([] if budget_ms is None else budget_advice(trade, criterion, budget_ms)),
             *advice(trade, criterion)]
    return tradeoff_table(trade, criterion, FEW), (
        f"Cost of detection and estimation, ms a frame, against {heading_of(criterion)}, of each "
        f"configuration on the same {trade.attrs.get('poses', 0):,} images, with 95 % intervals. "
        "Points have the numbers of the table; filled ones are on the Pareto front: no other "
        f"configuration is both cheaper and better. {'. '.join(lines)}.")


WINDOWS = {
    "auto": "searched: the marker's surroundings",
    "full": "searched: the whole frame",
    "mixed": "searched: the whole frame or the marker's surroundings, as each setting needs",
}


def headlines(trade: xr.Dataset, criterion: str) -> list[str]:
    """Return the title, the facts of the measurement, and what the table's words mean."""
    attrs = trade.attrs
    return [
        str(attrs.get("title", "")),
        (f"{attrs.get('poses')} poses; {WINDOWS.get(str(attrs.get('window')), '')}; baseline: "
         f"{attrs.get('baseline')}; ms a frame: detection and estimation"),
        (f"on the front: no other configuration is both cheaper and better in {criterion}; RMSE "
         "and bias: of the solved poses; median, p95, p99: a pose that is not solved counts as an "
         "infinite error"),
    ]


IMAGES = {"ms an image": "render_ms", "x exact": "render_ratio", "grey RMS": "grey_rms",
          "grey max": "grey_max"}
CHANGES = {
    "detection differs, %": ("detection_disagreement", 100.0),
    "corner RMS px": ("corner_shift_rms_px", 1.0),
    "range bias %": ("range_bias_percent", 1.0),
    "rotation RMS deg": ("rotation_shift_deg", 1.0),
}
"""Heading -> variable of the images; heading -> variable of a configuration, and its factor."""


def renderer_table(renderers: xr.Dataset) -> Table:
    """Return a table of the renderers in ``cost/renderers``.

    First the images: cost, and difference from the exact image. Then for each configuration the
    share of scenes in which the marker is detected in only one of the two images, and the change
    of corners, range and rotation, paired on the scenes that both solve.
    """
    return Table.of(
        "Other renderers against exact images", ["renderer", *IMAGES, "configuration", *CHANGES],
        list(_renderer_rows(renderers)), words=True)


def _renderer_rows(renderers: xr.Dataset) -> Iterator[list[str]]:
    settings = [str(dim) for dim in renderers["range_bias_percent"].dims if dim != "renderer"]
    for name in renderers["renderer"].values.tolist():
        one = renderers.sel(renderer=name)
        images = [digits(float(one[variable])) for variable in IMAGES.values()]
        if name == renderers.attrs["reference"]:
            yield [name, *images, "", *[""] * len(CHANGES)]
            continue
        for at, cell in each_cell(one, settings):
            yield [name, *images, configuration_label(at), *(
                digits(float(cell[variable]) * factor) for variable, factor in CHANGES.values())]
