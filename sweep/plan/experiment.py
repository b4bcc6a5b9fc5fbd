"""The pipeline: a TOML file read, checked as a whole, and told all its faults at once."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
import tomlkit.items

from sweep.measure.detector import DetectorSetting
from sweep.messages import MAX_FAULTS, nearest, plain, refusal, shown
from sweep.model.effects import GEOMETRIC, RANDOM, VELOCITIES, is_on
from sweep.model.image_file import MAX_PIXELS, image_size, read_image, read_regular
from sweep.model.marker import marker_count
from sweep.model.renderers import background_image
from sweep.plan.axes import (
    MAX_LISTED,
    TRIAL,
    Axis,
    Distribution,
    parse_axis,
    parse_distribution,
    parse_trial,
)
from sweep.plan.parameters import PARAMETERS, SECTIONS, Stage
from sweep.plan.toml_text import MAX_BYTES, quoted_if_bare, read_document, read_value

MAX_POSES = 10**12
"""The largest grid."""

MAX_TREATMENTS = 10_000
"""The most pairs of a detector setting and an estimator: they are listed, and each has its share
of every block."""

MAX_TITLE_LENGTH = 200
MAX_SHOWN_PATH_LENGTH = 400

HEADER = ("title", "seed")


@dataclass(frozen=True, slots=True)
class Pipeline:
    """A checked experiment.

    Attributes
    ----------
    name
        What stores are named after: the file's stem.
    title, seed
        As the file says; the seed of all random draws.
    fixed
        Value of every parameter that is neither an axis nor drawn.
    distributions
        What is drawn per trial.
    axes
        The grid's dimensions, in the file's order.
    text
        The effective TOML text.
    files
        Path as written -> SHA-256 of every file that the pipeline refers to.
    folder
        Where relative paths start.
    """

    name: str
    title: str
    seed: int
    fixed: Mapping[str, Any]
    distributions: Mapping[str, Distribution]
    axes: tuple[Axis, ...]
    text: str
    files: Mapping[str, str]
    folder: str

    @staticmethod
    def from_toml(path: str | Path, settings: Sequence[str] = ()) -> Pipeline:
        """Read a pipeline file; ``settings`` are "key=value" with TOML values, as ``--set`` takes.

        Raises
        ------
        PipelineError
            One line for each fault of the file.
        """
        path = Path(path)
        source = plain(path, MAX_SHOWN_PATH_LENGTH)
        try:
            encoded = read_regular(path, MAX_BYTES)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise refusal([f"{source}: cannot be read: {reason}"]) from None
        if len(encoded) > MAX_BYTES:
            raise refusal([f"{source}: expected at most {MAX_BYTES:,} bytes"])
        try:
            text = encoded.decode()
        except UnicodeDecodeError as error:
            raise refusal([f"{source}: expected UTF-8: byte {error.start} is not"]) from None
        text = text.removeprefix("\ufeff")
        return Pipeline.from_text(
            text, settings, name=path.stem, source=source, folder=path.parent
        )

    @staticmethod
    def from_text(
        text: str,
        settings: Sequence[str] = (),
        *,
        name: str = "pipeline",
        source: str = "pipeline",
        folder: str | Path = ".",
        files: Mapping[str, str] | None = None,
    ) -> Pipeline:
        """Read a pipeline from TOML text (arguments as :meth:`from_toml`).

        ``files`` (path as written -> SHA-256) takes the place of looking at the files that the
        text refers to, as for a store whose files may be elsewhere by now.
        """
        document = _document(text, source)
        if settings:
            chosen = _chosen(settings)
            _apply(document, chosen)
            # What is refused is refused here: tomlkit, which keeps the comments, is slow.
            _Reader(document, source, Path(folder), files).pipeline(name, text)
            written = tomlkit.parse(text)
            _apply(written, chosen)
            text = tomlkit.dumps(written)
            document = _document(text, source)
        return _Reader(document, source, Path(folder), files).pipeline(name, text)

    def axis(self, name: str) -> Axis | None:
        """Return an axis by name."""
        return next((axis for axis in self.axes if axis.name == name), None)

    def axes_of(self, *stages: Stage) -> tuple[Axis, ...]:
        """Return the axes that bind to the given stages, in the file's order."""
        return tuple(axis for axis in self.axes if axis.stage in stages)

    def size(self, *stages: Stage) -> int:
        """Return the number of grid points over the axes of the given stages."""
        return math.prod(len(axis) for axis in self.axes_of(*stages))

    def values_of(self, name: str) -> Sequence[Any]:
        """Return all values that a parameter takes on the grid; empty where it is drawn."""
        axis = self.axis(name)
        if axis is not None:
            return axis.values
        return (self.fixed[name],) if name in self.fixed else ()

    def any_value(self, name: str, condition: Any) -> bool:
        """Tell whether a parameter takes a value for which ``condition`` holds."""
        return any(condition(value) for value in self.values_of(name) if value is not None)


class _Reader:
    """Checks one document and gathers its faults."""

    def __init__(
        self, document: dict[str, Any], source: str, folder: Path,
        files: Mapping[str, str] | None,
    ) -> None:
        self.document = document
        self.known_files = files
        self.source = source
        self.folder = folder
        self.faults: list[str] = []
        self.fixed: dict[str, Any] = {}
        self.distributions: dict[str, Distribution] = {}
        self.axes: dict[str, Axis] = {}
        self.given: set[str] = set()
        self.files: dict[str, str] = {}

    def fault(self, key: str, value: Any, expected: str) -> None:
        """Note one fault: file, key, value, expectation."""
        self.faults.append(f"{self.source}: {plain(key)} = {shown(value)}: expected {expected}")

    def unknown(self, key: str, told: str, word: str, known: Sequence[str]) -> None:
        """Note a key that is none, with the nearest known one where that will be read."""
        hint = nearest(word, known) if len(self.faults) < MAX_FAULTS else ""
        self.faults.append(f"{self.source}: {plain(key)}: {told}{hint}")

    def pipeline(self, name: str, text: str) -> Pipeline:
        line = f"a string: one line of at most {MAX_TITLE_LENGTH} characters"
        title = self._header("title", "", str, line)
        if len(title) > MAX_TITLE_LENGTH or not title.isprintable():
            self.fault("title", title, line)
        seed = self._header("seed", 0, int, "a whole number from 0 to 2^63 - 1")
        if isinstance(seed, int) and not 0 <= seed < 2**63:
            self.fault("seed", seed, "a whole number from 0 to 2^63 - 1")
        known = [*HEADER, *SECTIONS, "axes"]
        for key, value in self.document.items():
            if key in HEADER:
                continue
            if key == "axes" or key in SECTIONS:
                if not isinstance(value, dict):
                    self.fault(key, value, f"a table: [{key}]")
            elif key in PARAMETERS:
                self.fault(key, value, f"it under [{PARAMETERS[key].section}]")
            else:
                what = "a section" if isinstance(value, dict) else "a key"
                self.unknown(key, f"unknown; expected {what} of {', '.join(known)}", key, known)
        for section in SECTIONS:
            self._section(section)
        self._axes()
        for parameter in PARAMETERS.values():
            if parameter.name not in self.given:
                self.fixed[parameter.name] = parameter.default
        self._across()
        if self.faults:
            raise refusal(self.faults)
        return Pipeline(
            name=name, title=title, seed=seed, fixed=self.fixed, distributions=self.distributions,
            axes=tuple(self.axes.values()), text=text, files=self.files,
            folder=str(self.folder.resolve()),
        )

    def _header(self, key: str, default: Any, kind: type, expected: str) -> Any:
        value = self.document.get(key, default)
        if not isinstance(value, kind) or isinstance(value, bool):
            self.fault(key, value, expected)
            return default
        return value

    def _section(self, section: str) -> None:
        table = self.document.get(section, {})
        if not isinstance(table, dict):
            return
        names = [p.name for p in PARAMETERS.values() if p.section == section]
        for key, value in table.items():
            where = f"{section}.{key}"
            if key not in names:
                elsewhere = "axes" if key == TRIAL else (
                    PARAMETERS[key].section if key in PARAMETERS else ""
                )
                told = f"; it belongs under [{elsewhere}]" if elsewhere else ""
                self.unknown(where, f"unknown key{told}", "" if elsewhere else key, names)
                continue
            parameter = PARAMETERS[key]
            self.given.add(key)
            try:
                if isinstance(value, dict):
                    self.distributions[key] = parse_distribution(parameter, value)
                else:
                    self.fixed[key] = parameter.check(value)
            except ValueError as error:
                self.fault(where, value, str(error))

    def _axes(self) -> None:
        table = self.document.get("axes", {})
        if not isinstance(table, dict):
            return
        room = MAX_LISTED
        for key, value in table.items():
            where = f"axes.{key}"
            try:
                if key == TRIAL:
                    self.axes[key] = parse_trial(value)
                elif key not in PARAMETERS:
                    self.unknown(where, "unknown parameter", key, [*PARAMETERS, TRIAL])
                elif key in self.given:
                    section = PARAMETERS[key].section
                    self.fault(
                        where, value, f"it once: {section}.{key} is given too; delete one of them"
                    )
                else:
                    self.given.add(key)
                    axis = self.axes[key] = parse_axis(PARAMETERS[key], value, room)
                    room -= 0 if isinstance(axis.values, range) else len(axis)
            except ValueError as error:
                self.fault(where, value, str(error))

    # What can only be judged with several parameters at hand; what is broken is passed over.

    def _values(self, name: str) -> Sequence[Any]:
        if name in self.axes:
            return self.axes[name].values
        return (self.fixed[name],) if name in self.fixed else ()

    def _given_value(self, name: str) -> Any:
        """Return what the file says of a parameter, to be quoted."""
        for section in (*SECTIONS, "axes"):
            table = self.document.get(section)
            if isinstance(table, dict) and name in table:
                return table[name]
        return self.fixed.get(name)

    def _across(self) -> None:
        distance, side = "distance_m" in self.given, "side_px" in self.given
        if distance and side:
            self.fault(
                "side_px", self._given_value("side_px"),
                "distance_m or side_px, not both; delete one of them",
            )
        if not distance and not side:
            self.faults.append(
                f"{self.source}: pose: expected distance_m or side_px, fixed or under [axes]"
            )
        in_mm = [n for n in ("sensor_width_mm", "sensor_height_mm", "focal_length_mm")
                 if n in self.given]
        for name in ("fx_px", "fy_px"):
            if name in self.given and in_mm:
                self.fault(
                    name, self._given_value(name),
                    f"a camera in pixels or in millimetres, not both; delete it or "
                    f"{', '.join(in_mm)}",
                )
        if "fy_px" in self.given and "fx_px" not in self.given:
            self.fault("fy_px", self._given_value("fy_px"), "fx_px beside it")
        self._ids()
        self._effects()
        low, high = "adaptiveThreshWinSizeMin", "adaptiveThreshWinSizeMax"
        smallest, largest = self._values(low), self._values(high)
        if smallest and largest and max(smallest) > min(largest):
            self.fault(high, self._given_value(high), f"at least {low}")
        self._backgrounds()
        self._detector_fields()
        trials = len(self.axes[TRIAL]) if TRIAL in self.axes else 1
        jitter = self._values("jitter_px")
        noisy = any(self._is_on(name) for name in RANDOM)
        if trials > 1 and not self.distributions and jitter and max(jitter) == 0 and not noisy:
            self.fault(
                "axes.trial", trials,
                "something random to repeat: jitter_px above 0, noise, or a distribution",
            )
        self._sizes()

    def _sizes(self) -> None:
        """Judge what the grid and its images take."""
        lengths = {axis: len(axis) for axis in self.axes.values()}
        poses = math.prod(lengths.values())
        if poses > MAX_POSES:
            self.faults.append(
                f"{self.source}: axes: {min(poses, 10**300):.3g} poses: expected at most "
                f"{MAX_POSES:.0e}"
            )
        treatments = math.prod(
            length for axis, length in lengths.items() if axis.stage is not Stage.scene
        )
        if treatments > MAX_TREATMENTS:
            self.faults.append(
                f"{self.source}: axes: {min(treatments, 10**300):.3g} detector settings times "
                f"estimators: expected at most {MAX_TREATMENTS:,}"
            )
        frame = max(self._values("width_px") or (0,)) * max(self._values("height_px") or (0,))
        if frame <= MAX_PIXELS:
            return
        if "full" in self._values("window"):
            self.fault(
                "scene.window", self._given_value("window"),
                f"auto, for a frame of more than {MAX_PIXELS:,} pixels",
            )
        for name, whole in (
            ("useAruco3Detection", bool),
            ("adaptiveThreshConstant", lambda value: value < 1),
            ("aprilTagQuadDecimate", lambda value: value > 1),
        ):
            if any(whole(value) for value in self._values(name)):
                self.fault(
                    f"detector.{name}", self._given_value(name),
                    f"what needs no whole frame, for one of more than {MAX_PIXELS:,} pixels",
                )

    def _ids(self) -> None:
        ids = self._values("marker_id")
        if not ids:
            return
        largest = max(ids[0], ids[-1]) if isinstance(ids, range) else max(ids)
        for dictionary in self._values("dictionary"):
            count = marker_count(dictionary)
            if largest >= count:
                self.fault(
                    "marker_id", self._given_value("marker_id"),
                    f"IDs from 0 to {count - 1}, which is what {dictionary} has",
                )

    def _is_on(self, name: str) -> bool:
        """Tell whether an effect's switch has, or was meant to have, any but its neutral value."""
        values = self._values(name)
        return any(is_on(name, value) for value in values) if values else name in self.given

    def _effects(self) -> None:
        """Judge the effects that need one another, and a renderer that has them."""
        moving = [
            name for name in VELOCITIES
            if name in self.distributions or any(self._values(name) or [name in self.given])
        ]
        timed = [name for name in ("exposure_s", "row_time_s") if self._is_on(name)]
        for name in timed:
            if not self.given.intersection(VELOCITIES):
                self.fault(
                    f"scene.{name}", self._given_value(name),
                    f"a velocity beside it: {', '.join(VELOCITIES)}",
                )
        for name in moving:
            if not self.given.intersection(("exposure_s", "row_time_s")):
                self.fault(
                    f"scene.{name}", self._given_value(name), "exposure_s or row_time_s beside it"
                )
        for name, other in (
            ("aperture_mm", "focus_distance_m"), ("focus_distance_m", "aperture_mm"),
            ("read_noise_e", "full_well_e"),
        ):
            off = PARAMETERS[name].default
            given = name in self.distributions or any(v != off for v in self._values(name))
            if given and other not in self.given:
                self.fault(f"scene.{name}", self._given_value(name), f"{other} beside it")
        others = [name for name in self._values("renderer") if name != "exact"]
        for name in GEOMETRIC:
            if others and self._is_on(name):
                self.fault(
                    f"scene.{name}", self._given_value(name),
                    f"renderer = exact; {others[0]} does not have it",
                )

    def _backgrounds(self) -> None:
        for value in self._values("background"):
            if not isinstance(value, str):
                continue
            if not value.isprintable():
                self.fault("scene.background", value, "a path without control characters")
                continue
            if self.known_files is not None:
                self.files[value] = self.known_files.get(value, "")
                continue
            path = os.path.join(self.folder, value)  # noqa: PTH118  (it may be of any length)
            try:
                width, height = image_size(path)
                misfit = self._misfit(width, height)
                if misfit is None or self._misfit(height, width) is None:
                    # It may be turned as its EXIF tag says.
                    height, width = background_image(str(Path(path).resolve())).shape
                    misfit = self._misfit(width, height)
                    self.files[value] = file_digest(Path(path)) or ""
            except ValueError as error:
                self.fault("scene.background", value, f"a level or an image file ({error})")
                continue
            if misfit is not None:
                self.fault("scene.background", value, misfit)

    def _misfit(self, width: int, height: int) -> str | None:
        """Return what was expected of an image where it has not the frame's size."""
        for name, length in (("width_px", width), ("height_px", height)):
            if self._values(name) and set(self._values(name)) != {length}:
                return (
                    f"an image of exactly the frame's size: it is {width} x {height}, but "
                    f"{name} = {shown(self._given_value(name))}"
                )
        return None

    def _detector_fields(self) -> None:
        missing = DetectorSetting.missing_fields()
        for name in self.given & missing:
            self.fault(
                f"detector.{name}", self._given_value(name),
                "a field that the installed OpenCV has",
            )


def file_digest(path: Path) -> str | None:
    """Return the SHA-256 of an image file; None where it cannot be read."""
    try:
        return hashlib.sha256(read_image(str(path))).hexdigest()
    except ValueError:
        return None


def _document(text: str, source: str) -> dict[str, Any]:
    try:
        return read_document(text)
    except ValueError as error:
        raise refusal([f"{source}: {error}"]) from None


def fixed_at(pipeline: Pipeline, chosen: Mapping[str, Any]) -> Pipeline:
    """Return a pipeline with parameters fixed at chosen values, checked as a file would be.

    ``trial`` goes; where ``distance_m`` or ``side_px`` is chosen, the other does.
    """
    document = _document(pipeline.text, "--at")
    dropped = {TRIAL}
    for name, other in (("distance_m", "side_px"), ("side_px", "distance_m")):
        if name in chosen and other not in chosen:
            dropped.add(other)
    for table in document.values():
        if isinstance(table, dict):
            for name in dropped & table.keys():
                del table[name]
    for name, value in chosen.items():
        _write(document, name, list(value) if isinstance(value, tuple) else value)
    reader = _Reader(document, "--at", Path(pipeline.folder), None)
    one = reader.pipeline(pipeline.name, pipeline.text)
    return dataclasses.replace(one, text=tomlkit.dumps(document))


def _chosen(settings: Sequence[str]) -> dict[str, Any]:
    """Return the values that "key=value" settings stand for.

    A parameter's name needs no section, and a bare word counts as a string.

    Raises
    ------
    PipelineError
        One line for each setting that is not of that form.
    """
    faults: list[str] = []
    chosen: dict[str, Any] = {}
    for setting in settings:
        key, equals, written = (part.strip() for part in setting.partition("="))
        section, _, name = key.rpartition(".")
        start = f"--set {plain(setting)}: "
        if not equals or not name:
            faults.append(f"{start}expected key=value, such as tilt_deg=45")
            continue
        try:
            value = read_value(quoted_if_bare(written))
        except ValueError:
            faults.append(f"{start}expected a TOML value, such as [0, 45] or 'text'")
            continue
        home = "axes" if name == TRIAL else (
            PARAMETERS[name].section if name in PARAMETERS else ""
        )
        if not home and name not in HEADER:
            known = [*PARAMETERS, TRIAL, *HEADER]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"{start}unknown parameter{hint}")
        elif home and section not in ("", home, "axes"):
            faults.append(f"{start}expected {name} or {home}.{name}")
        else:
            chosen[name] = value
    if faults:
        raise refusal(faults)
    return chosen


def _apply(document: Any, chosen: Mapping[str, Any]) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes it fixed or drawn.
    """
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
            continue
        home = "axes" if name == TRIAL else PARAMETERS[name].section
        if all(isinstance(document.get(table, {}), dict) for table in (home, "axes")):
            _write(document, name, value)
        # Otherwise it is told when the document is read.


def _write(document: Any, name: str, value: Any) -> None:
    """Write one parameter where its value belongs, and take it from where it was."""
    section = PARAMETERS[name].section if name in PARAMETERS else "axes"
    many = name == TRIAL or _is_axis(name, value)
    place, other = ("axes", section) if many else (section, "axes")
    if other != place and name in document.get(other, {}):
        del document[other][name]
    if place not in document:
        document[place] = {}
    kept = isinstance(document, tomlkit.TOMLDocument)
    document[place][name] = _inline(value) if kept and isinstance(value, dict) else value


def _inline(table: dict[str, Any]) -> tomlkit.items.InlineTable:
    inline = tomlkit.inline_table()
    inline.update(table)
    return inline


def _is_axis(name: str, value: Any) -> bool:
    """Tell whether a value given by ``--set`` makes an axis."""
    if isinstance(value, dict):
        return not {"uniform", "normal"} & value.keys()
    if not isinstance(value, list):
        return False
    if tuple in PARAMETERS[name].types:
        return bool(value) and all(isinstance(item, list) for item in value)
    return True

