"""A scene or plug-in that ends or stalls its process costs itself and no other."""

import functools
import json

import numpy as np
import pytest
import xarray as xr

from support.commands import command, complaints
from support.poison import Poison, poisoned
from support.stores import GRID as TEXT
from support.stores import by_hand
from sweep.execution.status import status
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline, selection_text
from sweep.measure.flags import Ambiguous, DetectionStatus, EstimateStatus, Flipped
from sweep.store.blocks import committed
from sweep.store.lifecycle import create_store, open_store

pytestmark = pytest.mark.system


SUBPIX = (("cornerRefinementMethod", "subpix"),)
ITERATIVE = (("solver", "iterative"),)


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
        first = Stage.estimation if poison.stage == "estimation" else Stage.detection
        flags = {
            "detection": DetectionStatus.crashed if poison.deadly else DetectionStatus.failed,
            "estimate": EstimateStatus.no_detection,
            "flipped": Flipped.no_estimate, "ambiguous": Ambiguous.not_judged,
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
            alike = got.view(f"u{got.itemsize}") == wanted.view(f"u{got.itemsize}")
            if wanted.dtype.kind == "f":
                alike |= changed[name] & np.isnan(got) & np.isnan(wanted)
            if not alike.all():
                found[name] = int((~alike).sum())
    return found


def see_status(url, pipeline, poisons):
    """Assert that the status names every crashed scene so that other commands take it, and how."""
    names = {axis.name for axis in pipeline.experiment.scene_axes}
    deadly, crashed = [poison for poison in poisons if poison.deadly], status(url).crashed
    told = {tuple(part for part in cell["at"].split(",") if part.partition("=")[0] in names)
            for cell in crashed}
    assert told == {tuple(selection_text(pipeline, scene_index(pipeline, poison.cell)).split(","))
                    for poison in deadly}
    ways = {"segv": "SIGSEGV", "abort": "SIGABRT", "ill": "SIGILL", "hold": "time limit"}
    assert all(any(ways.get(poison.how, "") in cell["text"] for cell in crashed)
               for poison in deadly)


POISONS = [
    # First of a block; last of one; one that does not end anything between.
    Poison(8, "scene", "segv"),
    Poison(23, "detection", "abort", SUBPIX),
    Poison(20, "detection", "raise", SUBPIX),
    Poison(28, "estimation", "segv", (), ITERATIVE),
]

THOUSANDS = TEXT.replace("distance_m = [0.2, 0.3, 0.4]", "distance_m = { linspace = [0.2, 0.4, 5] }"
                         ).replace("trial = 8", "trial = 1000")

CASES = {
    "end": (TEXT, POISONS, ()),
    # It keeps the interpreter's lock, so that no other thread of its process can act.
    "stall": (TEXT, [Poison(18, "detection", "hold", SUBPIX)], ("--time-limit", 16)),
    "three of 10,000 in three ways": (THOUSANDS, [
        Poison(123, "scene", "segv"), Poison(4_567, "detection", "abort", SUBPIX),
        Poison(8_901, "estimation", "ill", (), ITERATIVE),
    ], ()),
    "an endless one of 10,000 beside a deadly one": (THOUSANDS, [
        Poison(6_000, "scene", "hold"), Poison(6_001, "scene", "segv"),
    ], ("--time-limit", 40)),
}
"""Name -> text of the pipeline, poisons, and options of the run."""


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    """Return a function that gives the results of a text without poison, computed once."""
    @functools.cache
    def results(text):
        url = str(tmp_path_factory.mktemp("clean") / "clean.zarr")
        by_hand(url, Pipeline.from_text(text))
        with xr.open_zarr(url, consolidated=False) as opened:
            loaded = opened.load()
        assert (loaded.estimate == EstimateStatus.solved).mean() > 0.99
        return loaded

    return results


@pytest.mark.parametrize("name", [
    name if name == "end" else pytest.param(name, marks=pytest.mark.evidence) for name in CASES])
def test_scenes_that_end_or_stall_their_process_are_found_and_no_other_is_touched(
    name, clean, claim, tmp_path
):
    text, poisons, options = CASES[name]
    pipeline, reference = Pipeline.from_text(text, name="poisoned"), clean(text)
    path, log, url = (tmp_path / name for name in ("poisoned.toml", "notes", "poisoned.zarr"))
    path.write_text(text)
    create_store(str(url), pipeline, (1, 1, 8 if text == TEXT else 250))
    ran = command("run", path, "--store", url, "--workers", 2, "--json", *options,
                  env=poisoned(poisons, log), cwd=tmp_path, timeout=900)
    assert (ran.returncode, complaints(ran)) == (0, [])
    assert committed(open_store(str(url))) == set(range(len(open_store(str(url)).blocks)))
    assert differing(url, reference, pipeline, poisons) == {}
    told = json.loads(ran.stdout)
    values, _ = expected(reference, pipeline, poisons)
    for flag in ("crashed", "failed"):
        assert told[flag] == sum((values[name] == flags[flag]).sum() for name, flags in (
            ("detection", DetectionStatus), ("estimate", EstimateStatus)))
    acted = [json.loads(line) for line in log.read_text().splitlines()]
    assert {(note["cell"], note["stage"]) for note in acted} == {
        (poison.cell, poison.stage) for poison in poisons}
    see_status(str(url), pipeline, poisons)
    claim("other results of 48 to 10,000 scenes of which some end or stall their process",
          "a run without them", 0.0, "bits differ")

PLUGINS = '''
import os
from pathlib import Path

import numpy as np
from sweep.plugins import EstimatorPlugin

CALLS = Path(__file__).parent / "calls"

def solve(detections):
    """End the process at each third call; they are numbered over all processes."""
    number = len(CALLS.read_bytes()) if CALLS.exists() else 0
    with CALLS.open("ab") as file:
        file.write(b".")
    if number % 3 == 2:
        os.abort()
    count = len(detections.corners)
    return np.tile(np.diag([1.0, -1.0, -1.0]), (count, 1, 1)), np.tile([0, 0, 1.0], (count, 1))

SOLVER = EstimatorPlugin(make=lambda _: solve, meaning="upright")
'''

CHANCE = """
seed = 7
camera = { width_px = 128, height_px = 96 }
marker = { size_m = 0.05 }
pose = { side_px = 48, jitter_px = 0.5 }
axes = { solver = ["ippe_square", "chance:SOLVER"], trial = 3 }
"""


@pytest.mark.evidence
def test_a_run_with_a_plug_in_that_dies_by_chance_keeps_all_of_opencv_s(tmp_path):
    (tmp_path / "chance.py").write_text(PLUGINS)
    (tmp_path / "grid.toml").write_text(CHANCE)
    ran = command("run", "grid.toml", "--store", "a.zarr", "--json", cwd=tmp_path)
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert (told["crashed"], told["failed"]) == (0, 0)
    with xr.open_zarr(tmp_path / "a.zarr") as results:
        assert (results.detection == DetectionStatus.detected).all()
        assert (results.estimate.sel(solver="ippe_square") == EstimateStatus.solved).all()
