"""Two lengths of one test: a seeded subset by default, full counts under ``pytest -m evidence``."""

import pytest


def lengths(short, full):
    """Return two parametrised counts: ``short`` by default, ``full`` under ``-m evidence``."""
    return pytest.mark.parametrize(
        "count",
        [pytest.param(short, id=str(short)),
         pytest.param(full, id=str(full), marks=pytest.mark.evidence)],
    )


def first_of(cases, count):
    """Return cases for parametrisation, of which the first ``count`` are tried by default."""
    return [
        pytest.param(case, marks=() if number < count else pytest.mark.evidence)
        for number, case in enumerate(cases)
    ]
