"""When sampling stops: the sections of a pipeline by which trials come in waves until all is known.

At most one of them stands in a pipeline. None is part of the identity of a cell: the draws of a
trial depend on its number alone, and a section decides only which trials are computed.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from hashlib import sha256
from typing import Any, ClassVar, Protocol

from sweep.plan.axes import TRIAL, parse_trial
from sweep.plan.choice_rule import read_choice
from sweep.plan.draws import SAMPLINGS
from sweep.plan.limit_rule import read_limit
from sweep.plan.precision_rule import read_precision
from sweep.plan.reader import Reading

MAX_TRIALS = "max_trials"
"""The key of every section: the most trials, the length of the axis ``trial``."""

MIN_TRIALS = 2
"""The fewest that make an interval."""

NO_TRIALS = f"{MAX_TRIALS}, too: the most trials of a condition"
"""What is expected where nothing says how many trials there are at most."""


class StoppingRule(Protocol):
    """What a section says: a frozen dataclass of plain values.

    Attributes
    ----------
    section
        The section's name.
    max_trials
        The most trials of a condition; the length of the axis ``trial``.
    """

    section: ClassVar[str]
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __hash__(self) -> int:
        """Return the hash of a frozen dataclass."""

    @property
    def max_trials(self) -> int:
        """The most trials of a condition."""

    def looser(self, begun: Any) -> str:
        """Return why a store that was begun under another rule of the section cannot be continued.

        Empty if this rule asks for at least as much of every condition, so that nothing that was
        computed is in vain.
        """


SECTIONS: Mapping[str, Callable[[Reading, dict[str, Any]], StoppingRule | None]] = {
    "limit": read_limit,
    "precision": read_precision,
    "choose": read_choice,
}
"""Section -> the function that reads its table and notes faults: the one entry of a rule here.

Its results are sampled by the entry of the rule's class in `sweep.sampling.rules.RULES`.
"""


def read_stopping(reading: Reading) -> None:
    """Read the section by which sampling stops, if there is one; the axes have been read.

    It makes the axis ``trial``.
    """
    present = [name for name in SECTIONS if name in reading.document]
    for name in present[1:]:
        reading.fault(name, reading.document[name], f"[{present[0]}] or [{name}], not both")
    if not present:
        return
    name = present[0]
    table = reading.document[name]
    if not isinstance(table, dict):
        reading.fault(name, table, f"a table: [{name}]")
        return
    _read_trials(reading, name, table)
    if reading.sampling != SAMPLINGS[0]:
        reading.fault(
            "sampling", reading.sampling,
            f"{SAMPLINGS[0]} beside [{name}]: points that are spread evenly over all trials say "
            "nothing of the first ones",
        )
    if TRIAL in reading.axes and len(reading.axes[TRIAL]) < MIN_TRIALS:
        reading.fault(f"{name}.{MAX_TRIALS}", len(reading.axes[TRIAL]),
                      f"at least {MIN_TRIALS}: intervals are over the draws")
    reading.stopping = SECTIONS[name](reading, table)


def _read_trials(reading: Reading, name: str, table: Mapping[str, Any]) -> None:
    """Make the axis of trials from ``max_trials``, or take the one that is given."""
    given = reading.axes.get(TRIAL)
    if MAX_TRIALS not in table:
        if given is None and not reading.names_axis(TRIAL):
            reading.fault(name, dict(table), NO_TRIALS)
        return
    try:
        axis = parse_trial(table[MAX_TRIALS])
    except ValueError as error:
        reading.fault(f"{name}.{MAX_TRIALS}", table[MAX_TRIALS], str(error))
        return
    if given is None:
        reading.axes[TRIAL] = axis
    elif len(given) != len(axis):
        reading.fault(
            f"{name}.{MAX_TRIALS}", table[MAX_TRIALS],
            f"{len(given)}, which axes.trial has, or axes.trial to be left out",
        )


def digest_of(rule: StoppingRule) -> str:
    """Return what tells a rule from others: receipts hold it.

    >>> from sweep.plan.precision_rule import PrecisionRule
    >>> digest_of(PrecisionRule((("detection_rate", 0.02),), ("tilt_deg",), 2400))
    '3d7d3d4e'
    """
    content = {"section": rule.section, **dataclasses.asdict(rule)}
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def not_continued(ours: StoppingRule | None, begun: StoppingRule | None) -> str:
    """Return why a run cannot continue a store begun under another rule; empty if it can."""
    if ours == begun:
        return ""
    if ours is None or begun is None or ours.section != begun.section:
        names = [f"[{rule.section}]" if rule is not None else "a fixed number of trials"
                 for rule in (begun, ours)]
        return f"trials: the store has {names[0]}, this run {names[1]}"
    return ours.looser(begun)
