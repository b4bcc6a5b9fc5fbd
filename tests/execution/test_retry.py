"""Failed cells that are tried again: what comes is what a run without failures has."""

import shutil

import pytest
import xarray as xr

from support.commands import pieces
from support.poison import Poison, poisoned
from support.stores import by_hand, same
from sweep.cli import main
from sweep.execution.block_task import compute_block
from sweep.execution.runner import execute
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import verify
from sweep.store.blocks import begin_block, committed
from sweep.store.lifecycle import create_store, open_store

pytestmark = pytest.mark.system

TEXT = """
seed = 3
pose = { jitter_px = 0.5, azimuth_deg = { uniform = [0, 360] } }
axes = { side_px = [30, 60, 90], solver = ["ippe_square", "iterative"], trial = 2 }
"""

EXTENTS = (1, 2)


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="retried")


@pytest.fixture(scope="module")
def clean(pipeline, tmp_path_factory):
    url = str(tmp_path_factory.mktemp("clean") / "clean.zarr")
    close(by_hand(url, pipeline, EXTENTS))
    return url


@pytest.fixture(scope="module")
def failed(pipeline, tmp_path_factory):
    """A finished store: of its three blocks two have cells that raised or ended their process."""
    folder = tmp_path_factory.mktemp("failed")
    url = str(folder / "failed.zarr")
    store = create_store(url, pipeline, EXTENTS)
    poisons = [Poison(1, "estimation", "raise", (), (("solver", "iterative"),)),
               Poison(4, "detection", "segv")]
    for number, block in enumerate(store.blocks):
        with pytest.MonkeyPatch.context() as patch:
            if number != 1:
                begin_block(store, block)  # so that it is computed in a child, which is poisoned
                for name, value in poisoned(poisons, folder / "notes").items():
                    patch.setenv(name, value)
            compute_block(url, store.run_id, block)
    close(store)
    return url


@pytest.fixture
def copied(failed, tmp_path):
    return shutil.copytree(failed, str(tmp_path / "copied.zarr"))


def test_retry_computes_what_failed_and_nothing_else(pipeline, clean, copied):
    before = status(copied)
    assert [len(before.failed), len(before.crashed)] == [1, 1]
    assert execute(pipeline, copied).computed_blocks == 0
    summary = execute(pipeline, copied, retry_failed=True)
    assert (summary.retried, summary.recovered, summary.computed_blocks) == (2, 2, 2)
    assert (summary.failures, summary.warnings) == ([], [])
    assert same(copied, clean)
    assert (verify(copied, 0).damage, verify(copied, 0).left_over) == ([], [])
    with xr.open_zarr(copied, group="failures") as table:
        assert table.sizes["failure"] == 0
        assert (table.attrs["failed_cells"], table.attrs["crashed_cells"]) == (0, 0)
    again = execute(pipeline, copied, retry_failed=True)
    assert (again.retried, again.computed_blocks) == (0, 0)


def test_command_says_that_there_is_nothing_to_try_again(clean, capsys):
    assert main(["run", clean, "--retry-failed"]) == 0
    assert "no cell failed or crashed; nothing is tried again" in capsys.readouterr().out


@pytest.mark.evidence
def test_retry_that_is_killed_at_any_write_is_continued(pipeline, clean, failed, tmp_path):
    shutil.copytree(failed, tmp_path / "complete.zarr")
    (tmp_path / "retried.toml").write_text(TEXT)
    with pieces("dropping", tmp_path, tmp_path / "retried.toml") as (_, count):
        assert count >= 4  # a mark, two blocks, and the end
    for number in range(count + 1):
        url = str(tmp_path / f"{number}.zarr")
        store = open_store(url)
        assert committed(store) >= ({0, 1, 2} if store.finished else {1})
    execute(pipeline, url, retry_failed=True)
    assert same(url, clean)


def test_cells_that_failed_are_not_reused(pipeline, clean, failed, tmp_path):
    url = str(tmp_path / "grown.zarr")
    summary = execute(pipeline, url, reuse=[failed])
    assert (summary.failed, summary.crashed, summary.warnings) == (0, 0, [])
    # One estimate raised; a detection ended its process, and both its solvers went without.
    assert (summary.computed_scenes, summary.computed_estimates) == (2, 3)
    assert same(url, clean)
