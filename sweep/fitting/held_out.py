"""A fitted scene against photographs that were not used to fit it.

The markers of the held-out photographs are simulated at their poses with the scene that the others
gave, and with each of its effects left out in turn. An effect is worth having if it narrows the gap
between the errors of photographs and simulation by more than other random numbers do, or moves a
statistic of the simulated errors by more than its interval by photograph.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from sweep.analysis import simulation_gap
from sweep.analysis.simulation_gaps import QUANTILES, RATES
from sweep.exchange.files import write_whole
from sweep.execution.runner import execute
from sweep.fitting.scenes import PhotographScenes
from sweep.photographs.twins import twin_pipeline
from sweep.plan.alternatives import PHOTOGRAPHS
from sweep.plan.experiment import Pipeline
from sweep.plan.photographs import SUFFIX, PhotographRecord
from sweep.plan.toml_text import read_document
from sweep.store.lifecycle import open_dataset
from sweep.typing import Integers

MIN_HELD_OUT = 5
"""Held-out photographs from which errors have intervals."""

MAX_MARKERS = 12
"""Markers of a photograph whose errors are compared."""

REPEATS = 8
"""Simulations of each photograph. With one, the simulation's own random errors decide whether an
effect narrows the gap: of five photographs with shifts of 0.15 px, leaving the shifts out changed
it by -0.04 to 0.27 half-widths, and with eight by 0.03 to 0.28."""

MIN_GAIN = 0.05
"""Half-widths of the intervals by which an effect narrows the mean gap, to be worth having. Effects
that move no error (light, the noise's correlation) changed it there by ± 0.02 (standard deviation),
0.05 at most; by ± 0.03 with one simulation of each photograph."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Photographs that are held out, measured.

    Attributes
    ----------
    pipeline
        Theirs, in ``folder``.
    results
        Of the photographs.
    folder
        Where the stores of simulations go.
    """

    pipeline: Pipeline
    results: xr.Dataset
    folder: Path

    def gap(self, scene: Mapping[str, Any], name: str) -> xr.Dataset:
        """Return the photographs beside simulations with a scene."""
        store = str(self.folder / f"{name}.zarr")
        execute(twin_pipeline(self.pipeline, scene, REPEATS), store, overwrite=True)
        return simulation_gap(self.results, open_dataset(store)).load()

    def worth(
        self, full: xr.Dataset, scene: Mapping[str, Any], effects: Mapping[str, Sequence[str]]
    ) -> dict[str, bool]:
        """Return which effects narrow the gap, or move the simulated errors.

        Parameters
        ----------
        full
            The gap with the whole scene.
        scene
            Its parameters.
        effects
            Switch of an effect -> all its parameters.
        """
        found = {}
        for switch, names in effects.items():
            rest = {name: value for name, value in scene.items() if name not in names}
            without = self.gap(rest, switch)
            gain = gap_size(without, full) - gap_size(full, full)
            found[switch] = gain > MIN_GAIN or is_moved(full, without)
        return found


def is_moved(full: xr.Dataset, without: xr.Dataset) -> bool:
    """Return whether an error statistic of a simulation is outside its interval in the first."""
    for each in QUANTILES:
        low, high, other = (
            gap.sel(source="simulated")[name].values for gap, name in (
                (full, f"{each.name}_low"), (full, f"{each.name}_high"), (without, each.name)
            )
        )
        if ((other < low) | (other > high)).any():
            return True
    return False


def gap_size(gap: xr.Dataset, widths: xr.Dataset) -> float:
    """Return the mean size of all statistics' gaps, in half-widths of the intervals of ``widths``.

    Of ratios that of their logarithms. NaN if nothing has an interval.
    """
    sizes = []
    for each in (*RATES, *QUANTILES):
        value, low, high = (
            np.asarray(source[f"{each.name}_gap{end}"].values, dtype=np.float64)
            for source, end in ((gap, ""), (widths, "_low"), (widths, "_high"))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            if each.ratio:
                value, low, high = np.log(value), np.log(low), np.log(high)
            sizes.append((np.abs(value) / (0.5 * (high - low))).ravel())
    every = np.concatenate(sizes)
    known = every[np.isfinite(every)]
    return float(known.mean()) if len(known) else math.nan


def held_out(
    pipeline: Pipeline, taken: PhotographScenes, numbers: Integers, record: PhotographRecord,
    folder: Path,
) -> HeldOut:
    """Measure photographs that are held out.

    Parameters
    ----------
    pipeline, record
        Of all photographs; of a stereo camera the left one's.
    taken
        Their scenes, with the poses that count as true.
    numbers
        Of the photographs that are held out.
    folder
        Where the record and the stores go.
    """
    shape = len(record.paths), len(record.marker_id)
    chosen = dataclasses.replace(
        record, paths=tuple(
            str((folder / record.paths[k]).resolve()) for k in numbers.tolist()
        ), digests=tuple(record.digests[k] for k in numbers.tolist()),
        rotation=taken.scenes.rotation.reshape(*shape, 3, 3)[numbers],
        translation=taken.scenes.translation.reshape(*shape, 3)[numbers],
        std=record.std[numbers], source=taken.source.reshape(shape)[numbers],
    )
    name = "held-out"
    write_whole(folder / f"{name}{SUFFIX}", chosen.content())
    document = read_document(pipeline.to_toml())
    axes = document["axes"]
    stereo = axes.pop("stereo_camera", None)
    if stereo is not None:
        document["camera"] |= {
            key: values[0] for key, values in stereo["zip"].items() if key != PHOTOGRAPHS
        }
    document["scene"][PHOTOGRAPHS] = f"{name}{SUFFIX}"
    axes["trial"] = len(numbers)
    if "marker_id" in axes:
        every = record.marker_id
        spread = np.unique(np.linspace(0, len(every) - 1, MAX_MARKERS).astype(np.int64))
        axes["marker_id"] = every[spread].tolist()
    smaller = Pipeline.from_dict(document, name=name, source="held out", folder=folder)
    store = str(folder / f"{name}.zarr")
    execute(smaller, store, overwrite=True)
    return HeldOut(smaller, open_dataset(store), folder)
