"""Rules across the keys of a pipeline: each is a function that adds its faults to a reading."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from sweep.errors import PluginError
from sweep.experiment.axes import TRIAL
from sweep.experiment.beliefs import beliefs_in_one_way
from sweep.experiment.board_rules import boards_are_searched_and_solved, boards_can_be_printed
from sweep.experiment.draws import REPLICATES, SAMPLINGS
from sweep.experiment.parameters import (
    IN_CAMERA,
    PHOTOGRAPHS,
    RIVALS,
    SECTIONS,
    SIMULATED,
    WORLD,
    Stage,
    contradictions,
)
from sweep.experiment.photographs import PhotographRecord, read_record
from sweep.experiment.reader import HEADER, Reading
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.experiment.stopping import SEARCH
from sweep.measure.detectors import OPENCV, DetectorSetting
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.messages import plain, shown
from sweep.model.effects import GEOMETRIC, NEEDS, RANDOM
from sweep.model.image_file import MAX_PIXELS, decode_grey, read_image
from sweep.model.marker import (
    has_circles,
    marker_count,
    missing_package,
    opencv_dictionary_names,
)
from sweep.model.sensor import MAX_LEVEL, MIN_FRAME_PX

# --------------------------------------------------------------------------------------------------
# Background images that a pipeline names: that they can be read, their size, their digests.

def check_backgrounds(reading: Reading) -> None:
    """Note the digests of a reading's background images, and the faults of those that cannot be."""
    for value in reading.values_of("background"):
        if not isinstance(value, str):
            continue
        if not value.isprintable():
            reading.fault("scene.background", value, "a path without control characters")
            continue
        if reading.known_files is not None:
            reading.files[value] = reading.known_files.get(value, "")
            continue
        path = os.path.join(reading.folder, value)  # noqa: PTH118  (it may be of any length)
        try:
            height, width = decode_grey(path).shape
            problem = _wrong_size(reading, value, width, height)
            reading.files[value] = file_digest(Path(path)) or ""
        except ValueError as error:
            reading.fault("scene.background", value, f"a level or an image file ({error})")
            continue
        if problem is not None:
            reading.fault("scene.background", value, problem)


def _wrong_size(reading: Reading, background: str, width: int, height: int) -> str | None:
    """Return the expectation that a background of a size in pixels misses; None if it fits."""
    for name, length in (("width_px", width), ("height_px", height)):
        frames = {
            frame for backgrounds, frames in reading.together("background", name)
            if background in backgrounds for frame in frames
        }
        if frames - {length}:
            return (
                f"an image of exactly the frame's size: it is {width} x {height}, but "
                f"{name} = {shown(reading.written(name))}"
            )
    return None


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 of an image file; None if it cannot be read."""
    try:
        return hashlib.sha256(read_image(str(path))).hexdigest()
    except ValueError:
        return None


# --------------------------------------------------------------------------------------------------
# Rules of pipelines whose scenes are photographs.

def photographs_alone(reading: Reading) -> None:
    """Demand the photographs' own poses and images, their markers, and their files unchanged.

    Of images that are simulated at their poses, the poses and the markers alone.
    """
    simulated = any(reading.values_of(SIMULATED))
    if PHOTOGRAPHS not in reading.given:
        if simulated:
            reading.refuse(SIMULATED, f"{PHOTOGRAPHS} beside it, whose poses are taken")
        return
    if reading.axis_of(SIMULATED) is not None:
        reading.refuse(SIMULATED, "one value")
        return
    for name in sorted(reading.given):
        section = reading.parameters[name].section
        if section == "pose" or (
            section == "scene" and not simulated and name not in (PHOTOGRAPHS, SIMULATED)
        ):
            reading.refuse(name, "nothing beside photographs, which have their own "
                           f"poses{'' if simulated else ' and light'}; delete it")
    for name in reading.distributions if not simulated else ():
        reading.refuse(name, "a value: photographs are not drawn")
    reading.refuse_values(
        "believed", "truth, for photographs", lambda name: name == "calibration")
    if reading.sampling != SAMPLINGS[0]:
        reading.fault("sampling", reading.sampling, f"{SAMPLINGS[0]}, for photographs")
    if SEARCH in reading.document:
        reading.fault(SEARCH, reading.document[SEARCH], "no such section: photographs are given")
    if reading.known_files is not None:
        reading.files.update(reading.known_files)
        return
    for name in dict.fromkeys(reading.values_of(PHOTOGRAPHS)):
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
    unknown = [each for each in reading.values_of("marker_id") if each not in ids]
    if unknown:
        yield f"markers that it has: {shown(sorted(ids))}; marker_id = {unknown[0]} is none of them"
    for key, length in (("width_px", record.width_px), ("height_px", record.height_px)):
        for names, lengths in reading.together(PHOTOGRAPHS, key):
            if name in names and any(each != length for each in lengths):
                yield f"{key} = {length}, that of its photographs"


# --------------------------------------------------------------------------------------------------
# Rules across the keys of a pipeline: each is a function that adds its faults to a reading.
#
# A parameter whose own value is at fault is passed over: its fault is known already.

MAX_POSES = 10**12
"""The largest grid."""

MAX_CONFIGURATIONS = 10_000
"""The most configurations: they are listed, and each has its share of every block."""


def each_in_one_way(reading: Reading) -> None:
    """Demand a distance, and each quantity of pose, camera and beliefs in one way."""
    has_poses = PHOTOGRAPHS in reading.given
    given = reading.given - reading.stated.keys() - (set(IN_CAMERA) if has_poses else set())
    for first, other in contradictions(given):
        reading.refuse(
            other[0], f"{', '.join(first)} or {', '.join(other)}, not both; delete one of them")
    if has_poses:
        return
    world = [name for name in WORLD if name in reading.given]
    in_camera = [name for name in IN_CAMERA if name in reading.given]
    if world and in_camera:
        reading.refuse(world[0], "a pose in the world or in the camera's frame, not both; delete "
                       f"{', '.join(world)}, or {', '.join(in_camera)}")
    if not world and not {"distance_m", "side_px"} & reading.given:
        reading.faults.append(
            f"{reading.source}: pose: expected distance_m or side_px, fixed or under [axes]"
        )


def ids_in_dictionary(reading: Reading) -> None:
    """Demand that every ID of the grid exists in every dictionary of the grid."""
    too_few: dict[str, int] = {}
    for ids, dictionaries in reading.together("marker_id", "dictionary"):
        if ids:
            largest = max(ids[0], ids[-1]) if isinstance(ids, range) else max(ids)
            counts = {dictionary: marker_count(dictionary) for dictionary in dictionaries}
            too_few |= {name: count for name, count in counts.items() if largest >= count}
    for dictionary, count in too_few.items():
        reading.refuse("marker_id", f"IDs from 0 to {count - 1}, which is what {dictionary} has")


def dictionaries_can_be_drawn(reading: Reading) -> None:
    """Demand the packages that have the codes of a dictionary, and a renderer for its circles.

    A store's pipeline can be read without them.
    """
    for dictionary in reading.values_of("dictionary") if reading.known_files is None else ():
        if (missing := missing_package(dictionary)) is not None:
            reading.fault("marker.dictionary", dictionary, missing)
    for dictionaries, renderers in reading.together("dictionary", "renderer"):
        if any(map(has_circles, dictionaries)) and any(name != "exact" for name in renderers):
            reading.refuse("renderer", "exact for STag's markers, which have circles")
            break


PARTNERS = {"fy_px": ("fx_px",), "pixel_size_um": ("focal_length_mm",), **NEEDS}
"""Parameter -> those of which one must be given beside it."""


def partners_are_given(reading: Reading) -> None:
    """Demand the parameters without which another has no meaning; not those of a rival way."""
    for name, others in PARTNERS.items():
        if reading.is_active(name) and not reading.given.intersection(
                (*others, *RIVALS.get(name, ()))):
            partner = " or ".join(others) if len(others) < 3 else f"one of {', '.join(others)}"
            reading.refuse(name, f"{partner} beside it")


def effects_need_the_exact_renderer(reading: Reading) -> None:
    """Demand the renderer ``exact`` for effects that act on edges."""
    others = [name for name in reading.values_of("renderer") if name != "exact"]
    for name in GEOMETRIC:
        if others and reading.is_active(name):
            reading.refuse(name, f"renderer = exact; {others[0]} does not have it")


def noise_tables_ascend(reading: Reading) -> None:
    """Demand noise tables whose levels ascend on the scale, with deviations of at least 0."""
    def wrong(table: Sequence[float]) -> bool:
        levels, deviations = table[::2], table[1::2]
        return (
            any(a >= b for a, b in itertools.pairwise(levels))
            or not all(0 <= level <= MAX_LEVEL for level in levels)
            or not all(0 <= deviation <= 1e6 for deviation in deviations)
        )

    reading.refuse_values("noise_table", "level, standard deviation, level, standard deviation, "
                          f"...: levels that ascend from 0 to {MAX_LEVEL:g}, deviations of at "
                          "least 0", wrong)


def mosaics_have_room(reading: Reading) -> None:
    """Demand frames that can be demosaiced."""
    for name in ("width_px", "height_px"):
        if min(reading.values_of(name), default=MIN_FRAME_PX) < MIN_FRAME_PX and any(
                value != "none" for value in reading.values_of("bayer")):
            reading.refuse(name, f"at least {MIN_FRAME_PX}, for bayer to be demosaiced")


def threshold_windows_in_order(reading: Reading) -> None:
    """Demand that the largest threshold window is not below the smallest."""
    low, high = "adaptiveThreshWinSizeMin", "adaptiveThreshWinSizeMax"
    if any(
        smallest and largest and max(smallest) > min(largest)
        for smallest, largest in reading.together(low, high)
    ):
        reading.refuse(high, f"at least {low}")


def fields_of_the_installed_opencv(reading: Reading) -> None:
    """Demand detector fields that the installed OpenCV has."""
    for name in reading.given & DetectorSetting.missing_fields():
        reading.refuse(name, "a field that the installed OpenCV has")


def dictionaries_of_detectors(reading: Reading) -> None:
    """Demand dictionaries that each detector has."""
    known: dict[str, tuple[str, ...]] = {
        OPENCV: opencv_dictionary_names(),
        **{plugin.name: plugin.dictionaries for plugin in reading.plugins
           if plugin.kind == "detector" and plugin.dictionaries},
    }
    pairs = dict.fromkeys(
        pair for some in reading.together("detector", "dictionary")
        for pair in itertools.product(*some)
    )
    for detector, dictionary in pairs:
        if dictionary not in known.get(detector, (dictionary,)):
            expected = (
                "one of OpenCV's for its detector; give another detector"
                if detector == OPENCV
                else f"one that the detector {detector} has: {', '.join(known[detector])}"
            )
            reading.fault("dictionary", dictionary, expected)


def something_random_to_repeat(reading: Reading) -> None:
    """Demand a random quantity if there is more than one trial."""
    if PHOTOGRAPHS in reading.given:
        return
    trials = len(reading.axes[TRIAL]) if TRIAL in reading.axes else 1
    jitter = reading.values_of("jitter_px")
    noisy = any(reading.is_active(name) for name in RANDOM)
    noisy = noisy or any(
        reading.is_active(plugin.settings[0].name)
        for plugin in reading.plugins if plugin.kind == "effect" and plugin.random
    )
    noisy = noisy or "calibration" in reading.values_of("believed")
    if trials > 1 and not reading.distributions and jitter and max(jitter) == 0 and not noisy:
        reading.fault(
            "axes.trial", trials,
            "something random to repeat: jitter_px above 0, noise, or a distribution",
        )


def trials_fill_replicates(reading: Reading) -> None:
    """Demand trials, and draws, that are the replicates of Sobol's points as a whole."""
    if reading.sampling != "sobol" or TRIAL not in reading.axes or reading.stopping is not None:
        return
    trials = len(reading.axes[TRIAL])
    if trials % REPLICATES or trials < 2 * REPLICATES:
        reading.fault(
            "axes.trial", trials,
            f"a multiple of {REPLICATES}, at least {2 * REPLICATES}, for sampling = sobol: "
            f"{REPLICATES} replicates of as many points each, best a power of two",
        )
    jitter = reading.values_of("jitter_px")
    calibrated = "calibration" in reading.values_of("believed")
    if not reading.distributions and jitter and max(jitter) == 0 and not calibrated:
        reading.fault(
            "sampling", reading.sampling,
            "a distribution or jitter_px above 0 (the noise of pixels is independent in any case)",
        )


def names_are_free(reading: Reading) -> None:
    """Demand names that nothing else of the dataset has for plug-ins' settings and joint axes."""
    names = [(plugin.name, f"name for its setting {setting.name}", setting.name)
             for plugin in reading.plugins for setting in plugin.settings]
    names += [(f"axes.{axis.name}", "name", axis.name)
              for axis in reading.axes.values() if axis.zipped]
    reading.faults += [
        f"{reading.source}: {start}: expected another {what}: the dataset or its analyses have "
        "this one" for start, what, name in names if name in RESERVED or name.startswith("_")
    ]


RESERVED = {
    *VARIABLES, *LABELS, *HEADER, *SECTIONS, "axes", TRIAL,
    *(flag.name for flags in (BoundStatus, DetectionStatus, EstimateStatus, Flipped)
      for flag in flags),
    "block", "commits", "compared", "cost", "count", "draws", "failure", "failures", "image_x_px",
    "image_y_px",
    "jitter_u_px", "jitter_v_px", "level", "looked_for", "outcome", "share", "treatment",
}
"""Names in datasets and tables that no axis may take."""


def size_of_the_grid(reading: Reading) -> None:
    """Limit the number of poses and of configurations."""
    lengths = {axis: len(axis) for axis in reading.axes.values()}
    poses = math.prod(lengths.values())
    if poses > MAX_POSES:
        reading.faults.append(
            f"{reading.source}: axes: {min(poses, 10**300):.3g} poses: expected at most "
            f"{MAX_POSES:.0e}"
        )
    configurations = math.prod(
        length for axis, length in lengths.items() if axis.stage is not Stage.scene
    )
    if configurations > MAX_CONFIGURATIONS:
        reading.faults.append(
            f"{reading.source}: axes: {min(configurations, 10**300):.3g} detector settings times "
            f"estimators: expected at most {MAX_CONFIGURATIONS:,}"
        )


def size_of_whole_frames(reading: Reading) -> None:
    """Refuse settings that search the whole frame if the frame is too large."""
    frame = max(
        max(widths or (0,)) * max(heights or (0,))
        for widths, heights in reading.together("width_px", "height_px")
    )
    if frame <= MAX_PIXELS:
        return
    for name, is_whole in (
        ("window", lambda value: value == "full"),
        ("useAruco3Detection", bool),
        ("adaptiveThreshConstant", lambda value: value < 1),
        ("aprilTagQuadDecimate", lambda value: value > 1),
    ):
        if any(is_whole(value) for value in reading.values_of(name)):
            reading.refuse(
                name, f"what needs no whole frame, for one of more than {MAX_PIXELS:,} pixels")


RULES: tuple[Callable[[Reading], None], ...] = (
    photographs_alone,
    each_in_one_way,
    beliefs_in_one_way,
    ids_in_dictionary,
    dictionaries_can_be_drawn,
    boards_can_be_printed,
    boards_are_searched_and_solved,
    partners_are_given,
    effects_need_the_exact_renderer,
    noise_tables_ascend,
    mosaics_have_room,
    threshold_windows_in_order,
    check_backgrounds,
    fields_of_the_installed_opencv,
    dictionaries_of_detectors,
    something_random_to_repeat,
    trials_fill_replicates,
    names_are_free,
    size_of_the_grid,
    size_of_whole_frames,
)
"""Every rule, in the order of their messages."""


def check_rules(reading: Reading) -> None:
    """Add the faults of all rules to a reading."""
    for rule in RULES:
        rule(reading)
