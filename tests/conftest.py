"""Long tests run only if the command line asks for them."""

import pytest

pytest.register_assert_rewrite("support")


def pytest_collection_modifyitems(config, items):
    """Deselect the long tests unless the command line asks for them by marker or by name."""
    asked = config.getoption("-m") or any("::" in argument for argument in config.args)
    if not asked:
        skipped = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if item not in skipped]
        config.hook.pytest_deselected(items=skipped)
