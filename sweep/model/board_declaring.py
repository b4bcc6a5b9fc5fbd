"""What declarations of all kinds of boards share: fields, and faults of their values."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from sweep.declaration import parameter
from sweep.model.marker import Marker as SingleMarker
from sweep.model.marker import marker_count, missing_package

MAX_MARKERS = 4000
"""The most markers of a board; a dictionary of OpenCV has 1,000, of AprilTag's most have fewer."""

_DICTIONARY = SingleMarker.__dataclass_fields__["dictionary"].metadata["declaration"]


class Fault(NamedTuple):
    """A key whose value cannot be, and what was expected."""

    key: str
    value: Any
    expected: str


def required(meaning: str, **declared: Any) -> Any:
    """Return a declared field without a default."""
    return parameter(dataclasses.MISSING, meaning, **declared)


def dictionary_of_all() -> Any:
    """Return the declared field of the dictionary of all markers."""
    return required(
        "the dictionary of all markers, as of a single marker", choices=_DICTIONARY.choices,
        prefix=_DICTIONARY.prefix,
        numbers=_DICTIONARY.numbers,
    )


def length(meaning: str) -> Any:
    """Return the declared field of a length that must be given."""
    return required(meaning, unit="m", low=0, high=1e6, open_low=True)


def margin(meaning: str) -> Any:
    """Return the declared field of a sheet's margin."""
    return parameter(None, meaning, unit="m", low=0, high=1e6)


def refuse(faults: Sequence[Fault]) -> None:
    """Raise ValueError with a line for each fault, if there are any."""
    if faults:
        raise ValueError(
            "\n".join(f"{key} = {value}: expected {expected}" for key, value, expected in faults)
        )


def id_faults(
    key: str, ids: list[int], dictionary: str, written: Any = None
) -> list[Fault]:
    """Return the faults of markers' IDs; ``written`` is what the key has if not these."""
    missing = missing_package(dictionary)
    if missing is not None:
        return [Fault("dictionary", dictionary, f"one whose package is installed: {missing}")]
    written = ids if written is None else written
    if not 1 <= len(ids) <= MAX_MARKERS:
        return [Fault(key, ids, f"1 to {MAX_MARKERS} markers; these are {len(ids)}")]
    faults = []
    twice = [marker_id for marker_id, count in Counter(ids).items() if count > 1]
    if twice:
        faults.append(Fault(key, written, f"each ID once; {twice[0]} is listed more than once"))
    count = marker_count(dictionary)
    if min(ids) < 0 or max(ids) >= count:
        faults.append(Fault(
            key, written,
            f"IDs from 0 to {count - 1}, which is what {dictionary} has; the board has "
            f"{len(ids)} markers with IDs up to {max(ids)}; take a larger dictionary, or fewer "
            "markers",
        ))
    return faults
