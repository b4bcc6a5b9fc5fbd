"""The camera of a pipeline: one way to give it, its file, and the rules across its keys."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sweep.experiment.parameters import (
    FIELDS_OF_VIEW,
    FOCAL_LENGTHS,
    IN_MM,
    PARAMETERS,
    SENSOR_SIDES,
)
from sweep.experiment.reader import Reading
from sweep.messages import label, plain, shown
from sweep.model.calibration import MAX_BYTES, Calibration, calibration_of, read_tree
from sweep.model.camera import DEFAULT_SENSOR_MM, are_square, intrinsics
from sweep.model.image_file import read_regular

# --------------------------------------------------------------------------------------------------
# The camera of a pipeline: the sides of its sensor, and its values in the pipeline's text.
#
# A camera is given in one of four ways: focal lengths in pixels, a field of view, a focal length
# in millimetres (with the sensor's sides or the size of a pixel), or a calibration's file.

def resolve_sensor(reading: Reading) -> None:
    """Give the sensor its default sides where these make the pixels square.

    So a pipeline that states the default is equal to one that leaves it out.
    """
    names = ("width_px", "height_px", *SENSOR_SIDES)
    if reading.given & {*FOCAL_LENGTHS, *FIELDS_OF_VIEW, "pixel_size_um"}:
        return
    ends = [_ends(reading, name) for name in names]
    if all(ends) and all(_default_is_square(*chosen) for chosen in itertools.product(*ends)):
        for name, default in zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True):
            if name not in reading.given:
                reading.fixed[name] = default


def _ends(reading: Reading, name: str) -> list[Any]:
    """Return the least and the largest value of a parameter on the grid; empty if at fault."""
    values = reading.values_of(name)
    if len(values) == 0:
        return []
    return [values[0]] if len(values) == 1 else [min(values), max(values)]


def _default_is_square(width: Any, height: Any, sensor_width: Any, sensor_height: Any) -> bool:
    default_width, default_height = DEFAULT_SENSOR_MM
    fx, fy, _, _ = intrinsics(
        width, height, sensor_width or default_width, sensor_height or default_height, 1.0,
        None, None, None, None,
    )
    return bool(are_square(fx, fy))


# --------------------------------------------------------------------------------------------------
# The file of a calibration that a pipeline names: its values take the place of the camera's keys.
#
# The values are written into the pipeline's text: a store does not need the file any more.

FILE_VALUES = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion")
"""The parameters whose values a camera file has."""

FILE_DEVIATIONS = ("calibration_sd", "calibration_covariance")

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
        reading.fault(
            "axes.camera_file", reading.written("camera_file"),
            "one file; cameras to compare are axes of fx_px, distortion and so on",
        )
        return
    written = reading.fixed.get("camera_file")
    if written is None:
        return
    if not written.isprintable():
        _fault(reading, "a path without control characters")
        return
    known = reading.known_files if reading.known_files is not None else reading.known_cameras
    if known is not None and reading.given.issuperset(FILE_VALUES):
        path, _ = file_and_camera(written, known.__contains__)
        if path in known:
            reading.files[path] = known[path]
            return
    path, camera = file_and_camera(written, lambda path: _within(reading, path).is_file())
    try:
        content = read_regular(_within(reading, path), MAX_BYTES)
        calibration = calibration_of(read_tree(content), camera)
    except OSError as error:
        _fault(reading, f"a camera file ({error.strerror or 'unreadable'})")
        return
    except ValueError as error:
        _fault(reading, f"a camera file ({error})")
        return
    reading.files[path] = hashlib.sha256(content).hexdigest()
    _take(reading, path, calibration)


def _within(reading: Reading, path: str) -> Path:
    return Path(reading.folder) / path


def _fault(reading: Reading, expected: str) -> None:
    reading.fault("camera.camera_file", reading.written("camera_file"), expected)


def _take(reading: Reading, path: str, calibration: Calibration) -> None:
    """Take a file's values into a reading; keys that say something else are at fault."""
    name = plain(Path(path).name)
    for other in OTHER_WAYS:
        if other in reading.given:
            reading.refuse(
                other, f"no other camera beside camera_file; delete it, or camera_file ({name})")
    if calibration.width_px is None or calibration.height_px is None:
        missing = [key for key in ("width_px", "height_px") if key not in reading.given]
        if missing:
            _fault(
                reading, f"{' and '.join(missing)} beside it: {name} does not say which frame size "
                "it holds for",
            )
    values: dict[str, Any] = {
        **{key: getattr(calibration, key) for key in FILE_VALUES},
        "calibration_sd": calibration.sd, "calibration_covariance": calibration.covariance,
    }
    for key, value in values.items():
        if value is None or (key in FILE_DEVIATIONS and not value):
            continue
        if key in reading.given:
            if reading.fixed.get(key) != value:
                hint = "; a calibration holds for its own frame size" if key in (
                    "width_px", "height_px"
                ) else ""
                reading.refuse(
                    key, f"{_brief(value)}, which {name} has; delete it, or camera_file{hint}")
            continue
        reading.given.add(key)
        try:
            reading.fixed[key] = PARAMETERS[key].check(value)
        except ValueError as error:
            del reading.fixed[key]
            _fault(reading, f"a camera file ({key} = {_brief(value)}: expected {error})")
            continue
        reading.stated[key] = value


def _brief(value: Any) -> str:
    return plain(shown(list(value)) if isinstance(value, tuple) else label(value))
