"""Verdicts on paired differences: better, equivalent within a margin, not decided, or worse."""

from collections.abc import Sequence

#: From the best to the worst.
BETTER, EQUIVALENT, NOT_DECIDED, WORSE = VERDICTS = (
    "better", "equivalent", "not decided", "worse")

#: Value of two equal configurations -> where they are equivalent: differences of rates up to one
#: percentage point, RMSEs up to a factor of 1.05.
EQUIVALENT_WITHIN = {0.0: (-1.0, 1.0), 1.0: (1 / 1.05, 1.05)}


def verdict(low: float, high: float, equal: float) -> str:
    """Return a verdict from the ends of an interval, NaN without one.

    ``equal`` is the value of two equal configurations: 0 of a difference between rates, percentage
    points, which is large if good, or 1 of a ratio between errors, which is small. An interval
    that lies on one side of it is better or worse, however near. Of others, those within the margin
    are equivalent.
    """
    if low > equal or high < equal:
        return BETTER if (low > equal) == (equal == 0.0) else WORSE
    least, most = EQUIVALENT_WITHIN[equal]
    return EQUIVALENT if least <= low <= high <= most else NOT_DECIDED


def first_verdict(verdicts: Sequence[str]) -> str:
    """Return the first that is better or worse; equivalent if all are, else not decided."""
    decided = [each for each in verdicts if each in {BETTER, WORSE}]
    return decided[0] if decided else EQUIVALENT if {*verdicts} == {EQUIVALENT} else NOT_DECIDED
