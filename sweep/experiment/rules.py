"""Rules across the keys of a pipeline: records of values that cannot be, and functions."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sweep.errors import PluginError
from sweep.experiment.axes import MAX_DEVIATIONS, TRIAL
from sweep.experiment.document import HEADER, SEARCH, Reading
from sweep.experiment.draws import REPLICATES, SAMPLINGS
from sweep.experiment.parameters import (
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
    contradictions,
)
from sweep.experiment.photographs import PhotographRecord, read_record
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.measure.detectors import OPENCV, DetectorSetting
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.messages import label, plain, shown
from sweep.model.board_kinds import (
    ARRANGING,
    NEEDED,
    arranged_board,
    arrangement_faults,
    is_solid,
    used_by,
)
from sweep.model.calibration import (
    MAX_BYTES,
    Calibration,
    CalibrationError,
    calibration_of,
    read_tree,
)
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
# Values that cannot be, or cannot meet on a grid.

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
        What is expected in place of the first, given a value of each.
    each
        Whether every wrong value is named; else the parameter as the document has it.
    """

    names: tuple[str, ...]
    wrong: Callable[..., bool]
    expected: Callable[..., str]
    each: bool = False

    def check(self, reading: Reading) -> None:
        """Note each expectation that is missed, once."""
        told = set()
        for group in reading.together(*self.names):
            for values in itertools.product(*map(_ends, group)):
                if self.wrong(*values):
                    expected = self.expected(*values)
                    fault = (values[0] if self.each else None, expected)
                    if fault not in told:
                        told.add(fault)
                        if self.each:
                            reading.refuse_value(self.names[0], values[0], expected)
                        else:
                            reading.refuse(self.names[0], expected)


def _ends(values: Sequence[Any]) -> Sequence[Any]:
    """Return the least and the largest of numbers; other values, each once."""
    if isinstance(values, range):
        return sorted({values[0], values[-1]})
    if values and all(type(value) in (int, float) for value in values):
        return sorted({min(values), max(values)})
    return list(dict.fromkeys(values))


def _is_no_noise_table(table: Sequence[float]) -> bool:
    levels, deviations = table[::2], table[1::2]
    return (
        any(a >= b for a, b in itertools.pairwise(levels))
        or not all(0 <= level <= MAX_LEVEL for level in levels)
        or not all(0 <= deviation <= 1e6 for deviation in deviations)
    )


def _whole_frame(name: str, is_whole: Callable[[Any], bool]) -> Rule:
    """Return the rule that a setting does not search the whole frame if that is too large."""
    return Rule(
        (name, "width_px", "height_px"),
        lambda value, width, height: width * height > MAX_PIXELS and is_whole(value),
        lambda *_: f"what needs no whole frame, for one of more than {MAX_PIXELS:,} pixels")


OF_VALUES = (
    Rule(("marker_id", "dictionary"),
         lambda marker_id, dictionary: marker_id >= marker_count(dictionary),
         lambda _, dictionary: f"IDs from 0 to {marker_count(dictionary) - 1}, which is what "
         f"{dictionary} has"),
    Rule(("renderer", "dictionary"),
         lambda renderer, dictionary: renderer != "exact" and has_circles(dictionary),
         lambda *_: "exact for STag's markers, which have circles"),
    Rule(("noise_table",), _is_no_noise_table,
         lambda _: "level, standard deviation, level, standard deviation, ...: levels that ascend "
         f"from 0 to {MAX_LEVEL:g}, deviations of at least 0", each=True),
    *(Rule((name, "bayer"),
           lambda length, bayer: length < MIN_FRAME_PX and bayer != "none",
           lambda *_: f"at least {MIN_FRAME_PX}, for bayer to be demosaiced")
      for name in ("width_px", "height_px")),
    Rule(("adaptiveThreshWinSizeMax", "adaptiveThreshWinSizeMin"),
         lambda largest, smallest: largest < smallest,
         lambda *_: "at least adaptiveThreshWinSizeMin"),
    _whole_frame("window", lambda value: value == "full"),
    _whole_frame("useAruco3Detection", bool),
    _whole_frame("adaptiveThreshConstant", lambda value: value < 1),
    _whole_frame("aprilTagQuadDecimate", lambda value: value > 1),
)

BOARD_SOLVERS = tuple(name for name, each in SOLVERS.items() if each.of_boards)

OF_BOARDS = (
    Rule(("renderer",), lambda renderer: not is_renderer(renderer),
         lambda _: f"{RENDERERS}, for boards", each=True),
    Rule(("points", "detector"),
         lambda points, detector: points == "chessboard" and is_recording(detector),
         lambda *_: "markers beside recorded detections, which have no corners of chessboards",
         each=True),
    Rule(("refineDetectedMarkers", "detector"),
         lambda refine, detector: refine and is_recording(detector),
         lambda *_: "false beside recorded detections: no image is searched", each=True),
)


def of_sheets(why: str) -> tuple[Rule, ...]:
    """Return the rules of targets in several planes."""
    return (
        Rule(("solver", "points"),
             lambda solver, points: solver in SOLVERS and SOLVERS[solver].planar_only
             and points in ("markers", "chessboard"),
             lambda *_: f"one of iterative, sqpnp, epnp, photometric, {why}", each=True),
        Rule(("refineDetectedMarkers",), bool, lambda _: f"false, {why}", each=True),
    )


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
    if reading.given & {*FOCAL_LENGTHS, *FIELDS_OF_VIEW, "pixel_size_um"}:
        return
    ends = [_ends(reading.values_of(name)) for name in ("width_px", "height_px", *SENSOR_SIDES)]
    if all(map(len, ends)) and all(map(_default_is_square, itertools.product(*ends))):
        for name, default in zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True):
            if name not in reading.given:
                reading.fixed[name] = default


def _default_is_square(values: tuple[Any, ...]) -> bool:
    """Return whether a frame's sides, and those of its sensor or the default, make it square."""
    width, height, *given = values
    sides = [side or default for side, default in zip(given, DEFAULT_SENSOR_MM, strict=True)]
    fx, fy, _, _ = intrinsics(width, height, sides[0], sides[1], 1.0, None, None, None, None)
    return bool(are_square(fx, fy))


FILE_VALUES = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")
"""The parameters whose values a camera file has."""

OTHER_WAYS = (*IN_MM, *FIELDS_OF_VIEW)


def file_and_camera(written: str, is_file: Callable[[str], bool]) -> tuple[str, str]:
    """Return the path, and the name of the camera in the file or "".

    >>> file_and_camera("chains/camchain.yaml#cam1", lambda path: "#" not in path)
    ('chains/camchain.yaml', 'cam1')
    """
    path, mark, camera = written.rpartition("#")
    return (path, camera) if mark and not is_file(written) else (written, "")


def read_camera_file(reading: Reading) -> None:
    """Give the camera's parameters the values of its file; note the file's digest, and faults."""
    if reading.axis_of("camera_file") is not None:
        reading.refuse(
            "camera_file", "one file; cameras to compare are axes of fx_px, distortion and so on")
        return
    written = reading.fixed.get("camera_file")
    if written is None:
        return
    if not written.isprintable():
        reading.refuse("camera_file", "a path without control characters")
        return
    known = reading.recorded.cameras
    if known is None:
        known = reading.recorded.files
    if known is not None and reading.given.issuperset(FILE_VALUES):
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
    _take(reading, plain(Path(path).name), calibration)


def _take(reading: Reading, name: str, calibration: Calibration) -> None:
    """Take the values of a file of this name; keys that say something else are at fault."""
    for other in reading.given.intersection(OTHER_WAYS):
        reading.refuse(
            other, f"no other camera beside camera_file; delete it, or camera_file ({name})")
    if calibration.width_px is None or calibration.height_px is None:
        missing = [key for key in ("width_px", "height_px") if key not in reading.given]
        if missing:
            reading.refuse(
                "camera_file", f"{' and '.join(missing)} beside it: {name} does not say which "
                "frame size it holds for")
    values: dict[str, Any] = {
        **{key: getattr(calibration, key) for key in FILE_VALUES},
        **{key: number for key, number in zip(
            STATED, (calibration.sd, calibration.covariance), strict=True) if number},
    }
    for key, value in values.items():
        brief = plain(shown(list(value)) if isinstance(value, tuple) else label(value))
        if key in reading.given and value is not None and reading.fixed.get(key) != value:
            hint = "; a calibration holds for its own frame size" if key in (
                "width_px", "height_px") else ""
            reading.refuse(key, f"{brief}, which {name} has; delete it, or camera_file{hint}")
        elif key not in reading.given and value is not None:
            reading.given.add(key)
            try:
                reading.fixed[key] = PARAMETERS[key].check(value)
                reading.stated[key] = value
            except ValueError as error:
                del reading.fixed[key]
                reading.refuse(
                    "camera_file", f"a camera file ({key} = {brief}: expected {error})")


# --------------------------------------------------------------------------------------------------
# What estimators believe of the camera.

OWN_BELIEFS = (
    "believed_fx_px", "believed_fy_px", "believed_cx_px", "believed_cy_px",
    "believed_focal_scale", "believed_distortion",
)
"""Beliefs about what a calibration determines."""


def beliefs_in_one_way(reading: Reading) -> None:
    """Demand beliefs that do not contradict each other, and a calibration where one is believed."""
    known = _calibration_is_sound(reading)
    if "calibration" not in reading.values_of("believed"):
        return
    if known and not any(reading.fixed[name] for name in STATED):
        where = "camera_file has none" if reading.fixed.get("camera_file") else "or a camera_file"
        reading.refuse(
            "believed", f"a calibration's standard deviations: give calibration_sd under [camera] "
            f"({where})")
    for name in reading.given.intersection(OWN_BELIEFS):
        reading.refuse(name, "no other belief about the camera beside believed = calibration; "
                       "delete one of them")


def _calibration_is_sound(reading: Reading) -> bool:
    """Note what is wrong with standard deviations or covariance; return whether nothing is."""
    sd, covariance = STATED
    given = [name for name in STATED if reading.fixed.get(name, True)]
    if not reading.fixed.keys() >= {*STATED}:
        for name in STATED:
            if reading.axis_of(name) is not None:
                reading.refuse(name, "one list of numbers, not an axis")
        return False
    if len(given) == 2:
        reading.refuse(sd, f"{sd} or {covariance}, not both; delete one of them")
    if len(given) != 1:
        return not given
    try:
        errors = [
            CalibrationError.of(reading.fixed[sd], reading.fixed[covariance], count)
            for count in {len(lens) for lens in reading.values_of("distortion")}
        ]
    except ValueError as error:
        reading.refuse(given[0], str(error))
        return False
    values = [reading.values_of(parameter) for parameter in VIEW_PARAMETERS]
    if not errors or not all(map(len, values)):
        return False
    least = intrinsics(*map(_with_least_focal_length, VIEW_PARAMETERS, values))
    for focal, length in zip(FOCAL_LENGTHS, least, strict=False):
        if not float(length) > MAX_DEVIATIONS * errors[0].sd(focal):
            reading.refuse(
                given[0], f"focal lengths with standard deviations below 1/{MAX_DEVIATIONS} of "
                f"them, here {float(length) / MAX_DEVIATIONS:.4g} px")
            return False
    return True


def _with_least_focal_length(parameter: str, values: Sequence[Any]) -> Any:
    """Return the value of a camera's parameter on the grid at which focal lengths are least."""
    if values[0] is None:
        return None
    grows = parameter in ("width_px", "height_px", "focal_length_mm", "fx_px", "fy_px")
    return min(values) if grows else max(values)


# --------------------------------------------------------------------------------------------------
# Files that a pipeline names: background images, photographs. Their digests are noted.

def check_backgrounds(reading: Reading) -> None:
    """Demand background images that can be read and have the frame's size."""
    for value in reading.values_of("background"):
        if not isinstance(value, str):
            continue
        if not value.isprintable():
            reading.refuse_value("background", value, "a path without control characters")
            continue
        if reading.recorded.files is not None:
            reading.files[value] = reading.recorded.files.get(value, "")
            continue
        path = os.path.join(reading.folder, value)  # noqa: PTH118  (it may be of any length)
        try:
            height, width = decode_grey(path).shape
            problem = _wrong_size(reading, value, width, height)
            reading.files[value] = file_digest(Path(path)) or ""
        except ValueError as error:
            problem = f"a level or an image file ({error})"
        if problem is not None:
            reading.refuse_value("background", value, problem)


def _wrong_size(reading: Reading, background: str, width: int, height: int) -> str | None:
    """Return the expectation that a background of a size in pixels misses; None if it fits."""
    for name, length in (("width_px", width), ("height_px", height)):
        if any(background in backgrounds and {*frames} - {length}
               for backgrounds, frames in reading.together("background", name)):
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
    if reading.recorded.files is not None:
        reading.files.update(reading.recorded.files)
        return
    for name in dict.fromkeys(reading.values_of(PHOTOGRAPHS)):
        path = Path(reading.folder) / name
        try:
            record, reading.files[name] = read_record(path)
        except PluginError as error:
            reading.refuse_value(PHOTOGRAPHS, name, str(error))
            continue
        for expected in _mismatches(reading, name, record, simulated):
            reading.refuse_value(PHOTOGRAPHS, name, expected)
        for relative, known in zip(record.paths, record.digests, strict=True):
            found = known if simulated else file_digest(path.parent / relative)
            if found != known:
                reading.note(plain(relative), "the photograph cannot be read" if found is None else
                             "the photograph is not the one that was recorded: its SHA-256 differs")
            reading.files[relative] = known


def _mismatches(
    reading: Reading, name: str, record: PhotographRecord, simulated: bool
) -> Iterator[str]:
    """Yield what the pipeline asks of a record that it does not have."""
    trials = reading.values_of(TRIAL) or (0,)
    if trials[-1] >= len(record.paths) and not simulated:
        yield (f"trial = {len(record.paths)} at most: its photographs; there are "
               f"{len(trials)} trials")
    ids = set(record.marker_id.tolist())
    unknown = [each for each in reading.values_of("marker_id") if each not in ids]
    if unknown:
        yield f"markers that it has: {shown(sorted(ids))}; marker_id = {unknown[0]} is none of them"
    for key, length in (("width_px", record.width_px), ("height_px", record.height_px)):
        for names, lengths in reading.together(PHOTOGRAPHS, key):
            if name in names and any(each != length for each in lengths):
                yield f"{key} = {length}, that of its photographs"


# --------------------------------------------------------------------------------------------------
# Targets: boards, what is beside them, what can search and solve them.

MAX_BOARDS = 10_000
"""The most boards of a grid: all are checked before anything is computed."""

MAX_BOARD_FAULTS = 10
"""Faults of boards after which no other board is checked."""

IN_ONE_PLANE = {
    "curvature_per_m": "a bend is that of one sheet",
    "occlusion": "the sheet that hides lies in the target's plane",
}
"""Switches of effects that targets in several planes cannot have, and why."""


def boards_can_be_printed(reading: Reading) -> None:
    """Demand what each kind of board needs, and boards whose parts do not overlap."""
    kinds = reading.values_of("kind")
    needed = {name: kind for kind in kinds for name in NEEDED[kind] if name not in reading.given}
    for name, kind in needed.items():
        meaning = reading.parameters[name].declaration.meaning
        reading.note(f"board.{name}", f"missing; kind = {shown(kind)} needs it: {meaning}")
    used = {"kind", *(name for kind in kinds for name in used_by(kind))}
    for name, parameter in reading.parameters.items() if kinds else ():
        if parameter.section == "board" and name in reading.given - used:
            users = " or ".join(kind for kind in NEEDED if name in used_by(kind))
            reading.refuse(name, f"kind = {users}, which uses it; kind = "
                           f"{' or '.join(dict.fromkeys(kinds))} does not: delete it")
    if not reading.shows_boards or needed or not all(map(reading.values_of, ARRANGING)):
        return
    if "marker_id" in reading.given and any(reading.values_of("ids")):
        reading.refuse("ids", "ids, or marker_id of the first; not both")
        return
    for name in ("ids", "markers", "distractors"):
        if reading.axis_of(name) is not None:
            reading.fault(f"axes.{name}", "...", f"{name} under [board]: they cannot be an axis")
            return
    count = math.prod(
        len(axis) for axis in reading.axes if not axis.columns.keys().isdisjoint(ARRANGING))
    if count > MAX_BOARDS:
        reading.note("axes", f"{count:,} different boards: expected at most {MAX_BOARDS:,}")
        return
    seen = set()
    for values in reading.arrangements():
        for name, value, expected in arrangement_faults(values):
            if (name, expected) not in seen:
                seen.add((name, expected))
                section = reading.parameters[name.partition("[")[0]].section
                reading.fault(f"{section}.{name}", value, expected)
        if len(seen) > MAX_BOARD_FAULTS:
            return
    if not seen and "warp" in reading.values_of("renderer"):
        _bitmaps_fit(reading)


def _bitmaps_fit(reading: Reading) -> None:
    """Demand boards of which ``warp`` can draw bitmaps."""
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


def boards_are_searched_and_solved(reading: Reading) -> None:
    """Demand detectors, solvers and renderers that can do boards."""
    plugged = [each.name for each in reading.plugins if each.of_boards]
    if not reading.shows_boards:
        reading.refuse_values("solver", "a solver of single markers, or a board: give kind under "
                              "[board]", lambda name: name in plugged)
        for name in reading.given & {"points", "refine", "refineDetectedMarkers", "minMarkers"}:
            reading.refuse(name, "a board: give kind under [board]")
        return
    if PHOTOGRAPHS in reading.given:
        reading.refuse("kind", "no board beside photographs, whose board `sweep photos` knows; "
                       "delete it")
    for rule in OF_BOARDS:
        rule.check(reading)
    if "solver" not in reading.given:
        reading.note(
            "estimator.solver", f"missing; a board needs one of {', '.join(BOARD_SOLVERS)}")
        return
    for rule in _of_board_solvers(plugged):
        rule.check(reading)
    solids = [name for name in ("markers", "distractors")
              if any(map(is_solid, reading.values_of(name)))]
    if solids:
        why = f"for {solids[0]} with z_m or tilt_deg"
        for rule in of_sheets(why) if "markers" in solids else ():
            rule.check(reading)
        for name, reason in IN_ONE_PLANE.items():
            if reading.is_active(name):
                reading.refuse(name, f"it absent, {why}: {reason}")
        reading.refuse_values("renderer", f"exact, {why}", lambda name: name != "exact")
    if "chessboard" in reading.values_of("points") and not {"charuco", "diamond"} & {
            *reading.values_of("kind")}:
        reading.refuse_value(
            "points", "chessboard", "kind = charuco or diamond, which have a chessboard")


def _of_board_solvers(plugged: Sequence[str]) -> Iterator[Rule]:
    """Yield the rules of solvers of boards; those of plug-ins have these names."""
    for name, all_pixels in (("points", "markers"), ("refine", "none")):
        yield Rule(
            (name, "solver"),
            lambda chosen, solver, all_pixels=all_pixels: (
                chosen != all_pixels and solver in ("photometric", *plugged)),
            lambda _, solver, all_pixels=all_pixels: (
                f"{all_pixels} beside solver = {solver}, which "
                f"{'chooses by itself' if solver in plugged else 'takes all pixels'}"), each=True)

    def cannot(solver: str, points: str) -> bool:
        known = SOLVERS.get(solver)
        return solver not in plugged and (known is None or not (
            known.of_boards or (points == "largest_marker" and known.corners_alone)))

    yield Rule(
        ("solver", "points"), cannot,
        lambda solver, _: f"one of {', '.join(BOARD_SOLVERS)} for boards" + (
            ", or a plug-in with of_boards=True" if solver not in SOLVERS
            else "; others with points = largest_marker" if SOLVERS[solver].corners_alone
            else ""), each=True)


# --------------------------------------------------------------------------------------------------
# All other rules: ways to give a quantity, partners, packages, random draws, names, sizes.
#
# A parameter whose own value is at fault is passed over: its fault is known already.

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
        reading.note("pose", "expected distance_m or side_px, fixed or under [axes]")


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
    for name in GEOMETRIC if others else ():
        if reading.is_active(name):
            reading.refuse(name, f"renderer = exact; {others[0]} does not have it")


def what_is_installed(reading: Reading) -> None:
    """Demand detector fields, and packages with the codes of dictionaries, that are installed.

    A store's pipeline can be read without the packages.
    """
    for name in reading.given & DetectorSetting.missing_fields():
        reading.refuse(name, "a field that the installed OpenCV has")
    for dictionary in reading.values_of("dictionary") if reading.recorded.files is None else ():
        if (missing := missing_package(dictionary)) is not None:
            reading.refuse_value("dictionary", dictionary, missing)


def dictionaries_of_detectors(reading: Reading) -> None:
    """Demand dictionaries that each detector has."""
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
        else f"one that the detector {detector} has: {', '.join(known[detector])}", each=True,
    ).check(reading)


def something_random_to_repeat(reading: Reading) -> None:
    """Demand a random quantity if there are trials; of Sobol' points one that they draw.

    Their trials are whole replicates.
    """
    trials = len(reading.values_of(TRIAL)) or 1
    jitter = reading.values_of("jitter_px")
    drawn = (
        bool(reading.distributions) or not jitter or max(jitter) > 0
        or "calibration" in reading.values_of("believed")
    )
    noisy = any(reading.is_active(name) for name in (
        *RANDOM, *(plugin.settings[0].name for plugin in reading.plugins
                   if plugin.kind == "effect" and plugin.random)))
    if trials > 1 and not drawn and not noisy and PHOTOGRAPHS not in reading.given:
        reading.fault(
            "axes.trial", trials,
            "something random to repeat: jitter_px above 0, noise, or a distribution",
        )
    if reading.sampling != "sobol" or reading.axis(TRIAL) is None or SEARCH in reading.document:
        return
    if trials % REPLICATES or trials < 2 * REPLICATES:
        reading.fault(
            "axes.trial", trials,
            f"a multiple of {REPLICATES}, at least {2 * REPLICATES}, for sampling = sobol: "
            f"{REPLICATES} replicates of as many points each, best a power of two",
        )
    if not drawn:
        reading.fault(
            "sampling", reading.sampling,
            "a distribution or jitter_px above 0 (the noise of pixels is independent in any case)",
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
    for count, most, what in (
        (reading.size(*Stage), MAX_POSES, f"poses: expected at most {MAX_POSES:.0e}"),
        (reading.size(Stage.detection, Stage.estimation), MAX_CONFIGURATIONS,
         f"detector settings times estimators: expected at most {MAX_CONFIGURATIONS:,}"),
    ):
        if count > most:
            reading.note("axes", f"{min(count, 10**300):.3g} {what}")


RULES: tuple[Callable[[Reading], None], ...] = (
    photographs_alone,
    each_in_one_way,
    beliefs_in_one_way,
    what_is_installed,
    boards_can_be_printed,
    boards_are_searched_and_solved,
    partners_are_given,
    effects_need_the_exact_renderer,
    check_backgrounds,
    dictionaries_of_detectors,
    something_random_to_repeat,
    names_are_free,
    size_of_the_grid,
    *(rule.check for rule in OF_VALUES),
)
"""Every rule, in the order of their messages."""


def check_rules(reading: Reading) -> None:
    """Add the faults of all rules to a reading."""
    for rule in RULES:
        rule(reading)
