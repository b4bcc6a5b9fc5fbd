"""What ``sweep size`` prints: the answer as sentences, a table of the alternatives, JSON."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sweep.analysis.requirements import Decision
from sweep.analysis.verdicts import described
from sweep.cli.requirement_lines import interval, number
from sweep.messages import plain
from sweep.report.formatting import plural
from sweep.tradeoff.labels import digits

if TYPE_CHECKING:
    from sweep.analysis.choices import Answer, Cause
    from sweep.tradeoff.choice_search import Choice

FAILS = {Decision.not_met: "is not met", Decision.undecided: "is undecided",
         Decision.met: "is met", Decision.not_applicable: "cannot be judged"}

UNITS = {"1": "", "percent": " %", "degree": "°"}


def sentences(choice: Choice) -> list[str]:
    """Return the answer: what is chosen, what is not and why, and what else is to be known."""
    out = [_first(choice)]
    if choice.next is not None:
        out.append(_next(choice, choice.answers[choice.next]))
    elif choice.best is not None and choice.rule.along:
        out.append(f"all values of {choice.rule.along} on the grid meet them: a "
                   f"{_comparative(choice)} one may do, too")
    elif choice.best is not None:
        out.append("it is the cheapest of all alternatives: there is no cheaper one that fails")
    out += [line for answer in choice.answers for line in _isolated(choice, answer)]
    out += list(_over_budget(choice))
    return out


def _comparative(choice: Choice) -> str:
    return "larger" if choice.rule.largest else "smaller"


def _first(choice: Choice) -> str:
    """Return the sentence that says what is chosen."""
    rule = choice.rule
    wish = ("largest" if rule.largest else "smallest") if rule.along else "cheapest"
    what = (f"{plural(len(rule.requirements), 'requirement')} at "
            f"{plural(choice.conditions, 'condition')}, with {100 * rule.confidence:g} % "
            "confidence")
    if choice.best is not None:
        answer, cost = choice.answers[choice.best], choice.costs[choice.best]
        ms = "" if cost is None else f", {digits(cost.ms)} ms a frame"
        side = "smaller" if rule.largest else "larger"
        meets = f"it and every {side} one of the grid meet" if rule.along else "it meets"
        return f"{_name(choice, answer, answer.value)} is the {wish} choice{ms}: {meets} {what}"
    if any(answer.met for answer in choice.answers):
        return f"no choice meets {what}, within {choice.budget_ms:g} ms a frame"
    near = [(answer.nearest, answer) for answer in choice.answers if answer.nearest is not None]
    start = f"no choice meets {what}" if not choice.is_undecided else (
        f"undecided: no choice is known to meet {what}")
    if not near:
        return start
    nearest, answer = min(near, key=lambda each: each[0].excess)
    first = "" if nearest.value == answer.next or not rule.along else (
        f"{_name(choice, answer, answer.next)}: {reason(answer.next_cause)}; ")
    return (f"{start}; {first}nearest is {_name(choice, answer, nearest.value)}: "
            f"{reason(nearest.cause)}")


def _next(choice: Choice, answer: Answer) -> str:
    """Return the sentence on the next choice, which fails."""
    cause = answer.next_cause
    if not choice.rule.along:
        return f"the next cheaper, {described(answer.alternative)}, is no choice: {reason(cause)}"
    return (f"the next {_comparative(choice)}, {number(_float(answer.next))}, is no choice: "
            f"{reason(cause)}")


def _isolated(choice: Choice, answer: Answer) -> Iterator[str]:
    """Yield the sentence on failures with values beyond that seem to meet all."""
    if not answer.isolated:
        return
    beside = f" ({described(answer.alternative)})" if answer.alternative else ""
    passing = ", ".join(map(number, answer.passing))
    failing = "; ".join(f"{number(value)}: {_scanned(cause)}" for value, cause in answer.isolated)
    seem = f"{passing} {'seems' if len(answer.passing) == 1 else 'seem'} to meet all"
    if answer.met:
        side = "below" if choice.rule.largest else "above"
        yield f"not monotonic{beside}: {seem}, too, but {side} fails {failing}"
    else:
        yield (f"not monotonic{beside}: {seem}; to ask for these, end the axis before what fails: "
               f"{failing}")


def _scanned(cause: Cause) -> str:
    """Return why a value is passed over that needs no decision, for another one fails before it."""
    if cause.decision is Decision.undecided and not math.isnan(cause.value):
        return (f"{cause.requirement} seems not to be met: {number(cause.value)}, "
                f"{cause.draws:,} draws")
    return reason(cause)


def _over_budget(choice: Choice) -> Iterator[str]:
    """Yield a sentence for each alternative that would be better but for its cost."""
    if choice.budget_ms is None:
        return
    for k, answer in enumerate(choice.answers):
        cost = choice.costs[k]
        if answer.met and cost is not None and not choice.within_budget(k):
            where = f" at {described(cost.condition)}" if cost.condition else ""
            yield (f"{_name(choice, answer, answer.value)} takes {digits(cost.ms)} ms "
                   f"({digits(cost.low)} to {digits(cost.high)}){where}: not within "
                   f"{choice.budget_ms:g} ms")


def _name(choice: Choice, answer: Answer, value: float | None) -> str:
    """Return a choice as text."""
    along = {} if value is None else {choice.rule.along: value}
    return described({**along, **answer.alternative})


def _float(value: float | None) -> float:
    return math.nan if value is None else value


def reason(cause: Cause | None) -> str:
    """Return why a choice fails: the requirement, its value with interval, the condition."""
    if cause is None:
        return ""
    unit = UNITS.get(cause.units, f" {cause.units}")
    at = f" at {described(cause.condition)}" if cause.condition else ""
    if math.isnan(cause.value):
        what = "no pose to judge it by" if cause.decision is Decision.not_applicable else (
            "too few poses have such a number")
        return f"{cause.requirement} {FAILS[cause.decision]}: {what}{at}"
    more = ""
    if cause.decision is Decision.undecided:
        more = f"; {cause.draws:,} draws, " + (
            "and no number would tell so small a difference" if math.isinf(cause.draws_needed)
            else f"about {cause.draws_needed:,.0f} would tell: raise choose.max_trials")
    return (f"{cause.requirement} {FAILS[cause.decision]}: {number(cause.value)} "
            f"({interval(cause.low, cause.high)}){unit}{at}{more}")


def _rows(choice: Choice) -> tuple[list[str], list[list[str]]]:
    """Return headings and a row for each alternative, the best first."""
    along = choice.rule.along
    headings = [*choice.rule.among, *([along, "next"] if along else ["meets all"]), "ms a frame",
                "why not better" if along else "why not"]
    rows = []
    for k in _order(choice):
        answer, cost = choice.answers[k], choice.costs[k]
        mark = "*" if k in choice.front else ""
        value = [number(answer.value) if answer.value is not None else "none",
                 "none" if answer.next is None else number(answer.next)] if along else [
                     "yes" if answer.met else "no"]
        ms = "" if cost is None else f"{digits(cost.ms)}{mark}"
        rows.append([*map(str, answer.alternative.values()), *value, ms,
                     reason(answer.next_cause)])
    return headings, rows


def _order(choice: Choice) -> list[int]:
    """Return the alternatives in the order of the table: those that meet all, best first."""
    def rank(k: int) -> tuple[bool, float, float]:
        answer, cost = choice.answers[k], choice.costs[k]
        value = 0.0 if answer.value is None else answer.value
        return (not answer.met, -value if choice.rule.largest else value,
                math.inf if cost is None else cost.ms)

    return sorted(range(len(choice.answers)), key=rank)


def poses_line(choice: Choice) -> str:
    """Return how many poses the search took, and a grid of equally many trials."""
    factor = choice.grid_poses / max(choice.poses, 1)
    return (f"{choice.poses:,} poses; {choice.most_trials:,} trials of every cell, which the "
            f"hardest one took, are {choice.grid_poses:,} poses ({factor:.1f} times as many)")


def text(choice: Choice) -> Iterator[str]:
    """Yield the lines: sentences, the table if there are several alternatives, poses."""
    yield from sentences(choice)
    if len(choice.answers) > 1:
        headings, rows = _rows(choice)
        widths = [max(map(len, column)) for column in zip(headings, *rows, strict=True)]
        yield ""
        for row in (headings, *rows):
            yield "  ".join(cell.ljust(width)
                            for cell, width in zip(row, widths, strict=True)).rstrip()
        if choice.front:
            yield "* no other alternative is as good and cheaper"
        yield ""
    yield poses_line(choice)


def markdown(choice: Choice) -> str:
    """Return Markdown: the sentences as a list, and the table."""
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(plain(each, 300).replace("|", "\\|") for each in cells) + " |"

    headings, rows = _rows(choice)
    first, *others = sentences(choice)
    return "\n".join([
        f"**{first}**", "", *(f"- {each}" for each in (*others, poses_line(choice))), "",
        line(headings), line(["---"] * len(headings)), *map(line, rows)])


def as_json(choice: Choice) -> dict[str, Any]:
    """Return what JSON has: a number that does not exist is null, an infinite one text."""
    alternatives = [
        {**dataclasses.asdict(answer), "cost": None if cost is None else dataclasses.asdict(cost),
         "on_front": k in choice.front, "within_budget": choice.within_budget(k)}
        for k, (answer, cost) in enumerate(zip(choice.answers, choice.costs, strict=True))]
    best = None if choice.best is None else choice.answers[choice.best]
    found: dict[str, Any] = _plain({
        "answer": None if best is None else {**best.alternative, **(
            {choice.rule.along: best.value} if choice.rule.along else {})},
        "decision": "met" if best is not None else
        "undecided" if choice.is_undecided else "not_met",
        "sentences": sentences(choice),
        "best": choice.best, "next": choice.next, "along": choice.rule.along,
        "confidence": choice.rule.confidence, "conditions": choice.conditions,
        "budget_ms": choice.budget_ms, "alternatives": alternatives,
        "poses": choice.poses, "grid_poses": choice.grid_poses,
        "most_trials": choice.most_trials, "store": choice.store,
        "warnings": list(choice.notes),
    })
    return found


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, Decision):
        return value.name
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value
