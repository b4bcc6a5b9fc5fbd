"""Rules of pipelines whose scenes are photographs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sweep.errors import PluginError
from sweep.messages import plain, shown
from sweep.plan.alternatives import PHOTOGRAPHS, SIMULATED
from sweep.plan.axes import TRIAL
from sweep.plan.background_files import file_digest
from sweep.plan.draws import SAMPLINGS
from sweep.plan.photographs import PhotographRecord, read_record
from sweep.plan.reader import Reading
from sweep.plan.stopping import SECTIONS


def photographs_alone(reading: Reading) -> None:
    """Demand the photographs' own poses and images, their markers, and their files unchanged.

    Of images that are simulated at their poses, the poses and the markers alone.
    """
    simulated = any(reading.values(SIMULATED))
    if PHOTOGRAPHS not in reading.given:
        if simulated:
            reading.fault(SIMULATED, True, f"{PHOTOGRAPHS} beside it, whose poses are taken")
        return
    if reading.axis_of(SIMULATED) is not None:
        reading.fault(SIMULATED, reading.written(SIMULATED), "one value")
        return
    for name in sorted(reading.given):
        section = reading.parameters[name].section
        if section == "pose" or (
            section == "scene" and not simulated and name not in (PHOTOGRAPHS, SIMULATED)
        ):
            reading.fault(
                name, reading.written(name), "nothing beside photographs, which have their own "
                f"poses{'' if simulated else ' and light'}; delete it",
            )
    if reading.distributions and not simulated:
        name = min(reading.distributions)
        reading.fault(name, reading.written(name), "a value: photographs are not drawn")
    if "calibration" in reading.values("believed"):
        reading.fault("estimator.believed", "calibration", "truth, for photographs")
    if reading.sampling != SAMPLINGS[0]:
        reading.fault("sampling", reading.sampling, f"{SAMPLINGS[0]}, for photographs")
    for name in SECTIONS:
        if name in reading.document:
            reading.fault(name, reading.document[name], "no such section: photographs are given")
    if reading.known_files is not None:
        reading.files.update(reading.known_files)
        return
    for name in dict.fromkeys(reading.values(PHOTOGRAPHS)):
        _check_record(reading, name, simulated)


def _check_record(reading: Reading, name: str, simulated: bool) -> None:
    path = Path(reading.folder) / name
    try:
        record, digest = read_record(path)
    except PluginError as error:
        reading.fault(f"scene.{PHOTOGRAPHS}", name, str(error))
        return
    reading.files[name] = digest
    for expected in _mismatches(reading, name, record, simulated):
        reading.fault(f"scene.{PHOTOGRAPHS}", name, expected)
    for relative, known in zip(record.paths, record.digests, strict=True):
        found = known if simulated else file_digest(path.parent / relative)
        if found != known:
            reading.faults.append(
                f"{reading.source}: {plain(relative)}: "
                + ("the photograph cannot be read" if found is None else
                   "the photograph is not the one that was recorded: its SHA-256 differs")
            )
        reading.files[relative] = known


def _mismatches(
    reading: Reading, name: str, record: PhotographRecord, simulated: bool
) -> Iterator[str]:
    """Yield what the pipeline asks of a record that it does not have."""
    trials = len(reading.axes[TRIAL]) if TRIAL in reading.axes else 1
    largest = reading.axes[TRIAL].values[-1] + 1 if TRIAL in reading.axes else 1
    if largest > len(record.paths) and not simulated:
        yield f"trial = {len(record.paths)} at most: its photographs; there are {trials} trials"
    ids = set(record.marker_id.tolist())
    unknown = [each for each in reading.values("marker_id") if each not in ids]
    if unknown:
        yield f"markers that it has: {shown(sorted(ids))}; marker_id = {unknown[0]} is none of them"
    for key, length in (("width_px", record.width_px), ("height_px", record.height_px)):
        for names, lengths in reading.together(PHOTOGRAPHS, key):
            if name in names and any(each != length for each in lengths):
                yield f"{key} = {length}, that of its photographs"
