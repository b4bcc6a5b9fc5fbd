"""The difference of two rates of the same pairs: its interval, and McNemar's test."""

from __future__ import annotations

import numpy as np
from scipy import special

from sweep.analysis.counts import scaled_to_draws
from sweep.analysis.intervals import LEVEL, wilson
from sweep.typing import Floats, Integers, Masks


def newcombe_and_mcnemar(
    both: Integers, first: Integers, second: Integers, neither: Integers, draws: Integers,
    drawn: Masks, level: float = LEVEL,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the difference of two paired rates, its interval's ends, and McNemar's p-value.

    ``both``, ``first`` (alone), ``second`` (alone) and ``neither`` are counts of pairs, scaled to
    ``draws`` if these are fewer; without ``drawn`` the interval and the p-value are NaN.
    Newcombe, Statistics in Medicine 17 (1998), pages 2635-2650, method 10, with the continuity
    correction of the correlation; the test is the exact binomial one of the discordant pairs.
    """
    n = both + first + second + neither
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = draws / np.maximum(n, 1)
        rates, lows, highs = [], [], []
        for hits in (both + second, both + first):
            rates.append(hits / n)
            fewest, most = scaled_to_draws(hits, n, draws)
            lows.append(wilson(fewest, draws, level)[0])
            highs.append(wilson(most, draws, level)[1])
        margins = ((both + first) * (second + neither)).astype(np.float64) * (
            (both + second) * (first + neither))
        cross = both.astype(np.float64) * neither - first.astype(np.float64) * second
        # Of counts scaled to draws.
        corrected = np.maximum(cross * scale**2 - draws / 2, 0.0)
        lessened = np.where(cross > 0, corrected, cross * scale**2)
        correlation = np.where(margins > 0, lessened / (np.sqrt(margins) * scale**2), 0.0)

        def reach(up: Floats, down: Floats) -> Floats:
            squares = up**2 - 2 * correlation * up * down + down**2
            return np.sqrt(np.maximum(squares, 0.0))

        difference = rates[0] - rates[1]
        low = difference - reach(rates[0] - lows[0], highs[1] - rates[1])
        high = difference + reach(highs[0] - rates[0], rates[1] - lows[1])
        _, fewer = scaled_to_draws(np.minimum(first, second), n, draws)
        discordant = np.maximum(scaled_to_draws(first + second, n, draws)[0], fewer)
        p_value = np.minimum(1.0, 2.0 * special.bdtr(fewer, discordant, 0.5))
    low, high, p_value = (np.where(drawn, each, np.nan) for each in (low, high, p_value))
    return difference, low, high, p_value
