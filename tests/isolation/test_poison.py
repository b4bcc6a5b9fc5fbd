"""Poison: a scene that ends or stalls the process that computes it costs itself and no other."""

import json
import re
import time

import numpy as np
import pytest
import xarray as xr

from support.commands import command, complaints
from support.poison import RAISES, Poison, poisoned
from support.stores import by_hand
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.experiment.pipeline import cell as cell_at
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store

pytestmark = pytest.mark.system


TEXT = """
title = "Scenes of which some are poisoned"
seed = 11
[marker]
size_m = 0.04
[pose]
jitter_px = 0.5
azimuth_deg = { uniform = [0, 360] }
[scene]
background = 128
[axes]
distance_m = [0.2, 0.3, 0.4]
cornerRefinementMethod = ["none", "subpix"]
tilt_deg = [10, 45]
solver = ["ippe_square", "iterative"]
trial = 20
"""

LIMIT_S = 40
"""Time limit of long tests: parts of it must do for a start on a busy machine."""

EXTENTS = (1, 1, 20)
"""Blocks of the short grid: block k has the scenes 20 k to 20 k + 19."""

SIGNALS = {"segv": "SIGSEGV", "abort": "SIGABRT", "ill": "SIGILL"}
ENDLESS = ("sleep", "spin", "hold")


SUBPIX = (("cornerRefinementMethod", "subpix"),)
ITERATIVE = (("solver", "iterative"),)
IPPE = (("solver", "ippe_square"),)


def notes(log):
    """Return what the poisoned processes noted."""
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


def scene_index(pipeline, cell):
    """Return a scene's index along each scene axis."""
    axes = pipeline.experiment.scene_axes
    index = np.unravel_index(cell, [len(axis) for axis in axes])
    return {axis.name: int(i) for axis, i in zip(axes, index, strict=True)}


def expected(reference, pipeline, poisons):
    """Return the reference's variables with what the poisons change in them, and where.

    The flags are those of the stage that is hit; the stages after it have nothing to work on.
    """
    values = {v.name: reference[v.name].to_numpy().copy() for v in pipeline.experiment.variables}
    changed = {name: np.zeros(array.shape, dtype=bool) for name, array in values.items()}
    for poison in poisons:
        named = dict(poison.setting + poison.solver)
        at = scene_index(pipeline, poison.cell)
        for axis in pipeline.axes_of(Stage.detection, Stage.estimation):
            if axis.name in named:
                at[axis.name] = list(axis.values).index(named[axis.name])
        first = {"truth": Stage.scene, "scene": Stage.detection, "detection": Stage.detection,
                 "estimation": Stage.estimation}[poison.stage]
        flags = {
            "detection": DetectionStatus.crashed if poison.deadly else DetectionStatus.failed,
            "estimate": EstimateStatus.no_detection,
            "flipped": Flipped.no_estimate,
            "bound": 0,
        }
        if first is Stage.estimation:
            flags["estimate"] = EstimateStatus.crashed if poison.deadly else EstimateStatus.failed
        for v in pipeline.experiment.variables:
            if v.stage >= first:
                where = tuple(at.get(name, slice(None)) for name in v.dimensions(pipeline))
                values[v.name][where] = np.nan if v.flags is None else flags[v.name]
                changed[v.name][where] = True
    return values, changed


def bits(array):
    return array.view(f"u{array.itemsize}")


def differing(url, reference, pipeline, poisons):
    """Return the variables that are not as expected, with how many values differ in each.

    Bit for bit, but for NaN where a poison put it: any NaN will do.
    """
    values, changed = expected(reference, pipeline, poisons)
    found = {}
    with xr.open_zarr(url, consolidated=False) as store:
        assert set(store.variables) == set(reference.variables)
        for name in set(store.coords) - set(values):
            assert store[name].equals(reference[name]), name
        for name, wanted in values.items():
            got = store[name].to_numpy()
            assert got.dtype == wanted.dtype
            alike = bits(got) == bits(wanted)
            if wanted.dtype.kind == "f":
                alike |= changed[name] & np.isnan(got) & np.isnan(wanted)
            if not alike.all():
                found[name] = int((~alike).sum())
    return found


def numbers(reference, pipeline, poisons):
    """Return how many detections and estimates are flagged crashed and failed."""
    values, _ = expected(reference, pipeline, poisons)
    return {
        flag: int((values["detection"] == DetectionStatus[flag]).sum()
                  + (values["estimate"] == EstimateStatus[flag]).sum())
        for flag in ("crashed", "failed")
    }


def see_who_died(log, poisons, store, workers):
    """Assert that no client died, and at most one worker for each block that holds poison.

    Returns the deaths by kind of process.
    """
    events = notes(log)
    deaths = [note for note in events if note["event"] == "act" and note["how"] not in RAISES]
    kinds = {kind: len({note["pid"] for note in deaths if note["kind"] == kind})
             for kind in ("client", "worker", "child", "other")}
    assert kinds["client"] == kinds["other"] == 0, deaths
    blocks = {block_of(store, poison.cell) for poison in poisons if poison.deadly}
    assert kinds["worker"] <= len(blocks)
    begun = {note["pid"] for note in events if (note["event"], note["kind"]) == ("start", "worker")}
    if not any(poison.how in ENDLESS for poison in poisons):
        # A worker that was ended for another's poison would have been replaced by one more. With a
        # short time limit, a busy machine alone may end one.
        assert len(begun) <= workers + kinds["worker"]
    asked = {(note["cell"], note["stage"]) for note in events if note["event"] == "act"}
    assert asked == {(poison.cell, poison.stage) for poison in poisons}, "a poison never acted"
    return kinds


def block_of(store, cell):
    """Return the number of the block that a scene is in."""
    index = scene_index(store.pipeline, cell).values()
    number = 0
    for i, extent, count in zip(index, store.blocks.extents, store.blocks.counts, strict=True):
        number = number * count + i // extent
    return number


def see_status(url, pipeline, poisons):
    """Assert that ``sweep status`` names every crashed scene, where it is, and why."""
    plain = command("status", url)
    assert (plain.returncode, plain.stderr) == (0, "")
    lines = [line for line in plain.stdout.splitlines() if line.split()[0] == "crashed"]
    told = {}
    for line in lines:
        at = re.search(r"--at (\S+)", line)[1]
        one = cell_at(pipeline, at)  # it can be handed to the other commands as it is
        key = tuple(
            one.axes[0].values[0] if axis.name == "trial" else one.fixed[axis.name]
            for axis in pipeline.experiment.scene_axes
        )
        told.setdefault(key, []).append(line)
    wanted = {}
    for poison in poisons:
        if poison.deadly:
            index = scene_index(pipeline, poison.cell)
            key = tuple(axis.values[index[axis.name]] for axis in pipeline.experiment.scene_axes)
            wanted.setdefault(key, []).append(poison)
    assert told.keys() == wanted.keys(), plain.stdout
    for key, those in wanted.items():
        for poison in those:
            why = "time limit" if poison.how in ENDLESS else SIGNALS.get(poison.how, "")
            assert any(why in line for line in told[key]), (poison, told[key])
    written = command("status", url, "--json").stdout
    json.loads(written)
    for line in lines:
        assert re.search(r"--at (\S+)", line)[1] in written


@pytest.fixture(scope="module")
def pipeline():
    return Pipeline.from_text(TEXT, name="poisoned")


@pytest.fixture(scope="module")
def clean(pipeline, tmp_path_factory):
    """The short grid's results without poison."""
    url = str(tmp_path_factory.mktemp("clean") / "clean.zarr")
    by_hand(url, pipeline)
    with xr.open_zarr(url, consolidated=False) as opened:
        loaded = opened.load()
        assert (loaded.estimate == EstimateStatus.solved).all()
        return loaded


def run_poisoned(tmp_path, text, poisons, *options, timeout=300):
    """Run a pipeline, poisoned; return what the command said, its seconds, and the notes' file."""
    path, log = tmp_path / "poisoned.toml", tmp_path / "notes.jsonl"
    path.write_text(text)
    begun = time.monotonic()
    ran = command(
        "run", path, "--store", tmp_path / "poisoned.zarr", *options,
        env=poisoned(poisons, log), cwd=tmp_path, timeout=timeout,
    )
    return ran, time.monotonic() - begun, log


MANY = [
    # First of a block; last and the one before it; one that does not end anything between.
    Poison(20, "scene", "segv"),
    Poison(58, "scene", "ill"), Poison(59, "detection", "abort", SUBPIX),
    Poison(50, "detection", "raise", SUBPIX),
    Poison(70, "estimation", "segv", (), ITERATIVE),
    Poison(105, "truth", "exit"),
]


@pytest.mark.evidence
def test_scenes_that_end_their_process_are_found_and_no_other_is_touched(
    pipeline, clean, tmp_path
):
    poisons = MANY
    url = str(tmp_path / "poisoned.zarr")
    store = create_store(url, pipeline, EXTENTS)
    ran, seconds, log = run_poisoned(tmp_path, TEXT, poisons, "--workers", 2)
    assert (ran.returncode, complaints(ran)) == (0, [])
    assert differing(url, clean, pipeline, poisons) == {}
    counts = numbers(clean, pipeline, poisons)
    for kind in ("crashed", "failed"):
        told = re.findall(rf"([\d,]+) {kind}\b.* of [\d,]+ (?:detections|estimates)", ran.stdout)
        assert sum(int(count.replace(",", "")) for count in told) == counts[kind], ran.stdout
    assert ran.stdout.splitlines()[-1].startswith(f"next: sweep repro {url} --at ")
    kinds = see_who_died(log, poisons, store, 2)
    print(f"{seconds:.1f} s; deaths: {kinds}")
    assert committed(store) == set(range(6))
    see_status(url, pipeline, poisons)


@pytest.mark.evidence
def test_scene_that_never_returns_is_found_within_the_time_limit(pipeline, clean, tmp_path):
    url = str(tmp_path / "poisoned.zarr")
    # It keeps the interpreter's lock, so that no other thread of its process can act.
    poisons = [Poison(47, "detection", "hold", SUBPIX)]
    store = create_store(url, pipeline, EXTENTS)
    ran, seconds, log = run_poisoned(
        tmp_path, TEXT, poisons, "--workers", 2, "--time-limit", 16, "--json"
    )
    assert (ran.returncode, complaints(ran)) == (0, [])
    assert differing(url, clean, pipeline, poisons) == {}
    assert json.loads(ran.stdout)["crashed"] == 1
    print(f"{seconds:.1f} s; stalled: {see_who_died(log, poisons, store, 2)}")
    see_status(url, pipeline, poisons)


THOUSANDS = TEXT.replace("distance_m = [0.2, 0.3, 0.4]", "distance_m = { linspace = [0.2, 0.4, 5] }"
                         ).replace("trial = 20", "trial = 1000")
SCENES = 10_000

AMONG_THOUSANDS = {
    "one that ends": [Poison(6_543, "scene", "segv")],
    "one that ends in the search": [Poison(0, "detection", "ill")],
    "one estimator that aborts": [Poison(9_999, "estimation", "abort", (), ITERATIVE)],
    "three in three ways": [
        Poison(123, "scene", "segv"), Poison(4_567, "detection", "abort", SUBPIX),
        Poison(8_901, "estimation", "ill", (), ITERATIVE),
    ],
    "two neighbours and a third": [
        Poison(5_000, "scene", "ill"), Poison(5_001, "detection", "segv", SUBPIX),
        Poison(7_250, "truth", "abort"),
    ],
    "first, middle and last of a block": [
        Poison(2_000, "scene", "abort"), Poison(2_125, "scene", "exit"),
        Poison(2_249, "estimation", "segv", (), IPPE),
    ],
    "three that raise": [
        Poison(100, "scene", "raise"), Poison(5_100, "detection", "raise", SUBPIX),
        Poison(9_100, "estimation", "raise", (), IPPE),
    ],
    "one that sleeps": [Poison(3_333, "scene", "sleep")],
    "one that spins": [Poison(4_444, "detection", "spin", SUBPIX)],
    "one that holds the lock": [Poison(5_555, "estimation", "hold", (), ITERATIVE)],
    "an endless one beside a deadly one": [
        Poison(6_000, "scene", "sleep"), Poison(6_001, "scene", "segv"),
    ],
}


@pytest.fixture(scope="module")
def thousands(tmp_path_factory):
    """Ten thousand scenes without poison: pipeline, results, and seconds of the command."""
    folder = tmp_path_factory.mktemp("thousands")
    pipeline = Pipeline.from_text(THOUSANDS, name="poisoned")
    assert pipeline.size(Stage.scene) == SCENES
    url = str(folder / "poisoned.zarr")
    create_store(url, pipeline, (1, 1, 250))
    ran, seconds, _ = run_poisoned(folder, THOUSANDS, [], "--workers", 2)
    assert ran.returncode == 0, ran.stderr
    with xr.open_zarr(url, consolidated=False) as opened:
        return pipeline, opened.load(), seconds


@pytest.mark.evidence
@pytest.mark.parametrize("poisons", AMONG_THOUSANDS.values(), ids=AMONG_THOUSANDS)
def test_poison_among_ten_thousand_scenes_costs_itself_alone(poisons, thousands, tmp_path):
    pipeline, reference, undisturbed_s = thousands
    url = str(tmp_path / "poisoned.zarr")
    store = create_store(url, pipeline, (1, 1, 250))
    endless = any(poison.how in ENDLESS for poison in poisons)
    limit = ("--time-limit", LIMIT_S) if endless else ()
    ran, seconds, log = run_poisoned(
        tmp_path, THOUSANDS, poisons, "--workers", 2, "--json", *limit, timeout=900
    )
    assert (ran.returncode, complaints(ran)) == (0, [])
    assert differing(url, reference, pipeline, poisons) == {}
    told = json.loads(ran.stdout)
    assert {flag: told[flag] for flag in ("crashed", "failed")} == numbers(
        reference, pipeline, poisons
    )
    kinds = see_who_died(log, poisons, store, 2)
    see_status(url, pipeline, poisons)
    hit = {poison.cell for poison in poisons}
    print(
        f"{SCENES - len(hit):,} scenes equal; {seconds:.1f} s, {undisturbed_s:.1f} s without "
        f"poison; deaths: {kinds}"
    )
    if endless:
        # Half as much again, and the start of a few processes: seconds are noisy here.
        assert seconds < undisturbed_s + 1.5 * LIMIT_S + 30.0
