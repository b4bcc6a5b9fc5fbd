"""The pipeline: a document that is checked as a whole; its values changed by --set and --at."""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit

from sweep.declaration import Declared
from sweep.experiment.axes import DISTRIBUTION_FORMS, TRIAL, Axis
from sweep.experiment.document import (
    HEADER,
    REQUIRE,
    SEARCH,
    Reading,
    Recorded,
    document_text,
    file_text,
    read_document,
    read_keys,
    read_value,
    section_of,
    toml_item,
)
from sweep.experiment.experiment import Experiment
from sweep.experiment.facts import Facts
from sweep.experiment.grid import Grid
from sweep.experiment.parameters import (
    EFFECTS_KEY,
    NAMED_BY,
    PARAMETERS,
    RIVALS,
    STATED,
    Parameter,
    is_zip,
    parameters_with,
    read_plugins,
)
from sweep.experiment.rules import (
    FILE_VALUES,
    OTHER_WAYS,
    check_rules,
    read_camera_file,
    resolve_sensor,
)
from sweep.experiment.sampling import (
    MAX_TRIALS,
    REQUIRE_KEYS,
    StoppingRule,
    read_required,
    read_search,
)
from sweep.messages import MAX_FAULTS, label, nearest, plain, refusal
from sweep.model.board_kinds import used_by
from sweep.plugins.declared import DeclaredPlugin

# --------------------------------------------------------------------------------------------------
# Values that replace those of a pipeline document: ``--set`` changes it, ``--at`` fixes it.

ALTERNATIVES: dict[str, Collection[str]] = {
    **RIVALS, "camera_file": (*FILE_VALUES, *STATED, *OTHER_WAYS),
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
            value = read_value(written)
        except ValueError:
            faults.append(f"{start}expected a TOML value, such as [0, 45] or 'text'")
            continue
        home = section_of(name, parameters)
        if (section == REQUIRE and name in REQUIRE_KEYS) or section == SEARCH:
            chosen[f"{section}.{name}"] = value
        elif not home and name not in HEADER and not is_zip(value):
            known = [*parameters, TRIAL, *HEADER]
            hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
            faults.append(f"{start}unknown parameter{hint}")
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


def _displaced(
    document: Mapping[str, Any], chosen: Mapping[str, Any], parameters: Mapping[str, Parameter]
) -> set[str]:
    """Return the keys of a document that give way to chosen values.

    They are other ways to say the same, and parameters of boards that chosen kinds do not use.
    """
    names = displaced_by(chosen)
    if any(name.endswith(f".{MAX_TRIALS}") for name in chosen):
        names.add(TRIAL)
    elif TRIAL in chosen:
        names.add(MAX_TRIALS)
    if "kind" in chosen:
        kinds = chosen["kind"] if isinstance(chosen["kind"], list) else [chosen["kind"]]
        used = {"kind", *chosen, *(name for kind in kinds for name in used_by(kind))}
        names |= {name for name, each in parameters.items() if each.section == "board"} - used
    camera = document.get("camera")
    if isinstance(camera, dict) and "camera_file" not in chosen and (
        camera.keys() >= {"camera_file", *FILE_VALUES}
        and not chosen.keys().isdisjoint((*FILE_VALUES, *OTHER_WAYS))
    ):
        names.add("camera_file")  # the document has its values, one of which is another now
    return names


def apply_settings(
    document: Any, chosen: Mapping[str, Any], parameters: Mapping[str, Parameter] = PARAMETERS
) -> None:
    """Write chosen values into a document, of plain tables or of tomlkit's.

    A list or a table of values makes (or replaces) an axis; a single value or a distribution
    makes the parameter fixed or drawn. What the chosen values displace goes.
    """
    displaced = _displaced(document, chosen, parameters)
    for table in document.values():
        if isinstance(table, dict):
            for name in table.keys() & displaced:
                del table[name]
    for name, value in chosen.items():
        if name in HEADER:
            document[name] = value
            continue
        if "." in name:  # a key of a section that has no parameters
            home, _, key = name.partition(".")
            other = home
        else:
            section, key = section_of(name, parameters) or "axes", name
            home, other = (
                ("axes", section) if _is_axis(name, value, parameters) else (section, "axes"))
        if all(isinstance(document.get(table, {}), dict) for table in (home, other)):
            if other != home and key in document.get(other, {}):
                del document[other][key]
            inline = isinstance(document, tomlkit.TOMLDocument) and isinstance(value, dict)
            document.setdefault(home, {})[key] = toml_item(value) if inline else value
        # Otherwise a section is no table, which reading the document reports.


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
# The pipeline: a document that is checked as a whole.

MAX_SHOWN_PATH_LENGTH = 400


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
        What is required of the results, as texts, the axes whose values are conditions, and the
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
        """What its camera and poses are, and what may surprise of them."""
        return Facts(self.experiment)

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process gets; it resolves the experiment itself."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def heading(self) -> str:
        """The title, or without one the name, as it can be printed."""
        return self.title.strip() or plain(self.name)

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
            text = file_text(path)
        except ValueError as error:
            similar = _similar(path)
            reason = f"{str(error).partition(';')[0]}{similar}" if similar else error
            raise refusal([f"{source}: {reason}"]) from None
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
        recorded = Recorded(files, camera_files, plugins)
        chosen = {}
        if settings:
            parameters = _parameters(document, settings, str(folder), plugins)
            chosen = parse_settings(settings, parameters)
            apply_settings(document, chosen, parameters)
        return _checked(read_keys(document, source, str(folder), recorded), text, name, chosen)

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
    document: Mapping[str, Any], settings: Sequence[str], folder: str,
    known: Sequence[DeclaredPlugin] | None,
) -> Mapping[str, Parameter]:
    """Return the parameters of a document once the settings that name plug-ins are applied."""
    naming = {EFFECTS_KEY, *(parameter.name for parameter in NAMED_BY.values())}
    changed = copy.deepcopy(document)
    apply_settings(changed, parse_settings(
        [each for each in settings
         if each.partition("=")[0].strip().rpartition(".")[2] in naming]
    ))
    # Faults are told when it is checked.
    return parameters_with(tuple(read_plugins(changed, folder, known)[0]))


def _checked(
    reading: Reading, text: str, name: str, chosen: Mapping[str, Any] | None = None
) -> Pipeline:
    """Return the pipeline of a document; PipelineError with all its faults.

    ``text`` is its text without the ``chosen`` values, which the document has.
    """
    required = read_required(reading)
    stopping = read_search(reading, required)
    read_camera_file(reading)
    resolve_sensor(reading)
    check_rules(reading)
    if reading.faults:
        raise refusal([*reading.faults])
    if chosen or reading.stated:
        # Comments stay. A text that is refused never comes here: tomlkit is slow.
        written = tomlkit.parse(text)
        apply_settings(written, chosen or {}, reading.parameters)
        for key, value in reading.stated.items():
            written.setdefault("camera", tomlkit.table())[key] = toml_item(value)
        text = tomlkit.dumps(written)
    grid = {each.name: getattr(reading, each.name) for each in fields(Grid)}
    return Pipeline(**grid | {
        "given": frozenset(reading.given), "axes": tuple(reading.axes),
        "folder": str(Path(reading.folder).resolve()),
    }, name=name, title=reading.title, text=text, stopping=stopping, source=reading.source,
        **required)


# --------------------------------------------------------------------------------------------------
# A cell of a grid, selected by its coordinates: ``distance_m=0.3,tilt_deg=45``.

_PART = re.compile(r"""(?:\[[^\]]*\]?|"[^"]*"?|[^,\["])+""")
"""A part between commas; commas within a list or within quotes do not separate."""

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
        index = axis.index_of(named) if axis.columns.keys() & named.keys() else 0
        chosen |= axis.at(index or 0)
    chosen |= named
    trial = chosen.pop(TRIAL, 0)
    for other in displaced_by(named):
        chosen.pop(other, None)
    document = _document(pipeline.text, "--at")
    for section in (REQUIRE, SEARCH):  # one pose fulfils or fails nothing
        document.pop(section, None)
    axes = document.get("axes", {})
    for name in [name for name, value in axes.items() if name == TRIAL or is_zip(value)]:
        del axes[name]
    apply_settings(document, {
        name: list(value) if isinstance(value, tuple) else value for name, value in chosen.items()
    }, pipeline.parameters)
    recorded = Recorded(cameras=pipeline.files, plugins=pipeline.plugins)
    reading = read_keys(document, "--at", pipeline.folder, recorded)
    single = _checked(reading, document_text(document), pipeline.name)
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
    faults: list[str] = []
    named: dict[str, Any] = {}
    declared: dict[str, Declared] = {**pipeline.parameters, TRIAL: _TRIAL}
    together = {axis.name: axis for axis in pipeline.axes if axis.zipped}
    for part in map(str, _PART.findall(at)):
        name, equals, written = (piece.strip() for piece in part.partition("="))
        try:
            if not equals or not written:
                raise ValueError("name=value, such as tilt_deg=45")
            try:
                value = read_value(written)
            except ValueError:
                value = written
            if name in together:
                row = together[name].at(_row(together[name], value))
            elif name in declared:
                row = {name: declared[name].check(value)}
            else:
                known = [*declared, *together]
                hint = nearest(name, known) if len(faults) < MAX_FAULTS else ""
                faults.append(f"--at {plain(part)}: unknown parameter{hint}")
                continue
        except ValueError as error:
            faults.append(f"--at {plain(part)}: expected {error}")
            continue
        faults += [f"--at {plain(part)}: {other} is given twice" for other in row if other in named]
        named |= row
    if faults:
        raise refusal(faults)
    return named


def _row(axis: Axis, value: Any) -> int:
    """Return the index along an axis that a label or a number names; ValueError for others."""
    if isinstance(value, str) and value in axis.values:
        return axis.values.index(value)
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(axis):
        return value
    raise ValueError(f'a number from 0 to {len(axis) - 1}, or a label such as "{axis.values[0]}"')


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
    parts = []
    for name in (name for axis in pipeline.axes for name in axis.columns):
        value = chosen.axes[0].values[0] if name == TRIAL else chosen.fixed[name]
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        parts.append(f"{name} {shown}")
    return ", ".join(parts)
