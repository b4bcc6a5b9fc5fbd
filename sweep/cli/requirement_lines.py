"""What ``sweep require`` prints: a line for each requirement, or Markdown with all conditions."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from sweep.analysis.dimensions import DRAWS, axes_of, configuration_axes
from sweep.analysis.replicates import is_replicated
from sweep.analysis.requirements import Decision
from sweep.analysis.verdicts import Verdict, described
from sweep.errors import ArgumentError
from sweep.messages import label, nearest, plain
from sweep.plan.cell_selection import parse_selection
from sweep.plan.sobol import REPLICATES

if TYPE_CHECKING:
    from sweep.analysis.regressions import Regression
    from sweep.plan.experiment import Pipeline

MAX_ROWS = 500
"""Conditions that a table in Markdown lists."""

WORDS = {Decision.met: "met", Decision.not_met: "not met", Decision.undecided: "undecided",
         Decision.not_applicable: "nothing to judge"}


def selected(results: xr.Dataset, at: Sequence[str], pipeline: Pipeline) -> xr.Dataset:
    """Return results at some values of axes, or of parameters that go together along one.

    Raises
    ------
    ArgumentError
        For an axis or a value that the store does not have.
    """
    for name, value in parse_selection(",".join(at), pipeline).items() if at else ():
        axis = str(results[name].dims[0]) if name in results.coords and (
            results[name].ndim == 1) else ""
        if axis not in axes_of(results):
            axes = axes_of(results)
            raise ArgumentError("at", name, f"no such axis{nearest(name, axes)}; "
                                f"there are {', '.join(axes)}")
        values = results[name].to_numpy()
        if values.dtype.kind in "fiu" and isinstance(value, int | float):
            same = np.isclose(values, value, rtol=1e-9, atol=0.0)
        else:
            same = values.astype(str) == label(value)
        if not same.any():
            shown = ", ".join(label(each) for each in values[:20].tolist())
            raise ArgumentError("at", f"{name}={label(value)}", f"no such value; there are {shown}")
        results = results.isel({axis: np.nonzero(same)[0]})
    return results


def pooled_axes(results: xr.Dataset, per: Sequence[str]) -> list[str]:
    """Return the axes of the scene that are pooled."""
    named = {*per, DRAWS, *configuration_axes(results)}
    return [name for name in axes_of(results) if name not in named and results.sizes[name] > 1]


def number(value: float) -> str:
    """Return a number with four digits.

    >>> number(0.99871), number(math.nan), number(math.inf)
    ('0.9987', 'none', 'infinite')
    """
    if math.isnan(value):
        return "none"
    return "infinite" if math.isinf(value) else f"{value:.4g}"


def interval(low: float, high: float) -> str:
    """Return an interval as text; an end that does not exist is a question mark.

    >>> interval(0.5, math.nan)
    '0.5 to ?'
    """
    return " to ".join("?" if math.isnan(each) else number(each) for each in (low, high))


def text(
    found: Sequence[Verdict], worse: Sequence[Regression], pooled: Sequence[str],
    usual: Sequence[str] = (),
) -> Iterator[str]:
    """Yield a line for each requirement and configuration, and one for each comparison.

    ``pooled`` axes are named, and ``usual`` ones, which nobody asked to be conditions.
    """
    width = max((len(each.requirement) for each in found), default=0)
    for each in found:
        yield (f"{WORDS[each.decision]:10} {each.requirement:{width}}  {_value(each)}"
               f"{_where(each)}{_configuration(each.configuration)}{_needs(each)}")
    for one in worse:
        state = "worse" if one.worse else "not worse"
        yield (f"{state:10} {one.quantity}: {number(one.difference)} "
               f"({interval(one.low, one.high)}){' ' * bool(one.units)}{one.units}, new minus old"
               f"{_at(one.condition)}{_configuration(one.configuration)}")
    if usual:
        yield f"at each value of {', '.join(usual)}; --per '' pools all"
    if pooled:
        yield f"pooled over {', '.join(pooled)}; --per keeps axes apart as conditions"


def _value(each: Verdict) -> str:
    if each.decision is Decision.not_applicable:
        return "no number"
    if each.value == math.inf and each.low == math.inf:
        return "infinite: too many poses are not solved"
    unit = {"1": "", "percent": " %", "degree": "°"}.get(each.units, f" {each.units}")
    return f"{number(each.value)} ({interval(each.low, each.high)}){unit}"


def _where(each: Verdict) -> str:
    counts, total = each.counts, each.conditions
    if not each.condition or total == 0:
        return ""
    failing = counts.get(each.decision, 0)
    share = "" if total == 1 else (
        f", the worst of {total}" if each.decision is Decision.met
        else f"; {WORDS[each.decision]} at {failing} of {total}")
    return f"{_at(each.condition)}{share}"


def _at(condition: Mapping[str, Any]) -> str:
    return f" at {described(condition)}" if condition else ""


def _configuration(configuration: Mapping[str, Any]) -> str:
    return f" [{described(configuration)}]" if configuration else ""


def _needs(each: Verdict) -> str:
    if each.decision is not Decision.undecided or math.isnan(each.draws_needed):
        return ""
    if math.isinf(each.draws_needed):
        return f"; {each.draws:,} draws, and no number would tell so small a difference"
    return f"; {each.draws:,} draws, about {each.draws_needed:,.0f} would tell"


def more_draws(found: Sequence[Verdict], results: xr.Dataset, store: str) -> str:
    """Return the command that makes about as many draws as are needed."""
    trials = results.sizes.get(DRAWS, 1)
    factors = [each.draws_needed / each.draws for each in found
               if each.draws > 0 and math.isfinite(each.draws_needed)]
    if not factors or max(factors) <= 1.0:
        return f"sweep report {shlex.quote(store)}"
    count = math.ceil(trials * max(factors))
    if is_replicated(results):
        count = math.ceil(count / REPLICATES) * REPLICATES
    return (f"sweep run {shlex.quote(store)} --set trial={count} --store more.zarr "
            f"--reuse {shlex.quote(store)}")


def markdown(
    found: Sequence[Verdict], worse: Sequence[Regression], table: xr.Dataset | None,
    decision: Decision, pooled: Sequence[str],
) -> str:
    """Return Markdown: the verdict, a row for each requirement, and one for each condition."""
    out = [f"### Requirements: {WORDS[decision]}", ""]
    if found:
        rows = [[WORDS[each.decision], f"`{each.requirement}`",
                 described(each.configuration), _value(each), described(each.condition),
                 f"{each.counts.get(Decision.met, 0)} of {each.conditions}",
                 _needs(each).removeprefix("; ")] for each in found]
        out += _table(["", "requirement", "configuration", "value (interval)", "worst condition",
                       "conditions met", "draws"], rows)
    if worse:
        rows = [["worse" if one.worse else "not worse", one.quantity,
                 described(one.configuration), f"{number(one.difference)} {one.units}",
                 interval(one.low, one.high), described(one.condition)] for one in worse]
        out += ["", "Compared with the older store, pose by pose, new minus old:", "",
                *_table(["", "quantity", "configuration", "difference", "interval", "condition"],
                        rows)]
    if pooled:
        out += ["", f"Pooled over {', '.join(pooled)}."]
    if table is not None and len(found) < table["decision"].size:
        out += ["", "<details><summary>All conditions</summary>", "", *_conditions(table), "",
                "</details>"]
    return "\n".join(out)


def _conditions(table: xr.Dataset) -> list[str]:
    """Return a row for each configuration and condition, a column for each requirement."""
    dims = [str(dim) for dim in table["decision"].dims if dim != "requirement"]
    texts = [str(each) for each in table["requirement"].values]
    rows: list[list[str]] = []
    for at in np.ndindex(*(table.sizes[name] for name in dims)):
        if len(rows) == MAX_ROWS:
            rows.append([f"and {math.prod(table.sizes[name] for name in dims) - MAX_ROWS:,} more",
                         *[""] * (len(dims) + len(texts) - 1)])
            break
        cell = table.isel(dict(zip(dims, at, strict=True)))
        row = [described({name: cell[name].item()}).partition("=")[2] for name in dims]
        for k in range(len(texts)):
            value, low, high = (float(cell[name][k]) for name in ("value", "low", "high"))
            state = Decision(int(cell["decision"][k]))
            row.append(f"{WORDS[state]}: {number(value)} ({interval(low, high)})")
        rows.append(row)
    return _table([*dims, *(f"`{each}`" for each in texts)], rows)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(plain(each, 200).replace("|", "\\|") for each in cells) + " |"

    return [line(headings), line(["---"] * len(headings)), *map(line, rows)]
