"""The pipeline: an experiment read from a document, which is checked as a whole; --set and --at."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomlkit
import tomlkit.items

from sweep.experiment.axes import DISTRIBUTION_FORMS, TRIAL
from sweep.experiment.cameras import (
    FILE_DEVIATIONS,
    FILE_VALUES,
    OTHER_WAYS,
    read_camera_file,
    resolve_sensor,
    with_values,
)
from sweep.experiment.experiment import Experiment
from sweep.experiment.parameters import PARAMETERS, REMOVED, RIVALS, Parameter
from sweep.experiment.plugins import EFFECTS_KEY, NAMED_BY, parameters_with, read_plugins
from sweep.experiment.reader import HEADER, REQUIRE, is_zip, read_keys, section_of
from sweep.experiment.rules import check_rules
from sweep.experiment.sampling import (
    MAX_TRIALS,
    REQUIRE_KEYS,
    read_required,
    read_stopping,
)
from sweep.experiment.stopping import SEARCH
from sweep.experiment.toml_text import (
    MAX_BYTES,
    document_text,
    python_boolean,
    quoted_if_bare,
    read_document,
    read_value,
)
from sweep.messages import MAX_FAULTS, nearest, plain, refusal
from sweep.model.board_kinds import used_by
from sweep.model.image_file import read_regular
from sweep.plugins.declared import DeclaredPlugin

# --------------------------------------------------------------------------------------------------
# Values that replace those of a pipeline document: ``--set`` changes it, ``--at`` fixes it.

ALTERNATIVES: dict[str, Collection[str]] = {
    **RIVALS, "camera_file": (*FILE_VALUES, *FILE_DEVIATIONS, *OTHER_WAYS),
}
"""Parameter -> those that say the same in another way: choosing it drops them."""


def parse_settings(
    settings: Sequence[str], parameters: Mapping[str, Parameter] = PARAMETERS
) -> dict[str, Any]:
    """Return the values that "key=value" settings give, by parameter or header key.

    A parameter's name needs no section, and a bare word counts as a string. ``parameters`` are
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
            value = read_value(quoted_if_bare(python_boolean(written)))
        except ValueError:
            faults.append(f"{start}expected a TOML value, such as [0, 45] or 'text'")
            continue
        home = section_of(name, parameters)
        if (section == REQUIRE and name in REQUIRE_KEYS) or section == SEARCH:
            chosen[f"{section}.{name}"] = value
        elif not home and name not in HEADER and not is_zip(value):
            known = [*parameters, TRIAL, *HEADER]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            hint = next((f"; {REMOVED[old]}" for old in (section, name) if old in REMOVED), hint)
            faults.append(f"{start}unknown parameter{hint}")
        elif is_zip(value) and section in ("", "axes"):
            chosen[name] = value
        elif home and section not in ("", home, "axes"):
            faults.append(f"{start}expected {name} or {home}.{name}")
        else:
            chosen[name] = value
    if faults:
        raise refusal(faults)
    return chosen


def displaced_by(chosen: Collection[str]) -> set[str]:
    """Return the parameters that give way to chosen ones: other ways to say the same.

    >>> sorted(displaced_by(["distance_m"])), sorted(displaced_by(["side_px", "distance_m"]))
    (['side_px'], [])
    """
    others = {name for each in chosen for name in ALTERNATIVES.get(each, ())}
    return others.difference(chosen)


def _delete(document: Any, names: Collection[str]) -> None:
    """Delete parameters from all tables of a document."""
    for table in document.values():
        if isinstance(table, dict):
            for name in table.keys() & names:
                del table[name]


def apply_settings(
    document: Any, chosen: Mapping[str, Any], parameters: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes the parameter fixed or drawn. What the chosen values displace goes.
    """
    _leave_camera_file(document, chosen)
    _delete(document, displaced_by(chosen))
    _delete(document, _other_counts(chosen) | _of_other_boards(chosen, parameters))
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
        elif "." in name:  # a key of a section that has no parameters
            section, _, key = name.partition(".")
            if isinstance(document.setdefault(section, {}), dict):
                document[section][key] = value
        elif all(
            isinstance(document.get(table, {}), dict)
            for table in (section_of(name, parameters), "axes")
        ):
            _write(document, name, value, parameters)
        # Otherwise a section is no table, which reading the document reports.


def _of_other_boards(
    chosen: Mapping[str, Any], parameters: Mapping[str, Parameter]
) -> set[str]:
    """Return the parameters of boards that chosen kinds do not use; those of other kinds go."""
    if "kind" not in chosen:
        return set()
    kinds = chosen["kind"] if isinstance(chosen["kind"], list) else [chosen["kind"]]
    used = {"kind", *chosen, *(name for kind in kinds for name in used_by(kind))}
    return {name for name, each in parameters.items() if each.section == "board"} - used


def _other_counts(chosen: Collection[str]) -> set[str]:
    """Return the keys that say how many trials there are in another way than chosen ones."""
    if any(name.endswith(f".{MAX_TRIALS}") for name in chosen):
        return {TRIAL}
    return {MAX_TRIALS} if TRIAL in chosen else set()


def _leave_camera_file(document: Any, chosen: Collection[str]) -> None:
    """Delete the name of a camera file whose values the document has, if one of them is chosen."""
    camera = document.get("camera")
    if not isinstance(camera, dict) or "camera_file" in chosen:
        return
    if camera.keys() >= {"camera_file", *FILE_VALUES} and {*FILE_VALUES, *OTHER_WAYS} & {*chosen}:
        del camera["camera_file"]


def fix_values(
    document: Any, chosen: Mapping[str, Any], parameters: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Fix parameters of a document at chosen values.

    The axis ``trial`` goes, axes of parameters that go together, each of which must be chosen, and
    what the chosen values displace. The document has the values of its camera file, which goes if
    another value is chosen for one of them.
    """
    axes = document.get("axes", {})
    for section in (REQUIRE, SEARCH):  # one pose fulfils or fails nothing
        document.pop(section, None)
    _leave_camera_file(document, chosen)
    _delete(document, {
        TRIAL, *displaced_by(chosen), *_of_other_boards(chosen, parameters),
        *(name for name, value in axes.items() if is_zip(value)),
    })
    for name, value in chosen.items():
        written = list(value) if isinstance(value, tuple) else value
        _write(document, name, written, parameters)


def _write(
    document: Any, name: str, value: Any, parameters: Mapping[str, Parameter]
) -> None:
    """Write a parameter under its section or under the axes, and delete it from the other."""
    section = parameters[name].section if name in parameters else "axes"
    is_axis = name == TRIAL or _is_axis(name, value, parameters)
    home, other = ("axes", section) if is_axis else (section, "axes")
    if other != home and name in document.get(other, {}):
        del document[other][name]
    if home not in document:
        document[home] = {}
    inline = isinstance(document, tomlkit.TOMLDocument) and isinstance(value, dict)
    document[home][name] = _inline(value) if inline else value


def _inline(table: dict[str, Any]) -> tomlkit.items.InlineTable:
    inline = tomlkit.inline_table()
    inline.update(table)
    return inline


def _is_axis(name: str, value: Any, parameters: Mapping[str, Parameter]) -> bool:
    """Return whether a value of ``--set`` makes an axis."""
    if name not in parameters:
        return True
    if isinstance(value, dict):
        return not DISTRIBUTION_FORMS.keys() & value.keys()
    if not isinstance(value, list):
        return False
    if tuple in parameters[name].types:
        return bool(value) and all(isinstance(item, list) for item in value)
    return True


# --------------------------------------------------------------------------------------------------
# The pipeline: an experiment read from a document, which is checked as a whole.

MAX_SHOWN_PATH_LENGTH = 400


@dataclass(frozen=True, slots=True)
class Pipeline(Experiment):
    """An experiment read from a document, which is checked as a whole.

    Made by :meth:`from_toml`, :meth:`from_text` or :meth:`from_dict`.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({
    ...     "marker": {"size_m": 0.05},
    ...     "axes": {"distance_m": {"geom": [0.1, 1, 20]}, "tilt_deg": [0, 45, 70]},
    ... })
    >>> [axis.name for axis in pipeline.axes], pipeline.size(Stage.scene)
    (['distance_m', 'tilt_deg'], 60)
    """

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
        path = Path(path)
        source = plain(path, MAX_SHOWN_PATH_LENGTH)
        try:
            encoded = read_regular(path, MAX_BYTES)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            if similar := _similar(path):
                reason = f"{str(reason).partition(';')[0]}{similar}"
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
        camera_files: Mapping[str, str] | None = None,
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
            What the lines of an error begin with.
        folder
            Where relative paths start.
        files
            Path as written -> SHA-256: used instead of reading the files that the text refers to,
            as for a store whose files may have moved.
        camera_files
            The same of camera files alone: a store's text has their values.
        plugins
            The plug-ins that a store has recorded, used instead of importing them.

        Raises
        ------
        PipelineError
            One line for each fault of the text or of the settings.
        """
        document = _document(text, source)
        if settings:
            parameters = _parameters(document, settings, folder, plugins)
            chosen = parse_settings(settings, parameters)
            apply_settings(document, chosen, parameters)
            # Checked before tomlkit, which keeps the comments, reads it again: tomlkit is slow.
            _checked(
                document, text, name, source, Path(folder), files, camera_files, plugins
            )
            written = tomlkit.parse(text)
            apply_settings(written, chosen, parameters)
            text = tomlkit.dumps(written)
            document = _document(text, source)
        return _checked(document, text, name, source, Path(folder), files, camera_files, plugins)

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
        try:
            text = document_text(mapping)
        except ValueError as error:
            raise refusal([f"{source}: {line}" for line in str(error).split("\n")]) from None
        return Pipeline.from_text(text, settings, name=name, source=source, folder=folder)

    def to_toml(self) -> str:
        """Return the pipeline as a file's text, settings included.

        :meth:`from_text` reads an equal pipeline from it, given the same ``name`` and ``folder``.
        """
        return self.text

    def fixed_at(self, chosen: Mapping[str, Any], source: str = "--at") -> Pipeline:
        """Return the pipeline with parameters fixed at chosen values, checked as a file is.

        The axis ``trial`` goes, and what they replace, such as ``side_px`` for ``distance_m``.

        Raises
        ------
        PipelineError
            One line for each fault, beginning with ``source``.
        """
        document = _document(self.text, source)
        fix_values(document, chosen, self.parameters)
        text = tomlkit.dumps(document)
        return _checked(
            document, text, self.name, source, Path(self.folder), None, self.files, self.plugins
        )


def _similar(path: Path) -> str:
    """Return the pipeline file that may be meant where there is none; else nothing."""
    candidates = (
        path.with_name(f"{path.name}.toml"), path.with_suffix(".toml"),
        Path("pipelines") / path.name, Path("pipelines") / f"{path.name}.toml",
    )
    try:
        similar = [each for each in candidates if each != path and each.is_file()]
    except (OSError, ValueError):
        return ""
    return f"; did you mean {plain(similar[0])}?" if similar and not path.exists() else ""


def _document(text: str, source: str) -> dict[str, Any]:
    try:
        return read_document(text)
    except ValueError as error:
        raise refusal([f"{source}: {error}"]) from None


def _parameters(
    document: Mapping[str, Any], settings: Sequence[str], folder: str | Path,
    known: Sequence[DeclaredPlugin] | None,
) -> Mapping[str, Parameter]:
    """Return the parameters of a document once the settings that name plug-ins are applied."""
    naming = {EFFECTS_KEY, *(parameter.name for parameter in NAMED_BY.values())}
    chosen = parse_settings(
        [each for each in settings
         if each.partition("=")[0].strip().rpartition(".")[2] in naming]
    )
    changed = copy.deepcopy(dict(document))
    apply_settings(changed, chosen)
    plugins, _ = read_plugins(changed, str(folder), known)  # faults are told when it is checked
    return parameters_with(tuple(plugins))


def _checked(
    document: Mapping[str, Any], text: str, name: str, source: str, folder: Path,
    files: Mapping[str, str] | None, camera_files: Mapping[str, str] | None,
    plugins: Sequence[DeclaredPlugin] | None,
) -> Pipeline:
    """Return the pipeline of a document; PipelineError with all its faults."""
    reading = read_keys(document, source, folder, files, camera_files, plugins)
    read_stopping(reading)
    read_camera_file(reading)
    resolve_sensor(reading)
    check_rules(reading)
    read_required(reading)
    if reading.faults:
        raise refusal(reading.faults)
    if reading.stated:
        text = with_values(text, "camera", reading.stated)
    return Pipeline(
        name=name, title=reading.title, seed=reading.seed, sampling=reading.sampling,
        fixed=reading.fixed,
        given=frozenset(reading.given), distributions=reading.distributions,
        axes=tuple(reading.axes.values()), text=text, files=reading.files,
        folder=str(folder.resolve()), plugins=reading.plugins,
        requirements=reading.requirements, require_per=reading.require_per,
        stopping=reading.stopping,
        budget_ms=reading.budget_ms, source=source,
    )
