"""The walk from the safe end of an axis to the wanted one: what is answered, what is needed still.

The values of the axis stand in the order of the walk: for the smallest size that will do, from the
largest down. Each value's conditions are decided one by one. The answer is the last value of the
walk that meets the requirements, as all values before it do: so a value beyond one that fails, on
the other side of a dip, is no answer.

That makes the error of the answer that of a single decision: it is wrong only if, at the first
value of the walk that truly fails, the condition at which it fails is decided as met. Neither the
number of values nor that of conditions counts (Berger, "Multiparameter hypothesis testing and
acceptance sampling", Technometrics 24, 1982: an intersection-union test; Marcus, Peritz and
Gabriel, Biometrika 63, 1976: tests in a fixed order); the numbers of waves, after each of which a
decision is made, and of alternatives do (Bonferroni).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.analysis.requirements import ERROR_PROBABILITY, Decision, ErrorShares
from sweep.typing import Masks

Decisions = NDArray[np.uint8]


def error_shares(
    confidence: float, *, waves: int, alternatives: int, values: int, conditions: int,
    requirements: int,
) -> ErrorShares:
    """Return the shares of the error probability that each decision of a search may spend.

    Parameters
    ----------
    confidence
        Probability with which no answer fails, and, again, with which no value that is told to
        fail meets all.
    waves
        How often a decision is made at most: once after each wave.
    alternatives, values, conditions, requirements
        How many there are. "Met" is corrected for waves and alternatives, "not met" for all.

    Examples
    --------
    >>> error_shares(0.9, waves=10, alternatives=2, values=5, conditions=2, requirements=1)
    ErrorShares(met=0.1, not_met=0.01)
    """
    met = (1.0 - confidence) / ERROR_PROBABILITY / waves / alternatives
    not_met = met / (values * conditions * requirements)
    return ErrorShares(float(f"{met:.12g}"), float(f"{not_met:.12g}"))


def value_decisions(decision: Decisions) -> Decisions:
    """Return the decision of each value, (..., values), from those of its conditions.

    Not met if any condition is not, met if all are that can be judged; a value of which none can be
    judged meets nothing.

    Parameters
    ----------
    decision
        (..., values, conditions) of `sweep.analysis.requirements.Decision`.
    """
    applicable = decision != Decision.not_applicable
    met = ((decision == Decision.met) | ~applicable).all(axis=-1)
    failing = (decision == Decision.not_met).any(axis=-1) | ~applicable.any(axis=-1)
    return np.where(failing, Decision.not_met, np.where(
        met, Decision.met, Decision.undecided)).astype(np.uint8)


def needed(decision: Decisions, keeps: Masks) -> Masks:
    """Return which cells need more trials, (..., values, conditions).

    Those are the undecided conditions of the values up to the first that fails, or seems to: of
    that one, only the conditions at which it seems to fail. What lies beyond it waits until it is
    decided, and is never needed if it does fail.

    Parameters
    ----------
    decision
        As in `value_decisions`, in the order of the walk.
    keeps
        Of the same shape: where the estimates keep all limits.
    """
    undecided = decision == Decision.undecided
    seems = undecided & ~keeps
    value = value_decisions(decision)
    stops = (value == Decision.not_met) | seems.any(axis=-1)
    before = np.cumsum(stops, axis=-1) == 0
    first = stops & (np.cumsum(stops, axis=-1) == 1) & (value == Decision.undecided)
    return np.asarray((undecided & before[..., None]) | (seems & first[..., None]))


@dataclass(frozen=True, slots=True)
class Walk:
    """How far a walk came; indices along the walk.

    Attributes
    ----------
    answer
        The last value before which, and at which, all is met; -1 for none.
    next
        The value after it, which is not met or undecided; the number of values if there is none.
    isolated
        Values from ``next`` on that fail, or seem to, and beyond which another seems to meet all:
        failures that a search by halving would have stepped over.
    passing
        The values beyond that seem to meet all, or do.
    """

    answer: int
    next: int
    isolated: tuple[int, ...]
    passing: tuple[int, ...]


def walk(decision: Decisions, keeps: Masks) -> Walk:
    """Return how far a walk comes, of one alternative.

    Parameters
    ----------
    decision, keeps
        (values, conditions), as in `needed`.

    Examples
    --------
    >>> met, failed = Decision.met, Decision.not_met
    >>> decision = np.array([[met], [met], [failed], [met], [failed]], np.uint8)
    >>> walk(decision, decision == met)
    Walk(answer=1, next=2, isolated=(2,), passing=(3,))
    """
    value = value_decisions(decision)
    stops = np.flatnonzero(value != Decision.met)
    after = int(stops[0]) if stops.size else len(value)
    applicable = decision != Decision.not_applicable
    seems = (keeps | ~applicable).all(axis=-1) & applicable.any(axis=-1) & (
        value != Decision.not_met)
    passing = [k for k in range(after + 1, len(value)) if seems[k]]
    isolated = [k for k in range(after, passing[-1]) if not seems[k] or k == after] \
        if passing else []
    return Walk(after - 1, after, tuple(isolated), tuple(passing))
