"""Rules across the keys of a pipeline: records of values that cannot be, and functions."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sweep.errors import PluginError
from sweep.experiment.axes import MAX_DEVIATIONS, TRIAL
from sweep.experiment.document import HEADER, SEARCH, Reading
from sweep.experiment.draws import REPLICATES, SAMPLINGS
from sweep.experiment.parameters import (
    CHOICES,
    FIELDS_OF_VIEW,
    FOCAL_LENGTHS,
    IN_CAMERA,
    IN_MM,
    PARAMETERS,
    PHOTOGRAPHS,
    RIVALS,
    SECTIONS,
    SENSOR_SIDES,
    SIMULATED,
    STATED,
    WORLD,
    Stage,
)
from sweep.experiment.photographs import PHOTOGRAPH_RECORDS
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.measure.detectors import OPENCV, DetectorSetting
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.messages import plain, shown
from sweep.model.board_kinds import (
    ARRANGING,
    NEEDED,
    SINGLE,
    arranged_board,
    arrangement_faults,
    is_solid,
    used_by,
)
from sweep.model.calibration import MAX_BYTES, CalibrationError, calibration_of, read_tree
from sweep.model.camera import DEFAULT_SENSOR_MM, VIEW_PARAMETERS, are_square, intrinsics
from sweep.model.effects import GEOMETRIC, NEEDS, RANDOM
from sweep.model.image_file import MAX_PIXELS, decode_grey, read_image, read_regular
from sweep.model.marker import (
    has_circles,
    marker_count,
    missing_package,
    opencv_dictionary_names,
)
from sweep.model.renderers import MAX_BITMAP_PX, MAX_BITMAP_SIDE, bitmap_shape
from sweep.model.scene import RENDERERS, is_renderer
from sweep.model.sensor import MAX_LEVEL, MIN_FRAME_PX
from sweep.plugins.recording import is_recording

# --------------------------------------------------------------------------------------------------
# Two records: values that cannot meet on the grid, and parameters that have no place somewhere.
#
# A parameter whose own value is at fault is passed over: its fault is known already.

@dataclass(frozen=True, slots=True)
class Rule:
    """Values of parameters that cannot meet.

    Attributes
    ----------
    names
        The parameters; the first is at fault.
    wrong
        Whether a value of each cannot meet. Of numbers it gets the least and the largest, and of
        IDs the largest alone: in each number it changes once.
    expected
        What is expected in place of the first: text, or a function of a value of each.
    """

    names: tuple[str, ...]
    wrong: Callable[..., bool]
    expected: str | Callable[..., str]

    def check(self, reading: Reading) -> None:
        """Note each value that cannot be, with what is expected."""
        for values in reading.meeting(*self.names):
            if self.wrong(*values):
                reading.refuse_value(self.names[0], values[0], self.expected if isinstance(
                    self.expected, str) else self.expected(*values))


@dataclass(frozen=True, slots=True)
class Exclusion:
    """Parameters that have no place where something holds.

    Attributes
    ----------
    names
        The parameters.
    where
        Whether it holds.
    expected
        What is expected in place of a parameter that is given.
    active
        Whether a neutral value is none that counts.
    """

    names: Iterable[str]
    where: Callable[[Reading], Any]
    expected: str
    active: bool = False

    def check(self, reading: Reading) -> None:
        """Note each parameter that has no place."""
        for name in self.names:
            if name in reading.given and self.where(reading) and (
                    reading.is_active(name) or not self.active):
                reading.refuse(name, self.expected)


def check_rules(reading: Reading) -> None:
    """Add the faults of all rules to a reading, in the order of their messages."""
    for rule in RULES:
        rule(reading)


def _is_no_noise_table(table: Sequence[float]) -> bool:
    levels, deviations = table[::2], table[1::2]
    return (
        list(levels) != sorted(set(levels))
        or not all(0 <= level <= MAX_LEVEL for level in levels)
        or not all(0 <= deviation <= 1e6 for deviation in deviations)
    )


def _whole_frame(name: str, is_whole: Callable[[Any], bool]) -> Rule:
    """Return the rule that a setting does not search the whole frame if that is too large."""
    return Rule(
        (name, "width_px", "height_px"),
        lambda value, width, height: width * height > MAX_PIXELS and is_whole(value),
        f"what needs no whole frame, for one of more than {MAX_PIXELS:,} pixels")


def _without(*names: str) -> Callable[[Reading], bool]:
    """Return what says whether none of some parameters is given."""
    return lambda reading: reading.given.isdisjoint(names)


def _is_calibrated(reading: Reading) -> bool:
    """Return whether an estimator believes a calibration."""
    return "calibration" in reading.values_of("believed")


def _in_planes(*listed: Any) -> bool:
    """Return whether prints, listed as parameters' values, lie in several planes."""
    return any(map(is_solid, listed))


SEVERAL_PLANES = "for prints with z_m or tilt_deg"

OTHER_WAYS = (*IN_MM, *FIELDS_OF_VIEW)
"""The ways to give a camera beside focal lengths in pixels, and beside a file."""

PARTNERS = {"fy_px": ("fx_px",), "pixel_size_um": ("focal_length_mm",), **NEEDS}
"""Parameter -> those of which one must be given beside it, or one of a rival way."""

RECORDS: tuple[Rule | Exclusion, ...] = (
    *(Exclusion((name,), _without(*others, *RIVALS.get(name, ())),
                f"{' or '.join(others)} beside it", active=True)
      for name, others in PARTNERS.items()),
    Rule(("marker_id", "dictionary"),
         lambda marker_id, dictionary: marker_id >= marker_count(dictionary),
         lambda _, dictionary: f"IDs from 0 to {marker_count(dictionary) - 1}, which is what "
         f"{dictionary} has"),
    Rule(("noise_table",), _is_no_noise_table,
         "level, standard deviation, level, standard deviation, ...: levels that ascend from 0 "
         f"to {MAX_LEVEL:g}, deviations of at least 0"),
    *(Rule((name, "bayer"),
           lambda length, bayer: length < MIN_FRAME_PX and bayer != "none",
           f"at least {MIN_FRAME_PX}, for bayer to be demosaiced")
      for name in ("width_px", "height_px")),
    Rule(("adaptiveThreshWinSizeMax", "adaptiveThreshWinSizeMin"),
         lambda largest, smallest: largest < smallest, "at least adaptiveThreshWinSizeMin"),
    _whole_frame("window", lambda value: value == "full"),
    _whole_frame("useAruco3Detection", bool),
    _whole_frame("adaptiveThreshConstant", lambda value: value < 1),
    _whole_frame("aprilTagQuadDecimate", lambda value: value > 1),
    # Renderers.
    Rule(("renderer", "dictionary"),
         lambda renderer, dictionary: renderer != "exact" and has_circles(dictionary),
         "exact for STag's markers, which have circles"),
    Rule(("renderer", "kind", "distractors"),
         lambda renderer, kind, beside: not is_renderer(renderer) and (kind != SINGLE or beside),
         f"{RENDERERS}, for boards"),
    Rule(("renderer", "markers", "distractors"),
         lambda renderer, *listed: renderer != "exact" and _in_planes(*listed),
         f"exact, {SEVERAL_PLANES}"),
    Exclusion(GEOMETRIC, lambda reading: {*reading.values_of("renderer")} - {"exact"},
              "renderer = exact beside it, which alone has it", active=True),
    Exclusion(("curvature_per_m", "occlusion"),
              lambda reading: _in_planes(
                  *reading.values_of("markers"), *reading.values_of("distractors")),
              f"it absent, {SEVERAL_PLANES}: it is of one sheet", active=True),
    # Cameras, and what estimators believe of them.
    Exclusion(OTHER_WAYS, lambda reading: "camera_file" in reading.given,
              "no other camera beside camera_file; delete it, or camera_file"),
    Exclusion(
        ("believed_fx_px", "believed_fy_px", "believed_cx_px", "believed_cy_px",
         "believed_focal_scale", "believed_distortion"), _is_calibrated,
        "no other belief about the camera beside believed = calibration; delete one of them"),
    # Photographs, which have their own poses and light.
    Exclusion((SIMULATED,), _without(PHOTOGRAPHS),
              "photographs beside it, whose poses are taken", active=True),
    Exclusion(("kind",), lambda reading: PHOTOGRAPHS in reading.given and reading.shows_boards,
              "no board beside photographs, whose board `sweep photos` knows; delete it"),
    Rule(("believed", PHOTOGRAPHS), lambda believed, file: file and believed == "calibration",
         "truth, for photographs"),
    # Boards.
    Exclusion(("points", "refine", "refineDetectedMarkers", "minMarkers"),
              lambda reading: not reading.shows_boards, "a board: give kind under [board]"),
    Exclusion(("ids",), lambda reading: "marker_id" in reading.given,
              "ids, or marker_id of the first; not both", active=True),
    Rule(("points", "detector"),
         lambda points, detector: points == "chessboard" and is_recording(detector),
         "markers beside recorded detections, which have no corners of chessboards"),
    Rule(("refineDetectedMarkers", "detector"),
         lambda refine, detector: refine and is_recording(detector),
         "false beside recorded detections: no image is searched"),
    Rule(("refineDetectedMarkers", "markers"),
         lambda refine, listed: refine and is_solid(listed), f"false, {SEVERAL_PLANES}"),
    Rule(("solver", "points", "markers"),
         lambda solver, points, listed: is_solid(listed) and solver in SOLVERS
         and SOLVERS[solver].planar_only and points in ("markers", "chessboard"),
         f"one of iterative, sqpnp, epnp, photometric, {SEVERAL_PLANES}"),
)

ONE_VALUE = {
    "camera_file": "one file; cameras to compare are axes of fx_px, distortion and so on",
    **dict.fromkeys(STATED, "one list of numbers, not an axis"),
    SIMULATED: "one value",
    **dict.fromkeys(("ids", "markers", "distractors"), "it under [board]: it cannot be an axis"),
}
"""Parameters that cannot be an axis, and what is expected instead."""


def one_value(reading: Reading) -> None:
    """Demand one value of what cannot be an axis."""
    for name, expected in ONE_VALUE.items():
        if reading.axis_of(name) is not None:
            reading.refuse(name, expected)


# --------------------------------------------------------------------------------------------------
# The camera: the sides of its sensor, and the file of a calibration, whose values take the place
# of the camera's keys.
#
# A camera is given in one of four ways: focal lengths in pixels, a field of view, a focal length
# in millimetres (with the sensor's sides or the size of a pixel), or a calibration's file. The
# file's values are written into the pipeline's text: a store does not need the file any more.

def resolve_sensor(reading: Reading) -> None:
    """Give the sensor its default sides where these make the pixels square.

    So a pipeline that states the default is equal to one that leaves it out.
    """
    if not reading.given.isdisjoint((*FOCAL_LENGTHS, *FIELDS_OF_VIEW, "pixel_size_um")):
        return
    across, down = DEFAULT_SENSOR_MM
    frames = [(width / (side or across), height / (other or down)) for
              width, height, side, other in reading.meeting("width_px", "height_px", *SENSOR_SIDES)]
    if frames and all(are_square(*focal_lengths) for focal_lengths in frames):
        for name, default in zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True):
            if name not in reading.given:
                reading.fixed[name] = default


FILE_VALUES = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")
"""The parameters whose values a camera file has."""


def file_and_camera(written: str, is_file: Callable[[str], bool]) -> tuple[str, str]:
    """Return the path, and the name of the camera in the file or "".

    >>> file_and_camera("chains/camchain.yaml#cam1", lambda path: "#" not in path)
    ('chains/camchain.yaml', 'cam1')
    """
    path, mark, camera = written.rpartition("#")
    return (path, camera) if mark and not is_file(written) else (written, "")


def read_camera_file(reading: Reading) -> None:
    """Give the camera's parameters the values of its file; note the file's digest, and faults.

    Keys that say something else than the file are at fault.
    """
    written = reading.fixed.get("camera_file")
    if written is None:
        return
    known = {**(reading.recorded.files or {}), **(reading.recorded.cameras or {})}
    if reading.given >= {*FILE_VALUES}:
        path, _ = file_and_camera(written, known.__contains__)
        if path in known:
            reading.files[path] = known[path]
            return
    folder = Path(reading.folder)
    path, camera = file_and_camera(written, lambda path: (folder / path).is_file())
    try:
        content = read_regular(folder / path, MAX_BYTES)
        calibration = calibration_of(read_tree(content), camera)
    except (OSError, ValueError) as error:
        reason = error.strerror or "unreadable" if isinstance(error, OSError) else error
        reading.refuse("camera_file", f"a camera file ({reason})")
        return
    reading.files[path] = hashlib.sha256(content).hexdigest()
    name = plain(Path(path).name)
    values = {key: getattr(calibration, key) for key in FILE_VALUES} | {
        key: numbers for key, numbers in zip(
            STATED, (calibration.sd, calibration.covariance), strict=True) if numbers}
    missing = [key for key in values if values[key] is None and key not in reading.given]
    if missing:
        reading.refuse("camera_file", f"{' and '.join(missing)} beside it: {name} does not say "
                       "which frame size it holds for")
    for key, value in values.items():
        if value is None:
            continue
        if key not in reading.given:
            try:
                reading.fixed[key] = PARAMETERS[key].check(value)
            except ValueError as error:
                reading.refuse(
                    "camera_file", f"a camera file ({key} = {shown(value)}: expected {error})")
                del reading.fixed[key]
            reading.written[key] = f"camera.{key}", value
            reading.stated[key] = value
        elif reading.fixed.get(key) != value:
            reading.refuse(key, f"{shown(value)}, which {name} has; delete it, or camera_file")


def beliefs_in_one_way(reading: Reading) -> None:
    """Demand the error of a calibration in one way, and one where a calibration is believed."""
    if not reading.fixed.keys() >= {*STATED}:
        return
    sd, covariance = STATED
    given = [name for name in STATED if reading.fixed[name]]
    if len(given) == 2:
        reading.refuse(sd, f"{sd} or {covariance}, not both; delete one of them")
    elif given:
        _errors_are_sound(reading, given[0])
    elif _is_calibrated(reading):
        where = "camera_file has none" if reading.fixed.get("camera_file") else "or a camera_file"
        reading.refuse("believed", "a calibration's standard deviations: give calibration_sd under "
                       f"[camera] ({where})")


def _errors_are_sound(reading: Reading, name: str) -> None:
    """Demand as many errors as the camera has numbers, and focal lengths that stay above 0."""
    try:
        errors = [
            CalibrationError.of(reading.fixed[STATED[0]], reading.fixed[STATED[1]], count)
            for count in {len(lens) for lens in reading.values_of("distortion")}
        ]
    except ValueError as error:
        reading.refuse(name, str(error))
        return
    cameras = [intrinsics(*values)[:2] for values in reading.meeting(*VIEW_PARAMETERS)]
    for focal, lengths in zip(FOCAL_LENGTHS, zip(*cameras, strict=True), strict=False):
        if errors and not min(lengths) > MAX_DEVIATIONS * errors[0].sd(focal):
            reading.refuse(name, f"focal lengths with standard deviations below 1/{MAX_DEVIATIONS} "
                           f"of them, here {min(lengths) / MAX_DEVIATIONS:.4g} px")
            return


# --------------------------------------------------------------------------------------------------
# Files that a pipeline names: background images, photographs. Their digests are noted.

def check_backgrounds(reading: Reading) -> None:
    """Demand background images that can be read and have the frame's size."""
    sizes = {}
    for value in reading.values_of("background"):
        if not isinstance(value, str) or reading.recorded.files is not None:
            continue
        path = os.path.join(reading.folder, value)  # noqa: PTH118  (it may be of any length)
        try:
            sizes[value] = decode_grey(path).shape[::-1]
            reading.files[value] = file_digest(Path(path)) or ""
        except ValueError as error:
            reading.refuse_value("background", value, f"a level or an image file ({error})")
    _have_the_frames_size(reading, "background", sizes)


def _have_the_frames_size(
    reading: Reading, name: str, sizes: Mapping[str, tuple[int, ...]]
) -> None:
    """Demand frames of the ``sizes``, width and height in pixels, of the files of a parameter."""
    for side, key in enumerate(("width_px", "height_px")):
        for file, length in reading.meeting(name, key):
            if file in sizes and sizes[file][side] != length:
                reading.refuse_value(
                    name, file, "images of exactly the frame's size: it is "
                    f"{' x '.join(map(str, sizes[file]))}, but {key} = {length}")


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 of an image file; None if it cannot be read."""
    try:
        return hashlib.sha256(read_image(str(path))).hexdigest()
    except ValueError:
        return None


def photographs_alone(reading: Reading) -> None:
    """Demand the photographs' own poses and images, their markers, and their files unchanged.

    Of images that are simulated at their poses, the poses and the markers alone.
    """
    if PHOTOGRAPHS not in reading.given:
        return
    simulated = any(reading.values_of(SIMULATED))
    own = "poses" if simulated else "poses and light"
    for name in reading.given - {PHOTOGRAPHS, SIMULATED}:
        if reading.parameters[name].section in ("pose", "pose" if simulated else "scene"):
            reading.refuse(
                name, f"nothing beside photographs, which have their own {own}; delete it")
    if reading.sampling != SAMPLINGS[0]:
        reading.fault("sampling", reading.sampling, f"{SAMPLINGS[0]}, for photographs")
    if SEARCH in reading.document:
        reading.fault(SEARCH, reading.document[SEARCH], "no such section: photographs are given")
    if reading.recorded.files is not None:
        return
    sizes = {}
    trials = len(reading.values_of(TRIAL) or (0,))
    for name in dict.fromkeys(reading.values_of(PHOTOGRAPHS)):
        path = Path(reading.folder) / name
        try:
            record, reading.files[name] = PHOTOGRAPH_RECORDS.read(path)
        except PluginError as error:
            reading.refuse_value(PHOTOGRAPHS, name, str(error))
            continue
        sizes[name] = record.width_px, record.height_px
        count, ids = len(record.paths), set(record.marker_id.tolist())
        if trials > count and not simulated:
            reading.refuse_value(PHOTOGRAPHS, name, f"trial = {count} at most: its photographs; "
                                 f"there are {trials} trials")
        for unknown in [each for each in reading.values_of("marker_id") if each not in ids][:1]:
            reading.refuse_value(PHOTOGRAPHS, name, f"markers that it has: {shown(sorted(ids))}; "
                                 f"marker_id = {unknown} is none of them")
        for relative, known in zip(record.paths, record.digests, strict=True):
            found = known if simulated else file_digest(path.parent / relative)
            if found != known:
                reading.note(plain(relative), "the photograph cannot be read" if found is None else
                             "the photograph is not the one that was recorded: its SHA-256 differs")
            reading.files[relative] = known
    _have_the_frames_size(reading, PHOTOGRAPHS, sizes)


# --------------------------------------------------------------------------------------------------
# Targets: boards, what is beside them, what can search and solve them.

MAX_BOARDS = 10_000
"""The most boards of a grid: all are checked before anything is computed."""

MAX_BOARD_FAULTS = 10
"""Faults of boards after which no other board is checked."""


def boards_can_be_printed(reading: Reading) -> None:
    """Demand what each kind of board needs, and boards whose parts do not overlap."""
    kinds = dict.fromkeys(reading.values_of("kind"))
    needed = {name: kind for kind in kinds for name in NEEDED[kind] if name not in reading.given}
    for name, kind in needed.items():
        meaning = reading.parameters[name].meaning
        reading.note(f"board.{name}", f"missing; kind = {shown(kind)} needs it: {meaning}")
    used = {"kind", *(name for kind in kinds for name in used_by(kind))}
    for name in reading.given - used if kinds else ():
        if reading.parameters[name].section == "board":
            users = " or ".join(kind for kind in NEEDED if name in used_by(kind))
            reading.refuse(name, f"kind = {users}, which uses it; kind = {' or '.join(kinds)} does "
                           "not: delete it")
    if not reading.shows_boards or needed or not all(map(reading.values_of, ARRANGING)):
        return
    count = math.prod(
        len(axis) for axis in reading.axes if not axis.columns.keys().isdisjoint(ARRANGING))
    if count > MAX_BOARDS:
        reading.note("axes", f"{count:,} different boards: expected at most {MAX_BOARDS:,}")
        return
    faults = len(reading.faults)
    for values in reading.arrangements():
        for name, value, expected in arrangement_faults(values):
            section = reading.parameters[name.partition("[")[0]].section
            reading.fault(f"{section}.{name}", value, expected)
        if len(reading.faults) > faults + MAX_BOARD_FAULTS:
            return
    if len(reading.faults) > faults or "warp" not in reading.values_of("renderer"):
        return
    for values in reading.arrangements():
        height, width = bitmap_shape(arranged_board(*values))
        if max(height, width) > MAX_BITMAP_SIDE or height * width > MAX_BITMAP_PX:
            reading.refuse_value(
                "renderer", "warp",
                f"another renderer: warp draws bitmaps of at most {MAX_BITMAP_PX:,} pixels, and a "
                f"side of {MAX_BITMAP_SIDE:,}; this board and what is beside it would take "
                f"{width:,} x {height:,}",
            )
            return


BOARD_SOLVERS = ", ".join(name for name, each in SOLVERS.items() if each.of_boards)


def targets_are_solved(reading: Reading) -> None:
    """Demand solvers that can do boards, or single markers."""
    plugged = [each.name for each in reading.plugins if each.of_boards]
    if not reading.shows_boards:
        Rule(("solver",), lambda solver: solver in plugged,
             "a solver of single markers, or a board: give kind under [board]").check(reading)
        return
    if "chessboard" in reading.values_of("points") and not {"charuco", "diamond"} & {
            *reading.values_of("kind")}:
        reading.refuse_value(
            "points", "chessboard", "kind = charuco or diamond, which have a chessboard")
    if "solver" not in reading.given:
        reading.note("estimator.solver", f"missing; a board needs one of {BOARD_SOLVERS}")
        return

    def is_of_boards(solver: str, points: str) -> bool:
        known = SOLVERS.get(solver)
        return solver in plugged if known is None else (
            known.of_boards or (points == "largest_marker" and known.corners_alone))

    Rule(("solver", "points"), lambda *chosen: not is_of_boards(*chosen),
         f"one of {BOARD_SOLVERS} for boards; others with points = largest_marker if they take "
         "corners alone; plug-ins with of_boards=True").check(reading)
    for name, whole in (("points", "markers"), ("refine", "none")):
        Rule((name, "solver"), lambda chosen, solver, whole=whole: (
                 chosen != whole and solver in ("photometric", *plugged)),
             lambda _, solver, whole=whole: (
                 f"{whole} beside solver = {solver}, which chooses by itself")).check(reading)


# --------------------------------------------------------------------------------------------------
# All other rules: ways to give a quantity, partners, packages, random draws, names, sizes.

def each_in_one_way(reading: Reading) -> None:
    """Demand a distance, and each quantity of pose, camera and beliefs in one way."""
    has_poses = PHOTOGRAPHS in reading.given
    given = reading.given - reading.stated.keys() - (set(IN_CAMERA) if has_poses else set())
    for choice in (*CHOICES, () if has_poses else (IN_CAMERA, WORLD)):
        ways = [names for way in choice if (names := [name for name in way if name in given])]
        for other in ways[1:]:
            reading.refuse(other[0], f"{', '.join(ways[0])} or {', '.join(other)}, not both; "
                           "delete one of them")
    if not has_poses and given.isdisjoint(("distance_m", "side_px", *WORLD)):
        reading.note("pose", "expected distance_m or side_px, fixed or under [axes]")


def what_is_installed(reading: Reading) -> None:
    """Demand detector fields, and dictionaries that are installed and that each detector has.

    A store's pipeline can be read without the packages of dictionaries.
    """
    for name in reading.given & DetectorSetting.missing_fields():
        reading.refuse(name, "a field that the installed OpenCV has")
    for dictionary in reading.values_of("dictionary") if reading.recorded.files is None else ():
        if (missing := missing_package(dictionary)) is not None:
            reading.refuse_value("dictionary", dictionary, missing)
    known: dict[str, tuple[str, ...]] = {
        OPENCV: opencv_dictionary_names(),
        **{plugin.name: plugin.dictionaries for plugin in reading.plugins
           if plugin.kind == "detector" and plugin.dictionaries},
    }
    Rule(
        ("dictionary", "detector"),
        lambda dictionary, detector: dictionary not in known.get(detector, (dictionary,)),
        lambda _, detector: "one of OpenCV's for its detector; give another detector"
        if detector == OPENCV
        else f"one that the detector {detector} has: {', '.join(known[detector])}",
    ).check(reading)


def something_random_to_repeat(reading: Reading) -> None:
    """Demand a random quantity if there are trials; of Sobol' points one that they draw.

    Their trials are whole replicates.
    """
    trials = len(reading.values_of(TRIAL)) or 1
    drawn = (
        bool(reading.distributions) or reading.is_active("jitter_px") or _is_calibrated(reading))
    noisy = map(reading.is_active, (*RANDOM, *(
        plugin.settings[0].name for plugin in reading.plugins
        if plugin.kind == "effect" and plugin.random)))
    if trials > 1 and not drawn and not any(noisy) and PHOTOGRAPHS not in reading.given:
        reading.fault("axes.trial", trials, "something random to repeat: jitter_px above 0, noise, "
                      "or a distribution")
    if reading.sampling != "sobol" or reading.axis(TRIAL) is None or SEARCH in reading.document:
        return
    if trials % REPLICATES or trials < 2 * REPLICATES:
        reading.fault("axes.trial", trials, f"a multiple of {REPLICATES}, at least "
                      f"{2 * REPLICATES}, for sampling = sobol: {REPLICATES} replicates of as many "
                      "points each, best a power of two")
    if not drawn:
        reading.fault("sampling", reading.sampling, "a distribution or jitter_px above 0 (the "
                      "noise of pixels is independent in any case)")


RESERVED = {
    *VARIABLES, *LABELS, *HEADER, *SECTIONS, "axes", TRIAL,
    *(flag.name for flags in (BoundStatus, DetectionStatus, EstimateStatus, Flipped)
      for flag in flags),
    "block", "commits", "compared", "cost", "count", "draws", "failure", "failures", "image_x_px",
    "image_y_px",
    "jitter_u_px", "jitter_v_px", "level", "looked_for", "outcome", "share", "treatment",
}
"""Names in datasets and tables that no axis may take."""


def names_are_free(reading: Reading) -> None:
    """Demand names that nothing else of the dataset has for plug-ins' settings and joint axes."""
    names = [(plugin.name, f"name for its setting {setting.name}", setting.name)
             for plugin in reading.plugins for setting in plugin.settings]
    names += [(f"axes.{axis.name}", "name", axis.name) for axis in reading.axes if axis.zipped]
    for start, what, name in names:
        if name in RESERVED or name.startswith("_"):
            reading.note(start, f"expected another {what}: the dataset or its analyses have this "
                         "one")


MAX_POSES = 10**12
"""The largest grid."""

MAX_CONFIGURATIONS = 10_000
"""The most configurations: they are listed, and each has its share of every block."""


def size_of_the_grid(reading: Reading) -> None:
    """Limit the number of poses and of configurations."""
    poses, settings = reading.size(*Stage), reading.size(Stage.detection, Stage.estimation)
    if poses > MAX_POSES:
        reading.note(
            "axes", f"{min(poses, 10**300):.3g} poses: expected at most {MAX_POSES:.0e}")
    if settings > MAX_CONFIGURATIONS:
        reading.note("axes", f"{min(settings, 10**300):.3g} detector settings times estimators: "
                     f"expected at most {MAX_CONFIGURATIONS:,}")


RULES: tuple[Callable[[Reading], None], ...] = (
    one_value,
    photographs_alone,
    each_in_one_way,
    beliefs_in_one_way,
    what_is_installed,
    boards_can_be_printed,
    targets_are_solved,
    check_backgrounds,
    something_random_to_repeat,
    names_are_free,
    size_of_the_grid,
    *(record.check for record in RECORDS),
)
