"""The pipeline: rules across the keys of a document; its values changed by --set and --at."""

from __future__ import annotations

import copy
import hashlib
import math
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit

from sweep.declaration import Declared
from sweep.errors import MAX_FAULTS, PipelineError, PluginError, path_of, texts_of
from sweep.experiment import document as documents
from sweep.experiment import parameters
from sweep.experiment.document import HEADER, REQUIRE, SEARCH, Reading
from sweep.experiment.draws import REPLICATES
from sweep.experiment.experiment import Experiment, Facts
from sweep.experiment.grid import DISTRIBUTION_FORMS, TRIAL, Axis, Grid
from sweep.experiment.parameters import PARAMETERS, STATED, WORLD, Parameter, Stage
from sweep.experiment.photographs import PhotographRecord
from sweep.experiment.sampling import MAX_TRIALS, StoppingRule, read_required, read_search
from sweep.experiment.schema import LABELS, VARIABLES
from sweep.measure.detectors import OPENCV
from sweep.measure.estimators import SOLVERS
from sweep.measure.flags import Ambiguous, BoundStatus, DetectionStatus, EstimateStatus, Flipped
from sweep.messages import label, nearest, plain, shown
from sweep.model import marker
from sweep.model.board_kinds import ARRANGING, NEEDED, SINGLE, arrangement_faults, is_solid, used_by
from sweep.model.calibration import MAX_BYTES, CalibrationError, calibration_of, read_tree
from sweep.model.effects import GEOMETRIC, NEEDS, RANDOM
from sweep.model.image_file import MAX_PIXELS, decode_grey, read_image, read_regular
from sweep.model.scene import RENDERERS, is_renderer
from sweep.model.sensor import MAX_LEVEL
from sweep.plugins.loading import DeclaredPlugin, is_recording

# --------------------------------------------------------------------------------------------------
# Two kinds of rules: of values that cannot meet on the grid, and of parameters that have no place
# somewhere. A parameter whose own value is at fault is passed over: its fault is known already.

#: Notes the faults of a document that break a rule.
Check = Callable[[Reading], None]


def apart(
    names: tuple[str, ...], wrong: Callable[..., bool], expected: str | Callable[..., str]
) -> Check:
    """Return the rule that values of parameters cannot meet; the first is at fault.

    Parameters
    ----------
    names
        The parameters.
    wrong
        Whether a value of each cannot meet. Of numbers it gets the least and the largest, and of
        IDs the largest alone: in each number it changes once.
    expected
        Expectation in place of the first: text, or a function of a value of each.
    """
    def check(reading: Reading) -> None:
        for values in reading.meeting(*names):
            if wrong(*values):
                text = expected if isinstance(expected, str) else expected(*values)
                reading.refuse(names[0], text, values[0])

    return check


def absent(
    names: Iterable[str], where: Callable[[Reading], Any], expected: str, *, active: bool = False
) -> Check:
    """Return the rule that parameters have no place where something holds.

    ``expected`` is expected in place of one that is given; with ``active`` a neutral value is none
    that counts.
    """
    def check(reading: Reading) -> None:
        for name in names:
            counts = name in reading.given and (reading.is_active(name) or not active)
            if counts and where(reading):
                reading.refuse(name, expected)

    return check


def _is_no_noise_table(table: Sequence[float]) -> bool:
    levels, deviations = table[::2], table[1::2]
    within = all(0 <= level <= MAX_LEVEL for level in levels) and all(
        0 <= deviation <= 1e6 for deviation in deviations)
    return not within or list(levels) != sorted(set(levels))


def _without(*names: str) -> Callable[[Reading], bool]:
    """Return a function that says whether none of some parameters is given."""
    return lambda reading: reading.given.isdisjoint(names)


def _is_calibrated(reading: Reading) -> bool:
    """Return whether an estimator believes a calibration."""
    return "calibration" in reading.values_of("believed")


SEVERAL_PLANES = "for prints with z_m or tilt_deg"

#: The ways to give a camera beside focal lengths in pixels, and beside a file.
OTHER_WAYS = (*parameters.IN_MM, *parameters.FIELDS_OF_VIEW)

#: Parameter -> the parameters of which one must be given beside it, or one of a rival way.
PARTNERS = {"fy_px": ("fx_px",), "pixel_size_um": ("focal_length_mm",), **NEEDS}

RECORDS: tuple[Check, ...] = (
    *(absent((name,), _without(*others, *parameters.RIVALS.get(name, ())),
             f"{' or '.join(others)} beside it", active=True)
      for name, others in PARTNERS.items()),
    apart(("marker_id", "dictionary"),
          lambda marker_id, dictionary: marker_id >= marker.marker_count(dictionary),
          lambda _, dictionary: f"IDs from 0 to {marker.marker_count(dictionary) - 1}, which is "
          f"what {dictionary} has"),
    apart(("noise_table",), _is_no_noise_table,
          "level, standard deviation, level, standard deviation, ...: levels that ascend from 0 "
          f"to {MAX_LEVEL:g}, deviations of at least 0"),
    apart(("adaptiveThreshWinSizeMax", "adaptiveThreshWinSizeMin"),
          lambda largest, smallest: largest < smallest, "at least adaptiveThreshWinSizeMin"),
    apart(("height_px", "width_px"), lambda height, width: height * width > MAX_PIXELS,
          f"a frame of at most {MAX_PIXELS:,} pixels"),
    # Renderers.
    apart(("renderer", "dictionary"),
          lambda renderer, dictionary: renderer != "exact" and dictionary in marker.STAG_LIBRARIES,
          "exact for STag's markers, which have circles"),
    apart(("renderer", "kind", "distractors"),
          lambda renderer, kind, beside: not is_renderer(renderer) and (kind != SINGLE or beside),
          f"{RENDERERS}, for boards"),
    apart(("renderer", "markers", "distractors"),
          lambda renderer, *listed: renderer != "exact" and any(map(is_solid, listed)),
          f"exact, {SEVERAL_PLANES}"),
    absent(GEOMETRIC, lambda reading: {*reading.values_of("renderer")} - {"exact"},
           "renderer = exact beside it, which alone has it", active=True),
    absent(("curvature_per_m", "occlusion"),
           lambda reading: any(map(
               is_solid, [*reading.values_of("markers"), *reading.values_of("distractors")])),
           f"it absent, {SEVERAL_PLANES}: it is of one sheet", active=True),
    # Cameras, and what estimators believe of them.
    absent(OTHER_WAYS, lambda reading: reading.stated,
           "no other camera beside camera_file; delete it, or camera_file"),
    absent(
        ("believed_fx_px", "believed_fy_px", "believed_cx_px", "believed_cy_px",
         "believed_focal_scale", "believed_distortion"), _is_calibrated,
        "no other belief about the camera beside believed = calibration; delete one of them"),
    # Photographs, which have their own poses and light.
    absent(("simulated",), _without("photographs"),
           "photographs beside it, whose poses are taken", active=True),
    absent(("kind",), lambda reading: "photographs" in reading.given and reading.shows_boards,
           "no board beside photographs, whose board `sweep photos` knows; delete it"),
    apart(("believed", "photographs"), lambda believed, file: file and believed == "calibration",
          "truth, for photographs"),
    # Boards.
    absent(("points", "refine", "refineDetectedMarkers", "minMarkers"),
           lambda reading: not reading.shows_boards, "a board: give kind under [board]"),
    absent(("ids",), lambda reading: "marker_id" in reading.given,
           "ids, or marker_id of the first; not both", active=True),
    apart(("points", "detector"),
          lambda points, detector: points == "chessboard" and is_recording(detector),
          "markers beside recorded detections, which have no corners of chessboards"),
    apart(("refineDetectedMarkers", "detector"),
          lambda refine, detector: refine and is_recording(detector),
          "false beside recorded detections: no image is searched"),
    apart(("refineDetectedMarkers", "markers"),
          lambda refine, listed: refine and is_solid(listed), f"false, {SEVERAL_PLANES}"),
    apart(("solver", "points", "markers"),
          lambda solver, points, listed: is_solid(listed) and solver in SOLVERS
          and SOLVERS[solver].planar_only and points in ("markers", "chessboard"),
          f"one of iterative, sqpnp, epnp, photometric, {SEVERAL_PLANES}"),
)

# --------------------------------------------------------------------------------------------------
# The camera: the sides of its sensor, and the file of a calibration, whose values take the place
# of the camera's keys.
#
# A camera is given in one of four ways: focal lengths in pixels, a field of view, a focal length
# in millimetres (with the sensor's sides or the size of a pixel), or a calibration's file. The
# file's values are written into the pipeline's text: a store does not need the file any more.

#: The parameters whose values a camera file has.
FILE_VALUES = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")


def file_and_camera(written: str, is_file: Callable[[str], bool]) -> tuple[str, str]:
    """Return the path, and the name of the camera in the file or "".

    >>> file_and_camera("chains/camchain.yaml#cam1", lambda path: "#" not in path)
    ('chains/camchain.yaml', 'cam1')
    """
    path, mark, camera = written.rpartition("#")
    return (path, camera) if mark and not is_file(written) else (written, "")


def read_camera_file(reading: Reading) -> None:
    """Give the camera's parameters the values of its file, which take its place; note faults.

    Keys that say something else than the file are at fault.
    """
    written = reading.fixed.get("camera_file")
    if written is None:
        return
    folder = Path(reading.folder)
    path, camera = file_and_camera(written, lambda path: (folder / path).is_file())
    try:
        calibration = calibration_of(read_tree(read_regular(folder / path, MAX_BYTES)), camera)
    except (OSError, ValueError) as error:
        reason = error.strerror or "unreadable" if isinstance(error, OSError) else error
        reading.refuse("camera_file", f"a camera file ({reason})")
        return
    name = plain(Path(path).name)
    values = {key: getattr(calibration, key) for key in FILE_VALUES}
    missing = [key for key in values if values[key] is None and key not in reading.given]
    if missing:
        reading.refuse("camera_file", f"{' and '.join(missing)} beside it: {name} does not say "
                       "which frame size it holds for")
    values |= zip(STATED, (calibration.sd or None, calibration.covariance or None), strict=True)
    for key, value in values.items():
        if value is not None and key in reading.given:
            if reading.fixed.get(key) != value:
                reading.refuse(key, f"{shown(value)}, which {name} has; delete it, or camera_file")
        elif value is not None:
            reading.written[key] = f"camera.{key}", value
            reading.stated[key] = value
            try:
                reading.fixed[key] = PARAMETERS[key].check(value)
            except ValueError as error:
                reading.refuse(
                    "camera_file", f"a camera file ({key} = {shown(value)}: expected {error})")
                del reading.fixed[key]
    del reading.written["camera_file"]
    reading.fixed["camera_file"] = None


def beliefs_in_one_way(reading: Reading) -> None:
    """Demand the error of a calibration in one way, and one where a calibration is believed."""
    if not reading.fixed.keys() >= {*STATED}:
        return
    sd, covariance = (reading.fixed[name] for name in STATED)
    if sd and covariance:
        reading.refuse(STATED[0], f"{' or '.join(STATED)}, not both; delete one of them")
    elif sd or covariance:
        try:
            for count in {len(lens) for lens in reading.values_of("distortion")}:
                CalibrationError.of(sd, covariance, count)
        except ValueError as error:
            reading.refuse(STATED[0] if sd else STATED[1], str(error))
    elif _is_calibrated(reading):
        where = "camera_file has none" if reading.stated else "or a camera_file"
        reading.refuse("believed", "a calibration's standard deviations: give calibration_sd under "
                       f"[camera] ({where})")


# --------------------------------------------------------------------------------------------------
# Files that a pipeline names: background images, photographs. Their digests are noted.

def check_backgrounds(reading: Reading) -> None:
    """Demand background images that can be read and have the frame's size."""
    sizes = {}
    images = [value for value in reading.values_of("background") if isinstance(value, str)]
    for value in images if reading.recorded is None else ():
        path = os.path.join(reading.folder, value)  # noqa: PTH118  (it may be of any length)
        try:
            sizes[value] = decode_grey(path).shape[::-1]
            reading.files[value] = file_digest(Path(path)) or ""
        except ValueError as error:
            reading.refuse("background", f"a level or an image file ({error})", value)
    _have_the_frames_size(reading, "background", sizes)


def _have_the_frames_size(
    reading: Reading, name: str, sizes: Mapping[str, tuple[int, ...]]
) -> None:
    """Demand frames of the ``sizes``, width and height in pixels, of the files of a parameter."""
    for side, key in enumerate(("width_px", "height_px")):
        for file, length in reading.meeting(name, key):
            if file in sizes and sizes[file][side] != length:
                reading.refuse(
                    name, "images of exactly the frame's size: it is "
                    f"{' x '.join(map(str, sizes[file]))}, but {key} = {length}", file)


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
    if "photographs" not in reading.given:
        return
    simulated = any(reading.values_of("simulated"))
    own = "poses" if simulated else "poses and light"
    for name in reading.given - {"photographs", "simulated"}:
        if reading.parameters[name].section in ("pose", "pose" if simulated else "scene"):
            reading.refuse(
                name, f"nothing beside photographs, which have their own {own}; delete it")
    if SEARCH in reading.document:
        reading.fault(SEARCH, reading.document[SEARCH], "no such section: photographs are given")
    if reading.recorded is not None:
        return
    sizes = {}
    for name in dict.fromkeys(reading.values_of("photographs")):
        path = Path(reading.folder) / name
        try:
            record, reading.files[name] = PhotographRecord.read(path)
        except PluginError as error:
            reading.refuse("photographs", str(error), name)
            continue
        sizes[name] = record.width_px, record.height_px
        for relative, known in zip(record.paths, record.digests, strict=True):
            found = known if simulated else file_digest(path.parent / relative)
            if found != known:
                reading.note(plain(relative), "the photograph cannot be read" if found is None else
                             "the photograph is not the one that was recorded: its SHA-256 differs")
            reading.files[relative] = known
    _have_the_frames_size(reading, "photographs", sizes)


# --------------------------------------------------------------------------------------------------
# Targets: boards, prints beside them, their detectors and solvers.

#: The most boards of a grid: all are checked before anything is computed.
MAX_BOARDS = 10_000

def boards_can_be_printed(reading: Reading) -> None:
    """Demand the parameters of each kind of board, and boards whose parts do not overlap."""
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
    count = math.prod(map(len, reading.axes_with(ARRANGING)))
    if count > MAX_BOARDS:
        reading.note("axes", f"{count:,} different boards: expected at most {MAX_BOARDS:,}")
        return
    for values in reading.arrangements():
        for name, value, expected in arrangement_faults(values):
            section = reading.parameters[name.partition("[")[0]].section
            reading.fault(f"{section}.{name}", value, expected)



def targets_are_solved(reading: Reading) -> None:
    """Demand solvers that can do boards, or single markers."""
    plugged = [each.name for each in reading.plugins if each.of_boards]
    if not reading.shows_boards:
        apart(("solver",), lambda solver: solver in plugged,
              "a solver of single markers, or a board: give kind under [board]")(reading)
        return
    if "chessboard" in reading.values_of("points") and {"charuco", "diamond"}.isdisjoint(
            reading.values_of("kind")):
        reading.refuse(
            "points", "kind = charuco or diamond, which have a chessboard", "chessboard")
    of_boards = [name for name, each in SOLVERS.items() if each.of_boards]
    of_corners = [name for name, each in SOLVERS.items() if each.method is not None]
    for solver, points in reading.meeting("solver", "points"):
        able = [*of_boards, *plugged, *(of_corners if points == "largest_marker" else ())]
        if solver not in able:
            reading.refuse("solver", f"one of {', '.join(of_boards)} for boards; others with "
                           "points = largest_marker if they take corners alone; plug-ins with "
                           "of_boards=True", solver)
    for name, whole in (("points", "markers"), ("refine", "none")):
        for chosen, solver in reading.meeting(name, "solver"):
            if chosen != whole and solver in ("photometric", *plugged):
                reading.refuse(
                    name, f"{whole} beside solver = {solver}, which chooses by itself", chosen)


# --------------------------------------------------------------------------------------------------
# All other rules: ways to give a quantity, partners, packages, random draws, names, sizes.

def each_in_one_way(reading: Reading) -> None:
    """Demand a distance, and each quantity of pose, camera and beliefs in one way."""
    has_poses = "photographs" in reading.given
    given = reading.given - reading.stated.keys() - {*(parameters.IN_CAMERA if has_poses else ())}
    for choice in (*parameters.CHOICES, () if has_poses else (parameters.IN_CAMERA, WORLD)):
        ways = [names for way in choice if (names := [name for name in way if name in given])]
        for other in ways[1:]:
            reading.refuse(other[0], f"{', '.join(ways[0])} or {', '.join(other)}, not both; "
                           "delete one of them")
    if not has_poses and given.isdisjoint(("distance_m", "side_px", *WORLD)):
        reading.note("pose", "expected distance_m or side_px, fixed or under [axes]")


def what_is_installed(reading: Reading) -> None:
    """Demand dictionaries that are installed and that each detector has.

    A store's pipeline can be read without the packages of dictionaries.
    """
    for dictionary in reading.values_of("dictionary") if reading.recorded is None else ():
        if (missing := marker.missing_package(dictionary)) is not None:
            reading.refuse("dictionary", missing, dictionary)
    known = {OPENCV: marker.opencv_dictionary_names()} | {
        plugin.name: plugin.dictionaries for plugin in reading.plugins
        if plugin.kind == "detector" and plugin.dictionaries}
    for dictionary, detector in reading.meeting("dictionary", "detector"):
        if dictionary not in known.get(detector, (dictionary,)):
            reading.refuse(
                "dictionary", "one of OpenCV's for its detector; give another detector"
                if detector == OPENCV else f"one that the detector {detector} has: "
                f"{', '.join(known[detector])}", dictionary)


def something_random_to_repeat(reading: Reading) -> None:
    """Demand a random quantity if there are trials; of Sobol' points one that they draw.

    Their trials are whole replicates.
    """
    trials = len(reading.values_of(TRIAL)) or 1
    # A distribution that is at fault is one, too.
    drawn = any(isinstance(value, Mapping) and reading.axis_of(name) is None
                for name, (_, value) in reading.written.items())
    random = ["jitter_px", *RANDOM, *(
        plugin.settings[0].name for plugin in reading.plugins
        if plugin.kind == "effect" and plugin.random)]
    if trials > 1 and not drawn and "photographs" not in reading.given and not (
            _is_calibrated(reading) or any(map(reading.is_active, random))):
        reading.fault("axes.trial", trials, "something random to repeat: jitter_px above 0, noise, "
                      "or a distribution")
    if reading.sampling != "sobol" or reading.axis(TRIAL) is None or SEARCH in reading.document:
        return
    if trials % REPLICATES or trials < 2 * REPLICATES:
        reading.fault("axes.trial", trials, f"a multiple of {REPLICATES}, at least "
                      f"{2 * REPLICATES}, for sampling = sobol: {REPLICATES} replicates of as many "
                      "points each, best a power of two")


#: Names in datasets and tables that no axis may take.
RESERVED = {
    *VARIABLES, *LABELS, *HEADER, *parameters.SECTIONS, "axes", TRIAL,
    *(flag.name for flags in (Ambiguous, BoundStatus, DetectionStatus, EstimateStatus, Flipped)
      for flag in flags),
    "block", "commits", "compared", "cost", "count", "draws", "image_x_px", "image_y_px",
    "jitter_u_px", "jitter_v_px", "level", "looked_for", "outcome", "share", "treatment",
}


def names_are_free(reading: Reading) -> None:
    """Demand names that nothing else of the dataset has for plug-ins' settings and joint axes."""
    names = [(plugin.name, f" for its setting {setting.name}", setting.name)
             for plugin in reading.plugins for setting in plugin.settings]
    names += [(f"axes.{axis.name}", "", axis.name) for axis in reading.axes if axis.zipped]
    for owner, of, name in names:
        if name in RESERVED or name.startswith("_"):
            reading.note(owner, f"expected another name{of}: the dataset or its analyses have this "
                         "one")


#: The largest grid.
MAX_POSES = 10**12

#: The most configurations: they are listed, and each has its share of every block.
MAX_CONFIGURATIONS = 10_000


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
    *RECORDS,
)


# --------------------------------------------------------------------------------------------------
# Values that replace a pipeline document's: ``--set`` changes it, ``--at`` fixes it.

#: Parameter -> those that say the same in another way: choosing it drops them.
ALTERNATIVES: dict[str, Collection[str]] = {
    **parameters.RIVALS, "camera_file": (*FILE_VALUES, *STATED, *OTHER_WAYS),
    TRIAL: (MAX_TRIALS,), f"{SEARCH}.{MAX_TRIALS}": (TRIAL,),
}


def parse_settings(
    settings: Sequence[str], known: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, Any]:
    """Return the values that "key=value" settings give, by parameter or header key.

    A parameter's name needs no section, and a bare word counts as a string. ``known`` are
    those that the pipeline has, plug-ins' included.

    Raises
    ------
    PipelineError
        One line for each setting that is not of that form.

    Examples
    --------
    >>> parse_settings(["tilt_deg=[0, 45]", "pose.roll_deg=3", "solver=ippe"])
    {'tilt_deg': [0, 45], 'roll_deg': 3, 'solver': 'ippe'}
    """
    def read(key: str, written: str) -> dict[str, Any]:
        section, _, name = key.rpartition(".")
        value, home = documents.read_value(written), documents.section_of(name, known)
        if section in (REQUIRE, SEARCH):
            return {key: value}
        if home and section not in ("", home, "axes"):
            raise ValueError(f"{name} or {home}.{name}")
        if not home and name not in HEADER and not parameters.is_zip(value):
            raise LookupError(name)
        return {name: value}

    return _assigned("--set", settings, read, [*known, TRIAL, *HEADER])


def _assigned(
    option: str, assignments: Iterable[str], read: Callable[[str, str], dict[str, Any]],
    known: Sequence[str],
) -> dict[str, Any]:
    """Return the values that "name=value" texts of an option give.

    ``read`` returns what a name and a value stand for; ValueError says what was expected, and
    LookupError that the name is none of the ``known`` ones.
    """
    faults: list[str] = []
    chosen: dict[str, Any] = {}
    for assignment in assignments:
        name, _, written = (part.strip() for part in assignment.partition("="))
        start = f"{option} {plain(assignment)}: "
        try:
            if not name or not written:
                raise ValueError("name=value, such as tilt_deg=45")
            values = read(name, written)
        except ValueError as error:
            faults.append(f"{start}expected {error}")
        except LookupError as error:
            hint = nearest(error.args[0], known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"{start}unknown parameter{hint}")
        else:
            faults += [f"{start}{each} is given twice" for each in values
                       if each in chosen and option == "--at"]
            chosen |= values
    if faults:
        raise PipelineError(faults)
    return chosen


def displaced_by(chosen: Mapping[str, Any], known: Mapping[str, Parameter]) -> set[str]:
    """Return the parameters that give way to chosen values.

    They are other ways to say the same, and parameters of boards that chosen kinds do not use.

    >>> sorted(displaced_by({"distance_m": 1}, PARAMETERS))
    ['side_px']
    >>> displaced_by({"side_px": 20, "distance_m": 1}, PARAMETERS)
    set()
    """
    names = {name for each in chosen for name in ALTERNATIVES.get(each, ())}.difference(chosen)
    if "kind" in chosen:
        kinds = chosen["kind"] if isinstance(chosen["kind"], list) else [chosen["kind"]]
        used = {"kind", *chosen, *(name for kind in kinds for name in used_by(kind))}
        names |= {name for name, each in known.items() if each.section == "board"} - used
    return names


def apply_settings(
    document: Any, chosen: Mapping[str, Any], known: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes the parameter fixed or drawn. What the chosen values displace goes.
    """
    displaced = displaced_by(chosen, known)
    for table in document.values():
        if isinstance(table, dict):
            for name in table.keys() & displaced:
                del table[name]
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
            continue
        home, _, key = name.rpartition(".")  # of a key of a section that has no parameters
        other = home
        if not home:
            home, other = documents.section_of(name, known) or "axes", "axes"
            if name in known and _is_axis(value, known[name]):
                home, other = other, home
        if all(isinstance(document.get(table, {}), dict) for table in (home, other)):
            if other != home and key in document.get(other, {}):
                del document[other][key]
            inline = isinstance(document, tomlkit.TOMLDocument) and isinstance(value, dict)
            document.setdefault(home, {})[key] = documents.toml_item(value) if inline else value
        # Otherwise a section is no table, which reading the document reports.


def _is_axis(value: Any, parameter: Parameter) -> bool:
    """Return whether a value of ``--set`` makes an axis of a parameter."""
    if isinstance(value, list) and tuple in parameter.types:
        return bool(value) and all(isinstance(item, list) for item in value)
    return isinstance(value, list) or (
        isinstance(value, dict) and DISTRIBUTION_FORMS.keys().isdisjoint(value))


# --------------------------------------------------------------------------------------------------
# The pipeline: a document that is checked as a whole.


@dataclass(frozen=True)
class Pipeline(Grid):
    """A document that is checked as a whole: the grid, its fixed values and its random draws.

    Made by :meth:`from_toml`, :meth:`from_text` or :meth:`from_dict`.

    Attributes
    ----------
    name
        What stores are named after: the file's stem.
    title
        As the document says.
    text
        The effective TOML text: settings and the values of a camera file included.
    requirements, require_per, budget_ms
        Requirements on the results, as texts, the axes whose values are conditions, and the
        most milliseconds of a frame: the section [require]. No part of an experiment's identity.
    stopping
        When sampling stops, as [search] says; None if every trial is computed.
    source
        What lines on faults begin with: the file, if there is one. It is not compared.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({
    ...     "marker": {"size_m": 0.05},
    ...     "axes": {"distance_m": {"geom": [0.1, 1, 20]}, "tilt_deg": [0, 45, 70]},
    ... })
    >>> {axis.name: len(axis) for axis in pipeline.axes}
    {'distance_m': 20, 'tilt_deg': 3}
    """

    name: str
    title: str
    text: str
    requirements: tuple[str, ...] = ()
    require_per: tuple[str, ...] = ()
    budget_ms: float | None = None
    stopping: StoppingRule | None = None
    source: str = field(default="pipeline", compare=False)

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment that it describes, resolved once in each process."""
        return Experiment(self)

    @cached_property
    def facts(self) -> Facts:
        """Facts on its camera and poses, and notes on surprises."""
        return Facts(self.experiment)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for another process, which resolves the experiment itself."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def heading(self) -> str:
        """The title, or without one the name, as it can be printed."""
        return self.title.strip() or plain(self.name)

    def __repr__(self) -> str:
        """Return its heading, axes with their lengths, and what else its document gives."""
        axes = " x ".join(f"{axis.name} ({len(axis):,})" for axis in self.axes)
        given = {name: value for name, value in (self.fixed | self.distributions).items()
                 if name in self.given}
        values = ", ".join(f"{name} = {shown(value)}" for name, value in given.items())
        return f"Pipeline: {self.heading}\n  axes: {axes}\n  given: {plain(values, 600)}"

    @staticmethod
    def from_toml(path: str | Path, settings: Sequence[str] = ()) -> Pipeline:
        """Read a pipeline file.

        Parameters
        ----------
        path
            A TOML file.
        settings
            "key=value" with TOML values, as ``--set`` takes them: they replace the file's.

        Raises
        ------
        PipelineError
            One line for each fault of the file or of the settings.
        """
        path = Path(path_of("path", path))
        source = plain(path, 400)
        with documents.refusing(source):
            text = documents.file_text(path)
        return Pipeline.from_text(
            text, settings, name=path.stem, source=source, folder=path.parent)

    @staticmethod
    def from_text(
        text: str,
        settings: Sequence[str] = (),
        *,
        name: str = "pipeline",
        source: str = "pipeline",
        folder: str | Path = ".",
        files: Mapping[str, str] | None = None,
        plugins: Sequence[DeclaredPlugin] | None = None,
    ) -> Pipeline:
        """Read a pipeline from TOML text.

        Parameters
        ----------
        text
            A pipeline file's text.
        settings
            As for :meth:`from_toml`.
        name
            What stores are named after.
        source
            The beginning of the lines of an error.
        folder
            Where relative paths start.
        files
            Path as written -> SHA-256: used instead of reading the files that the text refers to,
            as for a store whose files may have moved.
        plugins
            The plug-ins that a store has recorded, used instead of importing them.

        Raises
        ------
        PipelineError
            One line for each fault of the text or of the settings.
        """
        with documents.refusing(source):
            document = documents.read_document(text)
        chosen = {}
        if settings := texts_of("settings", settings or ()):
            # Other settings may be of plug-ins that settings name.
            named = copy.deepcopy(document)
            apply_settings(named, parse_settings([
                each for each in settings
                if each.partition("=")[0].strip().rpartition(".")[2] in parameters.NAMING]))
            declared, _ = parameters.read_plugins(named, str(folder), plugins)
            known = parameters.parameters_with(tuple(declared))
            chosen = parse_settings(settings, known)
            apply_settings(document, chosen, known)
        reading = documents.read_keys(document, source, str(folder), files, plugins)
        return _checked(reading, text, name, chosen)

    @staticmethod
    def from_dict(
        mapping: Mapping[str, Any],
        settings: Sequence[str] = (),
        *,
        name: str = "pipeline",
        source: str = "pipeline",
        folder: str | Path = ".",
    ) -> Pipeline:
        """Make a pipeline of nested dictionaries: the document of a pipeline file.

        Parameters
        ----------
        mapping
            Sections and header keys as in a file. Values are what TOML has; tuples and NumPy
            arrays count as lists, NumPy's numbers as numbers, paths as strings, and a ``range``
            as ``{"range": [start, stop, step]}``.
        settings, name, source, folder
            As for :meth:`from_text`.

        Raises
        ------
        PipelineError
            One line for each fault of the mapping or of the settings, worded as for a file.

        Examples
        --------
        >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 0.3}, "seed": 4})
        >>> print(pipeline.to_toml())
        seed = 4
        <BLANKLINE>
        [pose]
        distance_m = 0.3
        <BLANKLINE>
        """
        with documents.refusing(source):
            text = documents.document_text(mapping)
        return Pipeline.from_text(text, settings, name=name, source=source, folder=folder)

    def to_toml(self) -> str:
        """Return the pipeline as a file's text, settings included.

        :meth:`from_text` reads an equal pipeline from it, given the same ``name`` and ``folder``.
        """
        return self.text



def _checked(
    reading: Reading, text: str, name: str, chosen: Mapping[str, Any] | None = None
) -> Pipeline:
    """Return the pipeline of a document; PipelineError with all its faults.

    ``text`` is its text without the ``chosen`` values, which the document has.
    """
    required = read_required(reading)
    stopping = read_search(reading, required)
    read_camera_file(reading)
    for rule in RULES:
        rule(reading)
    if reading.faults:
        raise PipelineError([*reading.faults])
    if chosen or reading.stated:
        # Comments stay. A text that is refused never comes here: tomlkit is slow.
        written: Any = tomlkit.parse(text)
        apply_settings(written, chosen or {}, reading.parameters)
        if reading.stated:
            del written["camera"]["camera_file"]
            apply_settings(written, reading.stated, reading.parameters)
        text = tomlkit.dumps(written)
    grid = {each.name: getattr(reading, each.name) for each in fields(Grid)}
    return Pipeline(**grid | {
        "given": frozenset(reading.given), "axes": tuple(reading.axes),
        "folder": str(Path(reading.folder).resolve()),
    }, name=name, title=reading.title, text=text, stopping=stopping, source=reading.source,
        **required)


# --------------------------------------------------------------------------------------------------
# A cell of a grid, selected by its coordinates: ``distance_m=0.3,tilt_deg=45``.

#: A part between commas; commas within a list or within quotes do not separate.
_PART = re.compile(r"""(?:\[[^\]]*\]?|"[^"]*"?|[^,\["])+""")

_TRIAL = Declared(TRIAL, (int,), 0, "number of the draw", low=0, high=1e18)


def cell(pipeline: Pipeline, at: str) -> Pipeline:
    """Return the pipeline with every axis but ``trial`` fixed, and a single trial.

    It is checked as a file is. What nothing chooses stays, but for what chosen values replace, such
    as ``side_px`` for ``distance_m``.

    Parameters
    ----------
    pipeline
        The grid.
    at
        Coordinates as ``--at`` takes them; axes without one take their first value. Any value
        that a parameter admits is accepted, on the grid or not.

    Raises
    ------
    PipelineError
        One line for each invalid part of ``at``.
    """
    named = parse_selection(at, pipeline)
    chosen: dict[str, Any] = {}
    for axis in pipeline.axes:
        # Values that are not on the grid replace those of its first cell.
        chosen |= axis.at(axis.index_of(named) or 0)
    chosen |= named
    trial = chosen.pop(TRIAL, 0)
    for other in displaced_by(named, pipeline.parameters):
        chosen.pop(other, None)
    document = documents.read_document(pipeline.text)
    for section in (REQUIRE, SEARCH):  # one pose fulfils or fails nothing
        document.pop(section, None)
    axes = document.get("axes", {})
    for name in [name for name, value in axes.items() if name == TRIAL or parameters.is_zip(value)]:
        del axes[name]
    apply_settings(document, {
        name: list(value) if isinstance(value, tuple) else value for name, value in chosen.items()
    }, pipeline.parameters)
    reading = documents.read_keys(document, "--at", pipeline.folder, stored=pipeline.plugins)
    single = _checked(reading, documents.document_text(document), pipeline.name)
    return replace(single, axes=(Axis(TRIAL, {TRIAL: range(trial, trial + 1)}),))


def parse_selection(at: str, pipeline: Pipeline) -> dict[str, Any]:
    """Return the values of the parameters that ``--at`` names.

    An axis of the pipeline along which parameters go together is named by one of its labels, in
    quotes, or by a number from 0.

    Raises
    ------
    PipelineError
        One line for each invalid part of ``at``.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 1}})
    >>> parse_selection("distance_m=0.3,solver=ippe", pipeline)
    {'distance_m': 0.3, 'solver': 'ippe'}
    """
    declared: dict[str, Declared] = {**pipeline.parameters, TRIAL: _TRIAL}
    together = {axis.name: axis for axis in pipeline.axes if axis.zipped}

    def read(name: str, written: str) -> dict[str, Any]:
        value = documents.read_value(written)
        if name in together:
            axis, labels = together[name], together[name].values
            if value not in (*labels, *range(len(axis))) or isinstance(value, (bool, float)):
                raise ValueError(
                    f'a number from 0 to {len(axis) - 1}, or a label such as "{labels[0]}"')
            return axis.at(labels.index(value) if value in labels else value)
        if name not in declared:
            raise LookupError(name)
        return {name: declared[name].check(value)}

    return _assigned("--at", map(str, _PART.findall(at)), read, [*declared, *together])


def selection_text(pipeline: Pipeline, index: Mapping[str, int]) -> str:
    """Return the cell at indices along axes as ``--at`` takes it; other axes are left out.

    >>> pipeline = Pipeline.from_dict({"pose": {"distance_m": 1}, "axes": {
    ...     "guarded": [True, False], "distortion": [[], [0.1, 0, 0, 0]], "tilt_deg": [0, 30]}})
    >>> selection_text(pipeline, {"guarded": 0, "distortion": 1})
    'guarded=true,distortion=[0.1,0.0,0.0,0.0]'
    """
    return ",".join(
        f"{name}={_written(value)}" for axis in pipeline.axes if axis.name in index
        for name, value in axis.at(index[axis.name]).items()
    )


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return label(value).replace(", ", ",") if isinstance(value, tuple) else label(value)


def coordinates_text(pipeline: Pipeline, chosen: Pipeline) -> str:
    """Return the coordinates of a cell on its grid, in words: "distance_m 0.3, tilt_deg 45"."""
    values = {**chosen.fixed, TRIAL: chosen.axes[0].values[0]}
    parts = [f"{name} {label(values[name])}" for axis in pipeline.axes for name in axis.columns]
    return ", ".join(parts)
