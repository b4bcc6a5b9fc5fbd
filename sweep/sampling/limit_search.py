"""Where trials decide how far along an axis a requirement is met.

Rates are not monotonic along an axis: they have dips. So all values have a coarse scan, and no
value is judged by its neighbours. More trials are needed by

- the values that are met as it seems, up to the last before the first that is decided not to be:
  each must be decided, for a dip at any of them would be the limit;
- values between these that seem to fail: isolated failures, or dips;
- the next two beyond, at which it ends: with the first alone, a rate that is all but the limit
  would leave open where it surely fails.

What is decided needs no more, and what lies beyond the first value that is decided to fail says
nothing of the limit.
"""

from __future__ import annotations

import numpy as np

from sweep.analysis.farthest import met_run
from sweep.typing import Masks

BEYOND = 2
"""Values beyond the last that is met, as it seems, that are decided."""


def wanted_values(keeps: Masks, met: Masks, not_met: Masks, judged: Masks) -> Masks:
    """Return the values (n,) along an axis, from easy to hard, at which trials decide its limit.

    Parameters
    ----------
    keeps
        Where the values of all requirements keep their limits.
    met, not_met
        Where that is decided.
    judged
        Where there is anything to judge.

    Examples
    --------
    Four that keep, the second undecided; the fifth fails and is undecided, the last surely fails:

    >>> keeps = np.array([1, 1, 1, 1, 0, 0, 0], bool)
    >>> met = np.array([1, 0, 1, 1, 0, 0, 0], bool)
    >>> not_met = np.array([0, 0, 0, 0, 0, 0, 1], bool)
    >>> wanted_values(keeps, met, not_met, np.ones(7, bool)).astype(int).tolist()
    [0, 1, 0, 0, 1, 1, 0]
    """
    at = np.flatnonzero(judged)
    keeps, met, not_met = keeps[at], met[at], not_met[at]
    index = np.arange(len(at))
    run = met_run(keeps, np.ones(len(at), dtype=bool))
    start = run[0] if run else 0
    ends = np.flatnonzero(not_met & (index >= start))
    end = ends[0] if len(ends) else len(at)
    last = np.flatnonzero(keeps & (index < end))
    before = np.flatnonzero(not_met & (index < start))
    first = max(start - BEYOND, before[-1] + 1 if len(before) else 0)
    inner = (index >= first) & (index < end) & (
        index <= (last[-1] if len(last) else start - 1) + BEYOND)
    wanted = np.zeros(len(judged), dtype=bool)
    wanted[at] = inner & ~met & ~not_met
    return wanted
