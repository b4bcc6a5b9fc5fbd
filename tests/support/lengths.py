"""Two lengths of one test: a seeded subset by default, full counts under ``pytest -m long``."""

import pytest


def lengths(short, full):
    """Return two parametrised counts: ``short`` by default, ``full`` under ``-m long``."""
    return pytest.mark.parametrize(
        "count",
        [pytest.param(short, id=str(short)),
         pytest.param(full, id=str(full), marks=pytest.mark.long)],
    )
