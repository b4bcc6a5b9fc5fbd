"""When sampling stops: the waves in which trials come, and what a section [search] says."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

# --------------------------------------------------------------------------------------------------
# Numbers of trials at which waves end: after each, it is decided what else is needed.

GROWTH = 4
"""A wave has about one trial for so many of those before it, at least one unit."""


def wave_ends(max_trials: int, unit: int) -> tuple[int, ...]:
    """Return the numbers of trials at which waves end: multiples of a unit, and ``max_trials``.

    Examples
    --------
    >>> wave_ends(600, 50)
    (50, 100, 150, 200, 250, 350, 450, 600)
    >>> wave_ends(30, 50), wave_ends(120, 50)
    ((30,), (50, 100, 120))
    """
    ends: list[int] = []
    end = unit
    while end < max_trials:
        ends.append(end)
        end += unit * max(1, math.ceil(end / unit / GROWTH))
    return (*ends, max_trials)


# --------------------------------------------------------------------------------------------------
# What a search is for. None of it is part of the identity of a cell: the draws of a trial depend
# on its number alone, and a search decides only which trials are computed.

SEARCH = "search"
"""The section."""

CHOICES = ("smallest", "largest", "cheapest")
KINDS = ("along", *CHOICES, "precision")
"""Keys that say what is searched, one in a section."""


@dataclass(frozen=True, slots=True)
class StoppingRule:
    """Trials come in waves until what is searched is known.

    Attributes
    ----------
    kind
        One of `KINDS`: how far along an axis requirements are met, the smallest or largest value
        of an axis or the cheapest configuration that meets them, or intervals of a width.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    unit
        Trials of every cell in the first wave.
    along
        The scene axis that is searched along; empty for the cheapest, and for a precision.
    among
        The axes of which every combination of values, an alternative, is a choice of its own.
    per
        The scene axes of which every combination of values has an answer of its own: a limit, or a
        precision. What stands in none of ``along``, ``among``, ``per``, ``at_all`` is pooled.
    at_all
        The scene axes at every combination of whose values the requirements must hold.
    requirements
        What must hold, as texts; without a budget, which no trial decides.
    precision
        Name of each quantity, and the half-width of its interval: of a rate as it is, else
        relative to the value.
    """

    kind: str
    max_trials: int
    unit: int
    along: str = ""
    among: tuple[str, ...] = ()
    per: tuple[str, ...] = ()
    at_all: tuple[str, ...] = ()
    requirements: tuple[str, ...] = ()
    precision: tuple[tuple[str, float], ...] = ()

    @property
    def is_choice(self) -> bool:
        """Whether something is chosen."""
        return self.kind in CHOICES

    @property
    def largest(self) -> bool:
        """Whether the largest value of the axis is chosen."""
        return self.kind == "largest"

    @property
    def ends(self) -> tuple[int, ...]:
        """Numbers of trials at which waves end, and decisions are made."""
        return wave_ends(self.max_trials, self.unit)

    def looser(self, begun: StoppingRule) -> str:
        """Return why a store that was begun under another rule cannot be continued.

        Empty if this rule asks for at least as much of every condition, so that nothing that was
        computed is in vain.
        """
        ours = dict(self.precision)
        for field in dataclasses.fields(self):
            here, there = getattr(self, field.name), getattr(begun, field.name)
            if here != there and field.name != "precision":
                return (f"{SEARCH}.{field.name}: the store has {_text(there)}, "
                        f"this run {_text(here)}")
        for name, width in begun.precision:
            if ours.get(name, math.inf) > width:
                own = f"{ours[name]:g}" if name in ours else "none"
                return (f"{SEARCH}.precision.{name}: the store has {width:g}, this run {own}, "
                        "which is looser")
        return ""


def _text(value: Any) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else str(value)


def digest_of(rule: StoppingRule) -> str:
    """Return what tells a rule from others: receipts hold it.

    >>> digest_of(StoppingRule("precision", 2400, 50, precision=(("detection_rate", 0.02),)))
    'db369f7a'
    """
    return sha256(json.dumps(dataclasses.asdict(rule), sort_keys=True).encode()).hexdigest()[:8]


def not_continued(ours: StoppingRule | None, begun: StoppingRule | None) -> str:
    """Return why a run cannot continue a store begun under another rule; empty if it can."""
    if ours == begun:
        return ""
    if ours is None or begun is None:
        names: Sequence[str] = [f"[{SEARCH}]" if rule is not None else "a fixed number of trials"
                                for rule in (begun, ours)]
        return f"trials: the store has {names[0]}, this run {names[1]}"
    return ours.looser(begun)
