"""A store of sweep 0.5.0 (format 2) is opened, verified, repaired, reported, reused, continued.

``tests/data/make_store_0_5_0.py`` made the stores.
"""

import json
import shutil
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
import zarr
import zarr.errors

import sweep
from support.store_files import editable, reseal
from sweep.cli import main
from sweep.errors import StoreError
from sweep.execution.block_task import compute_block
from sweep.execution.finalize import close
from sweep.execution.reuse import match
from sweep.execution.status import status
from sweep.integrity.repair import repair
from sweep.integrity.reproduction import reproduce
from sweep.integrity.verification import verify
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.plan import schema
from sweep.plan.experiment import Pipeline
from sweep.plan.parameters import Stage
from sweep.store.blocks import committed
from sweep.store.layout import FORMAT, planned_arrays
from sweep.store.lifecycle import create_store, open_store
from sweep.store.lock import locked
from sweep.store.provenance import versions

ARCHIVE = Path(__file__).parents[1] / "data" / "store-0.5.0.zip"

AT = "side_px=24,tilt_deg=50,noise_grey=8,solver=photometric,cornerRefinementMethod=subpix,trial=1"

VERSIONS = {"opencv": "5.0.0.93", "numpy": "2.4.6", "numba": "0.68.1"}
"""With which the stores were made; another version computes other numbers."""

same_versions = pytest.mark.skipif(
    versions() != VERSIONS, reason="the store was made with other versions of the libraries"
)


@pytest.fixture(scope="session")
def unpacked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("old")
    with zipfile.ZipFile(ARCHIVE) as packed:
        packed.extractall(folder)
    return folder


@pytest.fixture
def finished(unpacked, tmp_path):
    return Path(shutil.copytree(unpacked / "finished.zarr", tmp_path / "finished.zarr"))


@pytest.fixture
def unfinished(unpacked, tmp_path):
    return Path(shutil.copytree(unpacked / "unfinished.zarr", tmp_path / "unfinished.zarr"))


def digests(url, number):
    """Return the digests of a block's receipt as they are stored."""
    return json.loads(str(editable(url, "commits/receipt")[number]))["digests"]


def root_attributes(url):
    return json.loads((url / "zarr.json").read_text())["attributes"]


def edit_metadata(url, key, change):
    """Change a metadata document's attributes, and make the manifest fit."""
    path = url / key
    content = json.loads(path.read_text())
    change(content["attributes"])
    path.write_text(json.dumps(content))
    reseal(url)


def test_old_store_is_of_format_2_and_small():
    assert ARCHIVE.stat().st_size < 200_000
    with zipfile.ZipFile(ARCHIVE) as packed:
        root = json.loads(packed.read("finished.zarr/zarr.json"))
    assert root["attributes"]["sweep"]["format"] == 2 < FORMAT
    assert root["attributes"]["sweep"]["environment"]["sweep"] == "0.5.0"


def test_old_store_opens_with_every_variable_that_it_has(unpacked):
    url = unpacked / "finished.zarr"
    counts = root_attributes(url)["sweep"]["counts"]
    with sweep.open(url) as results:
        assert dict(results.sizes) | {"trial": 3, "solver": 2, "side_px": 3} == dict(results.sizes)
        assert len(results.data_vars) == 21
        for name in ("detection", "estimate"):
            found = np.bincount(results[name].to_numpy().ravel(), minlength=len(counts[name]))
            assert found.tolist() == counts[name]
        solved = results.load().where(results.estimate == EstimateStatus.solved)
        assert float(solved.rotation_error_deg.sel(solver="photometric").median()) < 1.0
        assert int((results.bound == 1).sum()) == 36


def test_old_stores_have_a_status(unpacked):
    state = status(str(unpacked / "finished.zarr"))
    assert (state.finished, state.blocks_done, state.poses_done) == (True, 2, 36)
    assert state.detection == {"detected": 48, "no_candidate": 24}
    state = status(str(unpacked / "unfinished.zarr"))
    assert (state.finished, state.blocks_done, state.writer) == (False, 1, None)
    assert 0 < state.poses_done < state.poses == 144


@pytest.mark.parametrize("name", ["finished", "unfinished"])
def test_old_stores_are_sound(name, unpacked):
    found = verify(str(unpacked / f"{name}.zarr"), 8)
    # A killed run leaves its lock.
    left_over = ["commits/receipt/lock.json"] if name == "unfinished" else []
    assert (found.damage, found.left_over) == ([], left_over)
    if versions() == VERSIONS:
        assert found.sampled > 0


def test_damage_to_an_old_store_is_named(finished):
    (finished / "nees/c/0/0/0/0/0/0").write_bytes(b"x")
    (finished / "xyz/zarr.json").unlink()
    assert {(each.where, each.block) for each in verify(str(finished), 0).damage} == {
        ("nees/c/0/0/0/0/0/0", 0), ("xyz/zarr.json", None)
    }


@pytest.mark.long
@same_versions
def test_old_store_is_repaired_and_keeps_its_format(unpacked, finished, monkeypatch):
    def recompute(store, numbers, **_):
        for number in numbers:
            compute_block(store.url, store.run_id, store.blocks[number])

    monkeypatch.setattr("sweep.integrity.repair.recompute", recompute)
    (finished / "nees/c/0/0/0/0/0/0").write_bytes(b"x")
    (finished / "xyz/zarr.json").unlink()
    report = repair(str(finished), 0)
    assert (report.damage, len(report.repaired)) == ([], 2)
    assert verify(str(finished), 0).damage == []
    assert root_attributes(finished)["sweep"]["format"] == 2
    assert isinstance(digests(finished, 0), list)
    see_similar(finished, unpacked / "finished.zarr")


def see_similar(url, other):
    """Assert that two stores agree: bit for bit if this processor is the one that made them."""
    found = verify(str(url), 20)
    assert found.damage == []
    with sweep.open(url) as ours, sweep.open(other) as theirs:
        for name in ("true_rvec", "true_tvec_m", "marker_area_px"):
            np.testing.assert_allclose(ours[name], theirs[name], rtol=1e-9)
        assert (ours.bound == theirs.bound).all()
        assert float((ours.detection == theirs.detection).mean()) > 0.9


@pytest.mark.long
@same_versions
def test_cell_of_an_old_store_is_reproduced(unpacked):
    again = reproduce(str(unpacked / "finished.zarr"), AT)
    assert (again.difference, again.changes) == ("", [])
    assert again.stored is not None
    assert again.stored["detection"] == DetectionStatus.detected


@pytest.mark.long
@pytest.mark.parametrize("form", ["html", "md"])
def test_old_store_is_reported(form, finished, tmp_path, capsys):
    output = tmp_path / f"report.{form}"
    assert main(["report", str(finished), "-o", str(output)]) == 0, capsys.readouterr().err
    assert "A store of sweep 0.5.0" in output.read_text()


@same_versions
@pytest.mark.long
def test_costs_are_measured_into_an_old_store(finished, capsys):
    assert main(["tradeoff", str(finished), "--seconds", "0.3"]) == 0, capsys.readouterr().err
    assert "photometric" in capsys.readouterr().out
    assert verify(str(finished), 0).damage == []
    assert root_attributes(finished)["sweep"]["format"] == 2


@pytest.mark.long
@same_versions
def test_old_store_is_reused(unpacked, tmp_path):
    text = (unpacked / "old.toml").read_text()
    grown = Pipeline.from_text(text, ["trial=4", "side_px=[6, 24]"], name="grown")
    url, old = str(tmp_path / "grown.zarr"), str(unpacked / "finished.zarr")
    store = create_store(url, grown, (2, 1, 2, 2))
    assert store.format == FORMAT
    computed = [
        compute_block(url, store.run_id, block, (old,)).computed["scenes"]
        for block in store.blocks
    ]
    # Of 2 x 2 x 2 x 4 scenes, the old store has three trials in four.
    assert sum(computed) == 8
    close(store)
    assert verify(url, 4).damage == []
    with sweep.open(url) as ours, sweep.open(old) as theirs:
        shared = ours.sel(trial=[0, 1, 2])
        angle = shared.viewing_angle_deg.to_numpy()
        fresh = ours.viewing_angle_deg.sel(trial=3).to_numpy()
        shared = shared.drop_vars(set(shared.variables) - set(theirs.variables))
        wanted = theirs.sel(side_px=[6, 24])
        assert shared.broadcast_equals(wanted)
        # What the old format lacks is computed: with jitter below 0.001 rad.
        np.testing.assert_allclose(angle, np.broadcast_to(fresh[..., None], angle.shape), atol=0.1)


@pytest.mark.long
@same_versions
def test_unfinished_old_store_is_continued_in_its_format(unpacked, unfinished):
    url = str(unfinished)
    store = open_store(url, "r+")
    before = committed(store)
    with locked(store):
        for number, block in enumerate(store.blocks):
            if number not in before:
                compute_block(url, store.run_id, block)
        close(store)
    assert status(url).finished
    assert [type(digests(url, number)) for number in range(len(store.blocks))] == (
        [list] * len(store.blocks)
    )
    found = verify(url, 8)
    assert (found.damage, found.left_over) == ([], [])
    # The first three of its trials are those of the other store.
    with sweep.open(url) as ours, sweep.open(unpacked / "finished.zarr") as theirs:
        first = ours.sel(trial=[0, 1, 2])
        assert (first.bound == theirs.bound).all()
        np.testing.assert_allclose(first.true_tvec_m, theirs.true_tvec_m, rtol=1e-12)


@pytest.mark.skipif(versions() == VERSIONS, reason="the versions are those of the store")
def test_unfinished_store_of_other_versions_is_refused_in_a_line(unpacked, unfinished):
    text = (unpacked / "old.toml").read_text()
    pipeline = Pipeline.from_text(text, ["trial=12"], name="old")
    with pytest.raises(StoreError, match="the store has"):
        match(pipeline, open_store(str(unfinished)))


# Newer stores

def test_store_of_a_newer_format_is_refused_in_a_line(finished, capsys):
    edit_metadata(finished, "zarr.json", lambda a: a["sweep"].update(format=FORMAT + 1))
    wanted = (
        f"{finished}: store format {FORMAT + 1} is newer than this version of sweep, which reads "
        f"formats 2 to {FORMAT}; install a newer version"
    )
    with pytest.raises(StoreError) as refused:
        sweep.open(finished)
    assert str(refused.value) == wanted
    for command in ("status", "verify", "report", "tradeoff", "repro"):
        assert main([command, str(finished)]) == 2
        assert capsys.readouterr().err == f"{wanted}\n"


@pytest.mark.parametrize("store_format", [1, 0, -3])
def test_store_of_a_format_before_0_5_is_refused_in_a_line(store_format, finished):
    edit_metadata(finished, "zarr.json", lambda a: a["sweep"].update(format=store_format))
    with pytest.raises(StoreError, match=rf"store format {store_format}: this version of sweep "):
        sweep.open(finished)


def test_attributes_that_a_newer_version_adds_are_no_fault(finished):
    edit_metadata(finished, "zarr.json", lambda a: a.update(
        sweep={**a["sweep"], "environment": {"sweep": "0.9.1", "kernel": "x"}, "host": "a"},
        comment="new",
    ))
    for name in ("detection", "side_px", "xyz"):
        edit_metadata(finished, f"{name}/zarr.json", lambda a: a.update(
            comment="new", long_name="in other words"
        ))
    with sweep.open(finished) as results:
        assert results.detection.attrs["comment"] == "new"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
        # The root has a copy of all metadata.
        zarr.consolidate_metadata(str(finished), zarr_format=3)
    reseal(finished)
    assert verify(str(finished), 0).damage == []


# Newer variables

@pytest.fixture
def newer(monkeypatch):
    """A variable that a later format introduces."""
    variable = schema.Variable(
        "blur_px", Stage.scene, "f4", "width of the blur", "px", since_format=FORMAT,
    )
    monkeypatch.setattr(schema, "SCHEMA", (variable, *schema.SCHEMA))
    return variable


@pytest.mark.usefixtures("newer")
def test_variable_of_a_later_format_is_absent_from_an_old_store(unpacked):
    url = str(unpacked / "finished.zarr")
    with sweep.open(url) as results:
        assert "blur_px" not in results
    found = verify(url, 0)
    assert (found.damage, found.left_over) == ([], [])
    pipeline = open_store(url).pipeline
    extents = open_store(url).blocks.extents
    for store_format, present in ((2, False), (FORMAT, True)):
        names = [array.path for array in planned_arrays(pipeline, extents, store_format)]
        assert ("blur_px" in names) == present
