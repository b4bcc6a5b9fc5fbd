"""What is wrong with a choice before anything is computed, a line each."""

from __future__ import annotations

import math

from sweep.analysis.requirable import MIN_DRAWS
from sweep.analysis.requirements import ErrorShares, Requirement, read_requirements
from sweep.messages import shown
from sweep.plan.axes import TRIAL
from sweep.plan.choice_rule import SECTION, ChoiceRule
from sweep.plan.experiment import Pipeline


def choice_faults(pipeline: Pipeline, rule: ChoiceRule, shares: ErrorShares) -> list[str]:
    """Return what makes a choice impossible.

    Those are requirements that cannot be, and those that ``max_trials`` cannot show to be met even
    if no trial fails.
    """
    required, faults = read_requirements(rule.requirements)
    lines = [f"require.all = {shown(text)}: {problem}" for text, problem in faults]
    kept = {TRIAL, rule.along, *rule.among, *rule.per}
    pooled = math.prod(len(axis) for axis in pipeline.axes if axis.name not in kept)
    for each in required:
        least = math.ceil(least_draws(each, shares.met) / pooled)
        if least > rule.max_trials:
            lines.append(
                f"{SECTION}.max_trials = {rule.max_trials}: expected at least {least:,}: fewer "
                f"cannot show {each.text} with this confidence, even if all meet it")
    return lines


def least_draws(requirement: Requirement, share: float) -> int:
    """Return the draws below which a requirement cannot be decided as met.

    Of a rate, with no failure Clopper and Pearson's end is the tail's n-th root; a quantile needs
    an order statistic beyond; means are not decided below `MIN_DRAWS`.

    Examples
    --------
    >>> from sweep.analysis.requirements import parse_requirement
    >>> least_draws(parse_requirement("detection >= 0.99"), 1.0)
    368
    """
    what = requirement.requirable
    tail = (1.0 - what.level) * share / 2.0
    if what.is_rate:
        good = requirement.limit if requirement.at_least else 1.0 - requirement.limit
        return math.ceil(math.log(tail) / math.log(good)) if 0.0 < good < 1.0 else 1
    if what.percent is not None:
        share_below = what.percent / 100.0
        return math.ceil(math.log(tail) / math.log(
            1.0 - share_below if requirement.at_least else share_below))
    return MIN_DRAWS
