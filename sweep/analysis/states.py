"""What is kept of the poses of a block, and how that of several blocks becomes that of all.

A state is of groups. That of a block as a whole is merged over all blocks; that of its cells,
(groups, cells), is merged over the blocks that share the cells, and then folded.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.analysis import radix_histogram as tallies
from sweep.analysis.moments import Moments, merged
from sweep.analysis.radix_histogram import Tally

Masks = NDArray[np.bool_]
State = dict[str, Any]
"""What is kept of poses, by name: arrays that add up (groups, ...), Moments or a Tally."""


def combined(states: Sequence[State]) -> State:
    """Return the state of what several states are of, each kept name by its own rule."""
    found = dict(states[0])
    for state in states[1:]:
        for name, value in state.items():
            if isinstance(value, Moments):
                found[name] = merged(found[name], value)
            elif isinstance(value, Tally):
                found[name] = found[name].merged(value)
            else:
                found[name] = found[name] + value
    return found


def interleaved(states: Sequence[State]) -> State:
    """Return states of as many groups each as one, the groups of the last index fastest."""
    if len(states) == 1:
        return states[0]
    found: State = {}
    for name, value in states[0].items():
        values = [state[name] for state in states]
        if isinstance(value, Moments):
            found[name] = Moments(*(
                _interleaved([getattr(each, part) for each in values])
                for part in ("count", "mean", "mean_tail", "m2")
            ))
        elif isinstance(value, Tally):
            unit = tallies.UPPER * (tallies.LOWER if name == "lower" else 1)
            moved = [each.moved(len(states), k, unit) for k, each in enumerate(values)]
            found[name] = functools.reduce(Tally.merged, moved)
        else:
            found[name] = _interleaved(values)
    return found


def every_nth(state: State, n: int, first: int) -> State:
    """Return the state of the groups ``first``, ``first + n`` and so on; of arrays and Moments."""
    if n == 1:
        return state
    return {
        name: Moments(value.count[first::n], value.mean[first::n], value.mean_tail[first::n],
                      value.m2[first::n])
        if isinstance(value, Moments) else value[first::n]
        for name, value in state.items()
    }


def scattered(cells: State, where: Masks) -> State:
    """Return the state of some cells as that of all; ``where`` (cells,) tells which they are."""
    def spread(array: NDArray[Any], fill: float = 0.0) -> NDArray[Any]:
        every = np.full((len(array), len(where)), fill, dtype=array.dtype)
        every[:, where] = array
        return every

    return {
        name: Moments(spread(value.count), spread(value.mean, np.nan), spread(value.mean_tail),
                      spread(value.m2))
        if isinstance(value, Moments) else spread(value)
        for name, value in cells.items()
    }


def _interleaved(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    stacked = np.stack(arrays, axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])


def folded(cells: State) -> State:
    """Return what cells say together: the state of (groups,), from that of (groups, cells).

    ``draws``, the number of draws with a value that counts, gives the draws and the degrees of
    freedom, those beyond the first of each cell. ``within``, the moments of the draws' deviations
    from the overall mean, gives the sums that the error of the mean is made of, `error_of`.
    """
    found: State = {}
    if "draws" in cells:
        draws = cells["draws"]
        found["draws"] = draws.sum(axis=1)
        found["freedom"] = np.maximum(draws - 1, 0).sum(axis=1)
    if "within" in cells:
        within = cells["within"]
        repeated = within.count > 1
        freedom = np.where(repeated, within.count - 1.0, 0.0)
        m2 = np.where(repeated, within.m2, 0.0)
        with np.errstate(all="ignore"):
            terms = (freedom + 1.0) * m2 / np.maximum(freedom, 1.0)
            found |= {
                "spread": terms.sum(axis=1),
                "spread_squares": (terms**2 / (freedom + 2.0)).sum(axis=1),
                "alone": (within.count == 1).sum(axis=1),
                "m2_repeated": m2.sum(axis=1),
                "freedom_repeated": freedom.sum(axis=1),
            }
    return found
