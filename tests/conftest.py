"""Which tests run, and the cluster that they share."""

import pytest
from distributed import LocalCluster

pytest.register_assert_rewrite("support")


def pytest_collection_modifyitems(config, items):
    """Deselect the long tests unless the command line asks for them by marker or by name."""
    asked = config.getoption("-m") or any("::" in argument for argument in config.args)
    if not asked:
        skipped = [item for item in items if item.get_closest_marker("long")]
        items[:] = [item for item in items if item not in skipped]
        config.hook.pytest_deselected(items=skipped)


@pytest.fixture(scope="session")
def cluster():
    """A cluster of two worker processes: what needs workers, but no certain ones, shares it."""
    with LocalCluster(
        n_workers=2, threads_per_worker=2, host="127.0.0.1", dashboard_address="127.0.0.1:0",
        silence_logs=50,
    ) as running:
        yield running
