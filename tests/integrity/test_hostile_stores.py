"""Stores that mean harm: refused in a line, nothing run, nothing touched outside, and soon."""

import json
import os
import pickle
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from zlib import crc32

import google_crc32c
import numpy as np
import pytest
import zarr

import sweep
from support.lengths import first_of, lengths
from support.store_files import COPY, MANIFEST, arrays, edit_receipt, files, reseal, see_same
from support.stores import by_hand
from sweep.cli import main
from sweep.errors import SweepError
from sweep.execution.block_task import compute_block
from sweep.execution.finalize import close
from sweep.execution.status import status
from sweep.integrity.repair import repair
from sweep.integrity.verification import verify
from sweep.plan.experiment import Pipeline
from sweep.store.lifecycle import create_store, open_store

TEXT = """
title = "Small"
seed = 3
[pose]
distance_m = 0.3
jitter_px = 0.5
[scene]
background = 128
[axes]
tilt_deg = [0, 30]
trial = 4
"""

EXTENTS = (2, 2)
"""Two blocks, each of both tilts and two trials."""


SOON_S = 15
"""No store may keep a command longer."""


@pytest.fixture(autouse=True)
def soon(request):
    """End a test that takes long."""
    def end(*_):
        raise AssertionError("this takes too long")

    signal.signal(signal.SIGALRM, end)
    signal.alarm(4 * SOON_S if "gigabytes" in request.node.name else SOON_S)
    yield
    signal.alarm(0)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    url = str(tmp_path_factory.mktemp("sound") / "sound.zarr")
    close(by_hand(url, Pipeline.from_text(TEXT, name="small"), EXTENTS))
    return Path(url)


@pytest.fixture
def copied(sound, tmp_path):
    return Path(shutil.copytree(sound, tmp_path / "copied.zarr"))


@pytest.fixture
def here(monkeypatch):
    """Repair in this process, without a cluster."""
    def recompute(store, numbers, **_):
        for number in numbers:
            compute_block(store.url, store.run_id, store.blocks[number])

    monkeypatch.setattr("sweep.integrity.repair.recompute", recompute)


def see_line(error):
    """Assert that an error is one line that can be shown."""
    line = str(error)
    assert line.isprintable()
    assert 0 < len(line) < 2000


def opened(url):
    sweep.open(url).close()


def looks(url):
    """Return what opening, status and verify say: None, or an error of one line; else it raises."""
    said = {}
    for name, function in (
        ("open", opened), ("status", status), ("verify", lambda url: verify(url, 0)),
    ):
        said[name] = None
        try:
            said[name] = function(str(url))
        except SweepError as error:
            see_line(error)
            said[name] = error
    return said


def see_refused(url, capsys):
    """Assert that all refuse a store in a line; verify may tell damage in place of that."""
    with pytest.raises(SweepError) as told:
        sweep.open(str(url))
    see_line(told.value)
    capsys.readouterr()
    assert main(["status", str(url)]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err.count("\n")) == ("", 1)
    code = main(["verify", str(url), "--sample", "0"])
    said = capsys.readouterr()
    assert code in (1, 2)
    assert "damaged" in said.out if code == 1 else said.err.count("\n") == 1


def edit_json(path, change):
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def edit_root(url, change):
    """Change the root's attributes, and make the manifest fit."""
    edit_json(url / "zarr.json", lambda content: change(content["attributes"]))
    reseal(url)


def put_codecs(codecs):
    return lambda content: content.update(codecs=[*content["codecs"][:1], *codecs])


ZSTD = {"name": "zstd", "configuration": {"level": 3, "checksum": False}}

def some(cases, names):
    """Return parameters: of these names always, the others under ``-m long``."""
    return [pytest.param(case, id=name, marks=() if name in names else pytest.mark.long)
            for name, case in cases.items()]


SCHEMAS = {
    "type": lambda c: c.update(data_type="float64"),
    "type that is none": lambda c: c.update(data_type="complex9"),
    "shape": lambda c: c.update(shape=[2, 5, 3]),
    "huge shape": lambda c: c.update(shape=[2, 1 << 60, 3]),
    "fewer dimensions": lambda c: c.update(shape=[2, 4]),
    "chunks": lambda c: c["chunk_grid"]["configuration"].update(chunk_shape=[2, 4, 3]),
    "no chunks": lambda c: c["chunk_grid"]["configuration"].update(chunk_shape=[0, 0, 0]),
    "fill value": lambda c: c.update(fill_value=0.0),
    "no checksum": put_codecs([ZSTD]),
    "other compression": put_codecs([{"name": "gzip", "configuration": {"level": 5}}]),
    "codec that is none": put_codecs([{"name": "pickle"}]),
    "bytes the other way round": lambda c: c["codecs"][0].update(configuration={"endian": "big"}),
    "dimensions": lambda c: c.update(dimension_names=["trial", "tilt_deg", "xyz"]),
    "no dimensions": lambda c: c.pop("dimension_names"),
    "separator of keys": lambda c: c["chunk_key_encoding"].update(
        configuration={"separator": "."}
    ),
    "form of keys": lambda c: c.update(
        chunk_key_encoding={"name": "v2", "configuration": {"separator": "/"}}
    ),
    "version": lambda c: c.update(zarr_format=2),
    "a group": lambda _: {"zarr_format": 3, "node_type": "group", "attributes": {}},
    "a list": lambda _: [1, 2],
}


@pytest.mark.parametrize("change", some(SCHEMAS, {
    "type", "huge shape", "no chunks", "no checksum", "bytes the other way round",
    "separator of keys", "a list",
}))
@pytest.mark.long
def test_array_of_another_schema_is_refused_though_every_checksum_fits(change, copied, capsys):
    edit_json(copied / "translation_error_m/zarr.json", change)
    reseal(copied)
    see_refused(copied, capsys)


@pytest.mark.parametrize(
    "attributes", [{"scale_factor": 1000.0}, {"_FillValue": 0.25, "missing_value": 0.5}]
)
def test_attributes_cannot_change_what_is_read(attributes, sound, copied):
    zarr.open_array(f"{copied}/translation_error_m", mode="r+").attrs.update(attributes)
    reseal(copied)
    assert verify(str(copied), 0).damage
    with sweep.open(sound) as results:
        wanted = results.translation_error_m.to_numpy()
    try:
        results = sweep.open(copied)
    except SweepError as error:
        see_line(error)
    else:
        with results:
            np.testing.assert_array_equal(results.translation_error_m.to_numpy(), wanted)


def test_stray_file_among_the_costs_keeps_no_store_open(tmp_path):
    url = tmp_path / "begun.zarr"
    by_hand(str(url), Pipeline.from_text(TEXT, name="small"), EXTENTS)
    (url / "cost").mkdir()
    (url / "cost" / "letter.txt").write_text("mine")
    close(open_store(str(url), "r+"))
    assert verify(str(url), 0).damage == []


class Evil:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self._path = path

    def __reduce__(self):
        return open, (str(self._path), "w")


@pytest.mark.parametrize("place", [
    "nees",
    *(pytest.param(place, marks=pytest.mark.long)
      for place in ("", "cost/tradeoff", "cost/scene_s", "trial")),
])
@pytest.mark.usefixtures("here")
def test_nothing_is_unpickled(place, copied, tmp_path):
    proof = tmp_path / "unpickled"
    folder = copied / place
    if place:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    else:
        (copied / "zarr.json").unlink()
    array = {
        "zarr_format": 2, "shape": [2, 4], "chunks": [2, 4], "dtype": "|O", "compressor": None,
        "fill_value": None, "order": "C", "filters": [{"id": "pickle"}],
    }
    (folder / ".zarray").write_text(json.dumps(array))
    (folder / ".zattrs").write_text('{"_ARRAY_DIMENSIONS": ["tilt_deg", "trial"]}')
    for key in ("0", "0.0"):
        (folder / key).write_bytes(pickle.dumps(Evil(proof)))
    looks(copied)
    found = verify(str(copied), 0)
    assert found.damage or found.left_over
    repair(str(copied), 0)
    assert (verify(str(copied), 0).damage, verify(str(copied), 0).left_over) == ([], [])
    assert not proof.exists()
    # It would have done harm.
    pickle.loads(pickle.dumps(Evil(proof))).close()  # noqa: S301
    assert proof.exists()


def test_arrays_and_groups_that_no_store_has_are_refused(copied, capsys):
    group = zarr.open_group(str(copied), mode="r+", zarr_format=3, use_consolidated=False)
    group.create_array("extra", shape=(2,), dtype="f8")
    see_refused(copied, capsys)
    shutil.rmtree(copied / "extra")
    group.create_group("more")
    see_refused(copied, capsys)
    shutil.rmtree(copied / "more")
    group.create_array("cost/extra", shape=(2,), dtype="f8")[:] = 1.0
    found = verify(str(copied), 0)
    assert any("cost/extra" in key for key in
               [*found.left_over, *(damage.where for damage in found.damage)])


BLOCKS = (
    [0, 2], [-1, 2], [2, 1 << 70], [2, 5], ["2", "2"], [2.0, 2], [True, 2], [2], [2, 2, 2], [],
    "22", None, 2, {"2": 2}, [[2], [2]], [None, 2], [1, 2],
)


def test_blocks_of_impossible_extents_are_refused(sound, copied, capsys):
    for block in BLOCKS:
        edit_root(copied, lambda attributes, block=block: attributes["sweep"].update(block=block))
        with pytest.raises(SweepError) as told:
            sweep.open(copied)
        see_line(told.value)
        if block in ([0, 2], [2, 1 << 70], "22"):
            see_refused(copied, capsys)
        shutil.copy(sound / "zarr.json", copied / "zarr.json")


@pytest.mark.parametrize("run_id", ["../../outside", "../" * 10 + "etc", "", 5, None, "A" * 32])
def test_run_id_that_is_none_is_refused(run_id, copied, capsys):
    edit_root(copied, lambda attributes: attributes["sweep"].update(run_id=run_id))
    see_refused(copied, capsys)


PIPELINES = {
    "another grid": TEXT.replace("trial = 4", "trial = 5"),
    "a huge grid": TEXT.replace("trial = 4", "trial = 900000000"),
    "other axes": TEXT.replace("tilt_deg", "roll_deg"),
    "10 MB": TEXT + "#" * 10_000_000,
    "deep": TEXT + "x = " + "[" * 100_000,
    "long key": TEXT + ".".join("a" * 100_000) + " = 1",
    "no TOML": "\x00\x1b[2J",
    "empty": "",
    "number": 5,
    "list": ["a"],
    "nothing": None,
    "control characters": '[axes]\n"\\u001b[2J" = [1, 2]\n',
}


@pytest.mark.parametrize("text", some(PIPELINES, {
    "another grid", "a huge grid", "10 MB", "long key", "nothing", "control characters",
}))
def test_pipeline_of_something_else_is_refused(text, copied, capsys):
    edit_root(copied, lambda attributes: attributes.update(pipeline=text))
    begun = time.monotonic()
    with pytest.raises(SweepError) as told:
        sweep.open(copied)
    assert all(line.isprintable() for line in str(told.value).split("\n"))
    assert main(["status", str(copied)]) == 2
    assert main(["verify", str(copied), "--sample", "0"]) in (1, 2)
    assert len(capsys.readouterr().err) < 5000
    assert time.monotonic() - begun < 20


VALUES = (None, 5, "x", [], {}, [[]], {"a": None}, True, -1.5)


@pytest.mark.long
@lengths(1, len(VALUES))
@pytest.mark.parametrize(
    "key",
    ["format", "name", "folder", "run_id", "block", "fingerprint", "environment", "created",
     "finished", "counts", "files", "title", "pipeline", "sweep", "coordinates"],
)
def test_attributes_of_wrong_types_are_borne(key, count, sound, copied):
    def change(value):
        def changed(attributes):
            there = attributes if key in ("title", "pipeline", "sweep", "coordinates") else (
                attributes["sweep"]["fingerprint"] if key == "files" else attributes["sweep"]
            )
            if value is change:
                there.pop(key, None)
            else:
                there[key] = value

        return changed

    start = len(key)
    for value in (change, *(VALUES[(start + k) % len(VALUES)] for k in range(count))):
        edit_root(copied, change(value))
        looks(copied)
        shutil.copy(sound / "zarr.json", copied / "zarr.json")


DEEP = "[" * 200_000
LONG = json.dumps({"a": ["x" * 100] * 50_000})

DOCUMENTS = {
    "deep list": DEEP, "deep object": '{"a":' * 100_000, "5 MB": LONG, "Latin": "\xff",
    "empty": "", "null": "null", "7": "7",
}


@pytest.mark.long
@pytest.mark.parametrize("content", some(DOCUMENTS, {"deep list", "5 MB", "null"}))
@pytest.mark.parametrize("key", ["zarr.json", "detection/zarr.json", MANIFEST, "cost/zarr.json"])
def test_documents_of_something_else_are_borne(key, content, copied):
    (copied / key).write_bytes(content.encode("latin-1"))
    said = looks(copied)
    assert key in {damage.where for damage in said["verify"].damage}
    if key in ("zarr.json", "detection/zarr.json"):
        assert isinstance(said["open"], SweepError)
        assert isinstance(said["status"], SweepError)


def test_root_and_manifests_of_something_else_are_refused(copied, capsys):
    for content in (DEEP, LONG, "{}", '{"attributes": 5, "digest": 0}'):
        for key in ("zarr.json", MANIFEST, COPY):
            (copied / key).write_text(content)
        see_refused(copied, capsys)


def sealed(content):
    """Return a manifest with its own digest."""
    text = json.dumps(content, separators=(",", ":"), sort_keys=True)
    return json.dumps({**content, "digest": crc32(text.encode())})


MANIFESTS = {
    "attributes": {"attributes": [], "files": {}},
    "pairs": {"attributes": [["a", 1]], "files": [["x", 2]]},
    "numbers": {"attributes": 5, "files": 5},
    "digests of wrong types": {"attributes": {"sweep": 5}, "files": {"trial/c/0": "x", "y": None}},
    "odd keys": {"attributes": {}, "files": {"": 1, "/": 2, "\x00": 3, "x" * 5000: 4, "a//b": 5}},
}


@pytest.mark.long
@pytest.mark.parametrize("content", MANIFESTS.values(), ids=MANIFESTS)
def test_manifests_of_wrong_types_are_borne(content, copied):
    for key in (MANIFEST, COPY):
        (copied / key).write_text(sealed(content))
    said = looks(copied)
    found = said["verify"]
    assert isinstance(found, SweepError) or found.damage or found.left_over


@pytest.mark.usefixtures("here")
def test_manifest_names_no_file_outside(copied, tmp_path):
    outside = tmp_path / "outside.txt"
    outside.write_text("mine")
    recorded = json.loads((copied / MANIFEST).read_text())
    recorded.pop("digest")
    for key in ("../outside.txt", "cost/../../outside.txt", str(outside), f"cost/{outside}"):
        recorded["files"][key] = 5
    for key in (MANIFEST, COPY):
        (copied / key).write_text(sealed(recorded))
    assert looks(copied)["verify"].damage
    try:
        repair(str(copied), 0)
    except SweepError as error:
        see_line(error)
    assert outside.read_text() == "mine"


WRONG = (None, "x", -1, [], 1 << 80, [None], {}, 1.5, [[[]]], {"scene": "x"}, [{}])


@pytest.mark.long
@lengths(1, len(WRONG))
@pytest.mark.parametrize(
    "name",
    ["run_id", "processor", "scenes", "detection", "estimate", "seconds", "failures", "written",
     "digests"],
)
def test_receipts_of_wrong_types_are_borne(name, count, copied):
    before = (copied / "commits/receipt/c/0").read_bytes()
    for value in WRONG[:count]:
        edit_receipt(copied, 0, lambda content, value=value: content.update({name: value}))
        for function in (status, lambda url: verify(url, 0)):
            try:
                function(str(copied))
            except SweepError as error:
                see_line(error)
        (copied / "commits/receipt/c/0").write_bytes(before)


FAILURE = {"scene": 0, "kind": "failed", "stage": "detection", "setting": 0, "estimator": None,
           "text": "Error: x"}


@pytest.mark.long
@pytest.mark.parametrize(
    "wrong",
    [{"scene": 10**9}, {"scene": "0"}, {"kind": "odd"}, {"kind": []}, {"setting": 7},
     {"estimator": -4}, {"text": 5}, {"text": "x" * 5_000_000}, {"text": ""},
     {"text": "Error: \x1b[2J\x1b]0;title\x07"}],
    ids=str,
)
def test_failures_of_wrong_kinds_are_borne_and_steer_no_terminal(wrong, copied, capsys):
    edit_receipt(copied, 0, lambda content: content.update(failures=[FAILURE | wrong]))
    looks(copied)
    capsys.readouterr()
    assert main(["status", str(copied)]) in (0, 2)
    said = capsys.readouterr()
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())


@pytest.mark.long
@pytest.mark.parametrize(
    "text",
    first_of(["{", "[" * 100_000, "", "7", "null", '{"a":' * 100_000, "x" * 5_000_000], 2),
    ids=["torn", "deep list", "empty", "7", "null", "deep object", "5 MB"],
)
def test_receipts_of_something_else_are_told(text, copied, capsys):
    edit_receipt(copied, 0, lambda _: text)
    said = looks(copied)
    assert isinstance(said["status"], SweepError)
    assert {damage.block for damage in said["verify"].damage} == {0}
    assert main(["status", str(copied)]) == 2
    assert "sweep verify --repair" in capsys.readouterr().err


def test_receipt_whose_number_of_scenes_is_none_breaks_no_sample(copied):
    for number in (0, 1):
        edit_receipt(copied, number, lambda content: content.update(scenes="many"))
    try:
        verify(str(copied), 2)
    except SweepError as error:
        see_line(error)


LOCKS = (
    "garbage", "[]", "{}", '{"pid": "x"}', '{"pid": 1e400, "beat": NaN, "host": []}',
    '{"beat": "now"}', '{"beat": true}', "[" * 100_000,
)


@pytest.mark.long
def test_locks_of_garbage_lock_nothing(copied, capsys):
    for content in LOCKS:
        (copied / "commits/receipt/lock.json").write_text(content)
        assert main(["status", str(copied)]) == 0
        assert "being written" not in capsys.readouterr().out
        assert main(["verify", str(copied), "--sample", "0"]) == 0
        capsys.readouterr()


@pytest.mark.parametrize("pid", [10**30, -1, 0, [], "1", None])
def test_lock_of_an_impossible_process_is_borne(pid, copied, capsys):
    lock = {"host": os.uname().nodename, "pid": pid, "beat": time.time(), "token": "x"}
    (copied / "commits/receipt/lock.json").write_text(json.dumps(lock))
    assert main(["status", str(copied)]) == 0
    assert "being written" not in capsys.readouterr().out


def test_lock_steers_no_terminal(copied, capsys):
    lock = {"host": "\x1b[2J", "pid": "\x1b[2J", "beat": time.time(), "token": "x"}
    (copied / "commits/receipt/lock.json").write_text(json.dumps(lock))
    main(["status", str(copied)])
    said = capsys.readouterr()
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())


def kept(folder):
    return {key: (folder / key).read_bytes() for key in files(folder)}


@pytest.mark.parametrize("name", first_of(
    ["detection/c", "commits/receipt/c", "detection", "commits"], 2
))
def test_nothing_is_written_through_a_link_that_leads_out(name, tmp_path):
    url, outside = tmp_path / "begun.zarr", tmp_path / "outside"
    store = create_store(str(url), Pipeline.from_text(TEXT, name="small"), EXTENTS)
    compute_block(str(url), store.run_id, store.blocks[0])
    shutil.move(url / name, outside)
    (url / name).symlink_to(outside)
    before = kept(outside)
    with pytest.raises(SweepError) as told:
        compute_block(str(url), store.run_id, store.blocks[1])
    see_line(told.value)
    assert kept(outside) == before


@pytest.mark.parametrize(
    "name", first_of(["cost", "trial", "cost/scene_s", "detection/c", "commits"], 2))
@pytest.mark.usefixtures("here")
def test_nothing_outside_is_deleted_or_written_by_a_repair(name, copied, tmp_path):
    outside = tmp_path / "outside"
    shutil.move(copied / name, outside)
    (copied / name).symlink_to(outside)
    (outside / "letter.txt").write_text("mine")
    (outside / "letter.partial").write_text("mine")
    before = kept(outside)
    # Of each part of the store something is damaged, so that all is written again.
    for key in ("true_rvec/c/0/1/0", "xyz/c/0"):
        (copied / key).unlink()
    try:
        repair(str(copied), 0)
    except SweepError as error:
        see_line(error)
    assert kept(outside) == before


def test_nothing_outside_is_deleted_when_a_store_is_closed(tmp_path):
    url, outside = tmp_path / "begun.zarr", tmp_path / "outside"
    by_hand(str(url), Pipeline.from_text(TEXT, name="small"), EXTENTS)
    (outside / "scene_s").mkdir(parents=True)
    (outside / "scene_s" / "letter.txt").write_text("mine")
    (url / "cost").symlink_to(outside)
    before = kept(outside)
    try:
        close(open_store(str(url), "r+"))
    except SweepError as error:
        see_line(error)
    assert kept(outside) == before


@pytest.mark.long
@pytest.mark.usefixtures("here")
def test_store_that_is_a_link_is_a_store(sound, copied, tmp_path):
    link = tmp_path / "link.zarr"
    link.symlink_to(copied)
    assert main(["status", str(link)]) == 0
    assert verify(str(link), 0).damage == []
    (copied / "detection/c/0/0").unlink()
    mended = repair(str(link), 0)
    assert [damage.where for damage in mended.repaired] == ["detection/c/0/0"]
    assert mended.damage == []
    assert link.is_symlink()
    see_same(copied, sound)


@contextmanager
def fifo(path):
    """Put a FIFO in place of a file; yields a list that is not empty when a reader hung on it."""
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    hung, done = [], threading.Event()

    def watch():
        while not done.wait(1.5):
            try:
                # Opens only where somebody waits to read.
                os.close(os.open(path, os.O_WRONLY | os.O_NONBLOCK))
                hung.append(path)
            except OSError:
                continue

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        yield hung
    finally:
        done.set()
        watching.join()
        path.unlink()


@pytest.mark.long
@pytest.mark.parametrize(
    "key",
    ["zarr.json", MANIFEST, "detection/zarr.json", "detection/c/0/0", "trial/c/0",
     "commits/receipt/c/0", "commits/receipt/lock.json"],
)
def test_fifo_in_place_of_a_file_hangs_nothing(key, copied):
    with fifo(copied / key) as hung:
        said = looks(copied)
        assert hung == []
    if not key.endswith("lock.json"):
        assert said["verify"].damage


HUGE_BYTES = 100 << 30

HUGE = {
    "zarr.json": "damaged: zarr.json", MANIFEST: None, COPY: None,
    "detection/zarr.json": "detection: missing", "trial/c/0": "trial/c/0 is larger than it can be",
    "cost/zarr.json": None, "detection/c/0/0": None, "commits/receipt/c/0": None,
    "commits/receipt/lock.json": None,
}
"""File -> what `sweep.open` says if it is larger than it can be; None: it opens."""


@pytest.mark.parametrize("key", first_of(HUGE, 3))
def test_file_that_is_larger_than_it_can_be_is_damaged_and_not_read(key, copied, tmp_path, capsys):
    (copied / key).touch()
    os.truncate(copied / key, HUGE_BYTES)
    begun = time.monotonic()
    said = looks(copied)
    assert time.monotonic() - begun < 5
    if not key.endswith("lock.json"):
        faults = {damage.where: damage.what for damage in said["verify"].damage}
        assert faults.keys() == {key}
        assert key in (MANIFEST, COPY) or faults[key] == "larger than it can be"
    assert (said["open"] is None) == (HUGE[key] is None)
    assert (HUGE[key] or "") in str(said["open"])
    if "/receipt/c/" in key:
        assert "commits/receipt/c/0: larger than it can be" in str(said["status"])
    if key in ("detection/c/0/0", "zarr.json"):
        assert main(["report", str(copied), "-o", str(tmp_path / "r.html")]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    if key == "detection/c/0/0":
        with sweep.open(copied) as results, pytest.raises(ValueError, match="larger than it can"):
            results.detection.load()


@pytest.mark.usefixtures("here")
def test_files_that_are_larger_than_they_can_be_are_repaired(sound, copied):
    for key in HUGE:
        if key != COPY:
            (copied / key).touch()
            os.truncate(copied / key, HUGE_BYTES)
    assert repair(str(copied), 0).damage == []
    see_same(copied, sound)


BOMB_BYTES = 1_500_000_000


def bomb(size):
    """Return a chunk of a few kilobytes that claims, and has, ``size`` zero bytes.

    A Zstandard frame of one segment, of blocks that repeat a byte 128 KiB times each.
    """
    most = 1 << 17
    count, rest = divmod(size, most)
    lengths = [most] * count + [rest] * (rest > 0)
    frame = bytes.fromhex("28b52ffd") + b"\xe0" + size.to_bytes(8, "little")
    frame += b"".join(
        ((length << 3) | (1 << 1) | (k == len(lengths) - 1)).to_bytes(3, "little") + b"\0"
        for k, length in enumerate(lengths)
    )
    return frame + google_crc32c.value(frame).to_bytes(4, "little")


MEMORY = """
import resource, sys
import sweep
from sweep.execution.status import status
from sweep.integrity.verification import verify
from sweep.errors import SweepError

def used():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

def opened(url):
    sweep.open(url).close()

verify(sys.argv[1], 0), status(sys.argv[1]), opened(sys.argv[1])
before = used()
for url in sys.argv[2:]:
    for function in (lambda url: verify(url, 0), status, opened):
        try:
            found = function(url)
        except Exception as error:
            found = error
        damaged = isinstance(found, Exception) or bool(getattr(found, "damage", ()))
        print(int(damaged), used() - before)
"""


@pytest.mark.long
def test_chunks_that_claim_gigabytes_take_no_memory(sound, tmp_path):
    content = bomb(BOMB_BYTES)
    assert len(content) < 100_000
    urls = []
    for key in ("translation_error_m/c/0/0/0", "detection/c/0/0/0"):
        url = Path(shutil.copytree(sound, tmp_path / f"{len(urls)}.zarr"))
        (url / key).write_bytes(content)
        reseal(url)
        if key.startswith("translation"):
            edit_receipt(url, 0, lambda receipt: receipt["digests"].update(
                translation_error_m=crc32(content)
            ))
        urls.append(url)
    ran = subprocess.run(
        [sys.executable, "-c", MEMORY, sound, *urls], check=True, capture_output=True, text=True,
        timeout=120,
    )
    rows = [tuple(map(int, line.split())) for line in ran.stdout.splitlines()]
    assert [damaged for damaged, _ in rows[::3]] == [1] * len(urls)
    over = {url.name: rows[3 * k : 3 * k + 3] for k, url in enumerate(urls)}
    assert max(more for _, more in rows) < 300_000_000, over


def test_arrays_of_the_sound_store_are_what_these_tests_think(sound):
    there = arrays(sound)
    assert there["translation_error_m"].shape == (2, 4, 3)
    assert there["detection"].tolist() == [[1] * 4, [1] * 4]
    assert json.loads((sound / MANIFEST).read_text())["files"].keys() >= {"trial/c/0", "xyz/c/0"}
