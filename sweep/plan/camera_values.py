"""The camera of a pipeline: one way to give it, the rules across its keys, and what it is.

A camera is given in one of four ways: focal lengths in pixels, a field of view, a focal length in
millimetres (with the sensor's sides or the size of a pixel), or a calibration's file.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import tomlkit

from sweep.model.camera import DEFAULT_SENSOR_MM, are_square, intrinsics
from sweep.plan.reader import Reading
from sweep.plan.toml_text import read_document

IN_PIXELS = ("fx_px", "fy_px")
IN_MM = ("sensor_width_mm", "sensor_height_mm", "focal_length_mm", "pixel_size_um")
SENSOR_SIDES = ("sensor_width_mm", "sensor_height_mm")
FIELDS_OF_VIEW = ("hfov_deg", "vfov_deg", "dfov_deg")


def one_camera(reading: Reading) -> None:
    """Demand a camera that is given in one way, and completely."""
    given = reading.given - reading.stated.keys()

    def present(names: tuple[str, ...]) -> list[str]:
        return [name for name in names if name in given]

    def fault(name: str, expected: str) -> None:
        reading.fault(name, reading.written(name), expected)

    in_mm, in_pixels = present(IN_MM), present(IN_PIXELS)
    for name in in_pixels:
        if in_mm:
            fault(name, "a camera in pixels or in millimetres, not both; delete it or "
                  f"{', '.join(in_mm)}")
    for name in present(FIELDS_OF_VIEW):
        if others := in_pixels + in_mm:
            fault(name, "a field of view or focal lengths, not both; delete it or "
                  f"{', '.join(others)}")
    for name in present(FIELDS_OF_VIEW)[1:]:
        first = present(FIELDS_OF_VIEW)[0]
        fault(name, f"{first} or {name}, not both: pixels are square, so that one follows from the "
              "other; delete one of them (for other pixels, give fx_px and fy_px)")
    if "pixel_size_um" in given:
        if sides := present(SENSOR_SIDES):
            fault("pixel_size_um", "the size of a pixel or the sensor's sides, not both; delete it "
                  f"or {', '.join(sides)}")
        if "focal_length_mm" not in given and not in_pixels and not present(FIELDS_OF_VIEW):
            fault("pixel_size_um", "focal_length_mm beside it")
    if "fy_px" in given and "fx_px" not in given:
        fault("fy_px", "fx_px beside it")


def resolve_sensor(reading: Reading) -> None:
    """Give the sensor its default sides where these make the pixels square.

    So a pipeline that states the default is equal to one that leaves it out.
    """
    names = ("width_px", "height_px", *SENSOR_SIDES)
    if reading.given & {*IN_PIXELS, *FIELDS_OF_VIEW, "pixel_size_um"}:
        return
    ends = [_ends(reading, name) for name in names]
    if all(ends) and all(_default_is_square(*chosen) for chosen in itertools.product(*ends)):
        for name, default in zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True):
            if name not in reading.given:
                reading.fixed[name] = default


def _ends(reading: Reading, name: str) -> list[Any]:
    """Return the least and the largest value of a parameter on the grid; empty if at fault."""
    values = reading.values(name)
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


SQUARE_FORMAT = 5
"""The store format from which on pixels are square unless both sides of the sensor are given."""


def stored_text(text: str, store_format: int) -> str:
    """Return a store's text of a pipeline as it is to be read.

    Up to format 4, sides of the sensor that were not given were 4.8 mm and 3.6 mm, also where the
    pixels were then not square: they are written out.
    """
    if store_format >= SQUARE_FORMAT:
        return text
    document = read_document(text)
    tables = [document.get(name, {}) for name in ("camera", "axes")]
    if not all(isinstance(table, dict) for table in tables):
        return text
    given = {name for table in tables for name in table}
    missing = [name for name in SENSOR_SIDES if name not in given]
    stated = given & {"width_px", "height_px", *SENSOR_SIDES}
    if "fx_px" in given or not missing or not stated:
        return text
    camera, axes = tables
    if not stated & axes.keys():
        numbers = [camera.get(name, default) for name, default in (
            ("width_px", 640), ("height_px", 480),
            *zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True),
        )]
        positive = all(isinstance(each, (int, float)) and each > 0 for each in numbers)
        if positive and _default_is_square(*numbers):
            return text
    return with_values(text, "camera", {
        name: default for name, default in zip(SENSOR_SIDES, DEFAULT_SENSOR_MM, strict=True)
        if name in missing
    })


def with_values(text: str, section: str, values: Mapping[str, Any]) -> str:
    """Return the text of a pipeline with values written under a section; its comments stay."""
    written = tomlkit.parse(text)
    if section not in written:
        written[section] = tomlkit.table()
    for name, value in values.items():
        written[section][name] = list(value) if isinstance(value, tuple) else value
    return tomlkit.dumps(written)
