"""What is said of a store that is not finished: who writes it, or what continues it."""


import pytest

from support.reports import command, made
from sweep.store.lifecycle import open_store
from sweep.store.lock import writing

TEXT = "seed = 1\n[pose]\nside_px = 40\njitter_px = 0.5\n[axes]\ntrial = 4\n"


@pytest.mark.parametrize("name", ["report", "tradeoff"])
def test_a_store_that_is_being_written_is_not_said_to_need_a_run(name, tmp_path):
    url = made(tmp_path, TEXT, "held", finished=False)
    with writing(url, open_store(url, "r+").storage):
        code, _, err = command(name, url)
    assert code == 2
    assert err == (
        f"{url}: unfinished: 1 of 2 blocks; it is being written: wait until it is finished\n")
    assert command(name, url)[::2] == (
        2, f"{url}: unfinished: 1 of 2 blocks; `sweep run` continues it\n")
