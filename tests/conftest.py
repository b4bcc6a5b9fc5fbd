"""Two lengths of every test: a seeded subset always, full counts under ``pytest -m long``."""

import pytest


def pytest_collection_modifyitems(config, items):
    """Leave the long tests out unless the command line asks for them by marker or by name."""
    asked = config.getoption("-m") or any("::" in argument for argument in config.args)
    if not asked:
        skipped = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if item not in skipped]
        config.hook.pytest_deselected(items=skipped)


def lengths(short, full):
    """Return two parametrised counts: ``short`` always, ``full`` under ``-m long``."""
    return pytest.mark.parametrize(
        "count",
        [pytest.param(short, id=str(short)),
         pytest.param(full, id=str(full), marks=pytest.mark.long)],
    )
