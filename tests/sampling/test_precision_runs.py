"""Runs to a precision: equal bits whatever computes them, tightened, reused, verified, repaired."""

import itertools

import pytest

from support.here import calls_here
from support.stores import by_hand, in_waves, same
from sweep.errors import StoreError
from sweep.execution.runner import execute
from sweep.execution.status import close, status
from sweep.experiment.pipeline import Pipeline
from sweep.integrity.verification import repair, verify
from sweep.store.blocks import committed, drop_block, receipts
from sweep.store.lifecycle import open_store, reopen

TEXT = """
seed = 3
camera = { width_px = 64, height_px = 48 }
pose = { jitter_px = 0.5 }
scene = { renderer = "warp" }
axes = { side_px = [8, 13, 30] }
search = { precision = { detection_rate = %s }, max_trials = 150 }
"""

WIDTHS = ("0.4", "0.14", "0.1")


def precise(width, settings=()):
    return Pipeline.from_text(TEXT % width, settings, name="precise")


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    """A store of the narrowest precision, asked for at once."""
    url = str(tmp_path_factory.mktemp("once") / "once.zarr")
    close(by_hand(url, precise(WIDTHS[-1]), (3, 50)))
    return url


def test_tightened_twice_and_interrupted_is_as_asked_for_at_once(at_once, tmp_path):
    url = str(tmp_path / "tightened.zarr")
    store = by_hand(url, precise(WIDTHS[0]), (1, 50))
    needed = [sum(r.scenes_needed for _, r in receipts(store, committed(store)))]
    for width in WIDTHS[1:]:
        pipeline = precise(width)
        store = reopen(store, pipeline)
        assert store.pipeline.stopping == pipeline.stopping
        in_waves(store, most=1)
        in_waves(store)  # as a run that continues
        needed.append(sum(r.scenes_needed for _, r in receipts(store, committed(store))))
    assert needed == sorted(set(needed))
    assert needed[0] == 150 < needed[-1] < 450
    assert same(url, at_once)
    assert in_waves(store) == 0
    drop_block(store, store.blocks[0])  # later ones hold, since its results are as before
    seen = []
    with calls_here():
        execute(pipeline, url, progress=seen.append)
    assert (seen[-1].needed, seen[-1].settled, seen[-1].done) == (needed[-1], 3, 450)


@pytest.mark.long
def test_verify_finds_blocks_that_do_not_follow_from_the_rule(at_once, tmp_path):
    url = str(tmp_path / "wrong.zarr")
    assert verify(at_once, 1).damage == []
    assert status(at_once).settled == 3
    # Under another precision, the same flags are wrong; an open run computes them again.
    reopen(by_hand(url, precise(WIDTHS[-1]), (3, 50)), precise("0.05"))
    assert verify(url, 0).damage == []
    close(open_store(url, "r+"))
    damage = verify(url, 0).damage
    assert 1 in {each.block for each in damage}
    assert "other results of earlier trials" in damage[0].what


@pytest.mark.long
def test_repair_computes_the_needed_scenes_of_damaged_blocks(at_once, tmp_path):
    url = str(tmp_path / "damaged.zarr")
    store = by_hand(url, precise(WIDTHS[-1]), (1, 50))
    close(store)
    for number in (1, 4, 5):
        drop_block(store, store.blocks[number])
    with calls_here():
        report = repair(url, 0)
    assert report.damage == []
    assert len({each.block for each in report.repaired}) == 3
    assert same(url, at_once)


@pytest.mark.long
@pytest.mark.parametrize(("first", "second"), list(itertools.permutations(("fixed", "waves"))))
def test_fixed_trials_and_waves_reuse_each_other(first, second, tmp_path):
    pipelines = {
        "fixed": Pipeline.from_text(
            (TEXT % 0.1).split("search")[0].replace(
                "side_px = [8, 13, 30]", "side_px = [8, 13, 30], trial = 150"), name="fixed"),
        "waves": precise(WIDTHS[-1]),
    }
    source, reference = (str(tmp_path / f"{name}.zarr") for name in ("source", "reference"))
    target = str(tmp_path / "target.zarr")
    execute(pipelines[first], source)
    with pytest.raises(StoreError, match="trials: the store has"):
        execute(pipelines[second], source)
    whole = execute(pipelines[second], reference)
    summary = execute(pipelines[second], target, reuse=[source])
    assert same(target, reference)
    assert summary.computed_scenes < whole.computed_scenes
    assert (summary.computed_scenes == 0) == (first == "fixed")
