"""Rules across the keys of a pipeline: each is a function that adds its faults to a reading.

A parameter whose own value is at fault is passed over: its fault is known already.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

from sweep.environments.identity import identify
from sweep.environments.interpreters import INSTALLED
from sweep.errors import EnvironmentFaultError
from sweep.measure.detector import DetectorSetting
from sweep.measure.detectors import OPENCV
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.model.effects import GEOMETRIC, NEEDS, RANDOM
from sweep.model.image_file import MAX_PIXELS
from sweep.model.marker import (
    has_circles,
    marker_count,
    markers_digest,
    missing_package,
    opencv_dictionary_names,
)
from sweep.plan.alternatives import IN_CAMERA, PHOTOGRAPHS, WORLD, contradictions
from sweep.plan.axes import TRIAL
from sweep.plan.background_files import check_backgrounds
from sweep.plan.beliefs import beliefs_in_one_way
from sweep.plan.board_rules import boards_are_searched_and_solved, boards_can_be_printed
from sweep.plan.camera_values import one_camera
from sweep.plan.effect_values import mosaics_have_room, noise_tables_ascend
from sweep.plan.parameters import PARAMETERS, SECTIONS, Stage
from sweep.plan.photograph_rules import photographs_alone
from sweep.plan.reader import HEADER, Reading
from sweep.plan.schema import VARIABLES
from sweep.plan.sobol import REPLICATES
from sweep.plan.variable import LABELS

MAX_POSES = 10**12
"""The largest grid."""

MAX_CONFIGURATIONS = 10_000
"""The most configurations: they are listed, and each has its share of every block."""


def pose_in_one_way(reading: Reading) -> None:
    """Demand a distance, and each quantity of the pose in one way."""
    if PHOTOGRAPHS in reading.given:
        return
    for first, other in contradictions(reading.given):
        reading.fault(
            other, reading.written(other), f"{first} or {other}, not both; delete one of them"
        )
    world = [name for name in WORLD if name in reading.given]
    in_camera = [name for name in IN_CAMERA if name in reading.given]
    if world and in_camera:
        reading.fault(
            world[0], reading.written(world[0]),
            "a pose in the world or in the camera's frame, not both; delete "
            f"{', '.join(world)}, or {', '.join(in_camera)}",
        )
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
        reading.fault(
            "marker_id", reading.written("marker_id"),
            f"IDs from 0 to {count - 1}, which is what {dictionary} has",
        )


def dictionaries_can_be_drawn(reading: Reading) -> None:
    """Demand the packages that have the codes of a dictionary, and a renderer for its circles.

    A store's pipeline can be read without them.
    """
    for dictionary in reading.values("dictionary"):
        missing = missing_package(dictionary)
        if missing is not None and reading.known_files is None:
            reading.fault("dictionary", dictionary, missing)
    for dictionaries, renderers in reading.together("dictionary", "renderer"):
        if any(map(has_circles, dictionaries)) and any(name != "exact" for name in renderers):
            reading.fault(
                "scene.renderer", reading.written("renderer"),
                "exact for STag's markers, which have circles",
            )
            break


def is_active(reading: Reading, switch: str) -> bool:
    """Return whether a switch has, or was meant to have, another than its neutral value."""
    values = reading.values(switch)
    if not values:
        return switch in reading.given
    off = reading.parameters[switch].default
    return any(value != off for value in values)


def effects_need_partners(reading: Reading) -> None:
    """Demand the parameters without which an effect's parameter has no meaning."""
    for name, others in NEEDS.items():
        values, off = reading.values(name), PARAMETERS[name].default
        wanted = any(value != off for value in values) if values else name in reading.given
        if wanted and not reading.given.intersection(others):
            partner = " or ".join(others) if len(others) < 3 else f"one of {', '.join(others)}"
            reading.fault(f"scene.{name}", reading.written(name), f"{partner} beside it")


def effects_need_the_exact_renderer(reading: Reading) -> None:
    """Demand the renderer ``exact`` for effects that act on edges."""
    others = [name for name in reading.values("renderer") if name != "exact"]
    for name in GEOMETRIC:
        if others and is_active(reading, name):
            reading.fault(
                f"scene.{name}", reading.written(name),
                f"renderer = exact; {others[0]} does not have it",
            )


def threshold_windows_in_order(reading: Reading) -> None:
    """Demand that the largest threshold window is not below the smallest."""
    low, high = "adaptiveThreshWinSizeMin", "adaptiveThreshWinSizeMax"
    if any(
        smallest and largest and max(smallest) > min(largest)
        for smallest, largest in reading.together(low, high)
    ):
        reading.fault(high, reading.written(high), f"at least {low}")


def fields_of_the_installed_opencv(reading: Reading) -> None:
    """Demand detector fields that the installed OpenCV has."""
    for name in reading.given & DetectorSetting.missing_fields():
        reading.fault(
            f"detector.{name}", reading.written(name), "a field that the installed OpenCV has"
        )


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


OPENCV_FIELDS = {field.name for field in dataclasses.fields(DetectorSetting)}


def environments_of_detectors(reading: Reading) -> None:
    """Demand environments that can be used, with the fields and the markers of the pipeline.

    What a store has recorded is not looked for.
    """
    if reading.known_plugins is not None:
        return
    defaults = DetectorSetting()
    for environment in dict.fromkeys(reading.values("environment")):
        if environment == INSTALLED:
            continue

        def beside(name: str, environment: str = environment) -> Iterator[Any]:
            return (value for environments, values in reading.together("environment", name)
                    if environment in environments for value in values)

        if any(value != OPENCV for value in beside("detector")):
            reading.fault(
                "detector.environment", environment,
                f"{INSTALLED} for detectors other than {OPENCV}; let both axes go together by zip",
            )
        try:
            identity = identify(environment, str(reading.folder))
        except EnvironmentFaultError as error:
            reading.fault(
                "detector.environment", environment, f"an environment for a detector: {error}"
            )
            continue
        own = f"OpenCV {identity.opencv} of environment {environment}"
        for name in sorted(OPENCV_FIELDS & reading.given - identity.fields.keys()):
            if any(value != getattr(defaults, name) for value in beside(name)):
                reading.fault(
                    f"detector.{name}", reading.written(name), f"a field that {own} has"
                )
        for dictionary in dict.fromkeys(beside("dictionary")):
            if dictionary not in identity.dictionaries:
                reading.fault("dictionary", dictionary, f"one that {own} has")
            elif identity.dictionaries[dictionary] != markers_digest(dictionary):
                reading.fault(
                    "dictionary", dictionary, f"one with the same markers in {own}: these differ"
                )


def names_of_settings(reading: Reading) -> None:
    """Demand names that nothing else of the dataset has for settings of plug-ins."""
    for plugin in reading.plugins:
        reading.faults += [
            f"{reading.source}: {plugin.name}: expected another name for its setting "
            f"{setting.name}: the dataset or its analyses have this one"
            for setting in plugin.settings
            if setting.name in RESERVED or setting.name.startswith("_")
        ]


def something_random_to_repeat(reading: Reading) -> None:
    """Demand a random quantity if there is more than one trial."""
    if PHOTOGRAPHS in reading.given:
        return
    trials = len(reading.axes[TRIAL]) if TRIAL in reading.axes else 1
    jitter = reading.values("jitter_px")
    noisy = any(is_active(reading, name) for name in RANDOM)
    noisy = noisy or any(
        is_active(reading, plugin.settings[0].name)
        for plugin in reading.plugins if plugin.kind == "effect" and plugin.random
    )
    noisy = noisy or "calibration" in reading.values("believed")
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
    jitter = reading.values("jitter_px")
    calibrated = "calibration" in reading.values("believed")
    if not reading.distributions and jitter and max(jitter) == 0 and not calibrated:
        reading.fault(
            "sampling", reading.sampling,
            "a distribution or jitter_px above 0 (the noise of pixels is independent in any case)",
        )


def names_of_axes(reading: Reading) -> None:
    """Demand names that nothing else of the dataset has for axes of parameters that go together."""
    for axis in reading.axes.values():
        if axis.zipped and (axis.name in RESERVED or axis.name.startswith("_")):
            reading.faults.append(
                f"{reading.source}: axes.{axis.name}: expected another name: the dataset or its "
                "analyses have this one"
            )


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
    if "full" in reading.values("window"):
        reading.fault(
            "scene.window", reading.written("window"),
            f"auto, for a frame of more than {MAX_PIXELS:,} pixels",
        )
    for name, is_whole in (
        ("useAruco3Detection", bool),
        ("adaptiveThreshConstant", lambda value: value < 1),
        ("aprilTagQuadDecimate", lambda value: value > 1),
    ):
        if any(is_whole(value) for value in reading.values(name)):
            reading.fault(
                f"detector.{name}", reading.written(name),
                f"what needs no whole frame, for one of more than {MAX_PIXELS:,} pixels",
            )


RULES: tuple[Callable[[Reading], None], ...] = (
    photographs_alone,
    pose_in_one_way,
    one_camera,
    beliefs_in_one_way,
    ids_in_dictionary,
    dictionaries_can_be_drawn,
    boards_can_be_printed,
    boards_are_searched_and_solved,
    effects_need_partners,
    effects_need_the_exact_renderer,
    noise_tables_ascend,
    mosaics_have_room,
    threshold_windows_in_order,
    check_backgrounds,
    fields_of_the_installed_opencv,
    dictionaries_of_detectors,
    environments_of_detectors,
    names_of_settings,
    something_random_to_repeat,
    trials_fill_replicates,
    names_of_axes,
    size_of_the_grid,
    size_of_whole_frames,
)
"""Every rule, in the order of their messages."""


def check_rules(reading: Reading) -> None:
    """Add the faults of all rules to a reading."""
    for rule in RULES:
        rule(reading)
