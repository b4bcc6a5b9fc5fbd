"""Decisions that are looked at again and again: the error probability that each look may spend.

Trials come in waves, and after each wave it is asked whether a requirement is met. If every look
had the error probability of a single one, the first that errs would end the search. So each spends
a part. Looks at the same growing sample err together, so that the part may be larger than one
over their number (Bonferroni): by `looks_factor`. For rates that it suffices is enumerated exactly
(`pytest -m long tests/sampling/test_limit_search.py`).
"""

from __future__ import annotations

FIRST, EACH = 0.35, 0.65


def looks_factor(count: int) -> float:
    """Return by how much the error probability of a decision is divided for each of its looks.

    It is for samples that grow by a quarter or more from look to look; a single look has 1.

    Of Clopper and Pearson's interval, enumerated over all paths of the counts at 1 to 21 looks up
    to 10,000 draws, rates from 0.01 to 0.99 and errors from 0.025 to 1e-4, the probability that
    any look errs is then at most 1.006 times that of a single one.

    Examples
    --------
    >>> looks_factor(1), round(looks_factor(14), 1)
    (1.0, 9.4)
    """
    return FIRST + EACH * count
