"""The pipeline: a checked experiment, as a value."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tomlkit

from sweep.messages import plain, refusal
from sweep.model.image_file import read_regular
from sweep.plan.axes import Axis, Distribution
from sweep.plan.camera_files import read_camera_file
from sweep.plan.camera_values import resolve_sensor, with_values
from sweep.plan.overrides import apply_settings, fix_values, parse_settings
from sweep.plan.parameters import Parameter, Stage
from sweep.plan.plugins import EFFECTS_KEY, NAMED_BY, parameters_with, read_plugins
from sweep.plan.reader import read_keys
from sweep.plan.required import read_required
from sweep.plan.rules import check_rules
from sweep.plan.stopping import SECTIONS, StoppingRule, read_stopping
from sweep.plan.toml_text import MAX_BYTES, document_text, read_document
from sweep.plugins.declared import DeclaredPlugin

MAX_SHOWN_PATH_LENGTH = 400


@dataclass(frozen=True, slots=True)
class Pipeline:
    """A checked experiment: the grid, its fixed values and its random draws.

    Made by :meth:`from_toml`, :meth:`from_text` or :meth:`from_dict`, which check it as a whole.

    Attributes
    ----------
    name
        What stores are named after: the file's stem.
    title, seed, sampling
        As the document says; the seed of all random draws, and how those of a cell's trials relate
        (:data:`sweep.plan.draws.SAMPLINGS`).
    fixed
        Value of every parameter that is neither an axis nor drawn.
    given
        Names of the parameters that the document has.
    distributions
        Distribution of every parameter that is drawn per trial.
    axes
        The grid's dimensions, in the document's order.
    text
        The effective TOML text: settings and the values of a camera file included.
    files
        Path as written -> SHA-256 of every file that the pipeline refers to.
    folder
        Where relative paths start.
    plugins
        The plug-ins that it names.
    requirements, require_per
        What is required of the results, as texts, and the axes whose values are conditions: the
        section [require]. No part of an experiment's identity.
    stopping
        When sampling stops, as a section such as [precision] says; None if every trial is computed.
    budget_ms
        The most milliseconds of a frame, if [require] has a budget.
    source
        What lines on faults begin with: the file, if there is one. It is not compared.

    Examples
    --------
    >>> pipeline = Pipeline.from_dict({
    ...     "marker": {"size_m": 0.05},
    ...     "axes": {"distance_m": {"geom": [0.1, 1, 20]}, "tilt_deg": [0, 45, 70]},
    ... })
    >>> [axis.name for axis in pipeline.axes], pipeline.size(Stage.scene)
    (['distance_m', 'tilt_deg'], 60)
    """

    name: str
    title: str
    seed: int
    sampling: str
    fixed: Mapping[str, Any]
    given: frozenset[str]
    distributions: Mapping[str, Distribution]
    axes: tuple[Axis, ...]
    text: str
    files: Mapping[str, str]
    folder: str
    plugins: tuple[DeclaredPlugin, ...] = ()
    requirements: tuple[str, ...] = ()
    require_per: tuple[str, ...] = ()
    stopping: StoppingRule | None = None
    budget_ms: float | None = None
    source: str = field(default="pipeline", compare=False)

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every parameter by its name: our own, and the settings of its plug-ins."""
        return parameters_with(self.plugins)

    def plugin(self, kind: str, name: str) -> DeclaredPlugin | None:
        """Return the plug-in of a kind by its name; None if it is not one of the pipeline's."""
        return next((p for p in self.plugins if (p.kind, p.name) == (kind, name)), None)

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
            encoded = read_regular(path, MAX_BYTES)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise refusal([f"{source}: cannot be read: {reason}{_similar(path)}"]) from None
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

    def axis(self, name: str) -> Axis | None:
        """Return an axis by name."""
        return next((axis for axis in self.axes if axis.name == name), None)

    def axis_of(self, parameter: str) -> Axis | None:
        """Return the axis along which a parameter varies, alone or together with others."""
        return next((axis for axis in self.axes if parameter in axis.columns), None)

    def cell_at(self, index: Mapping[str, int]) -> dict[str, Any]:
        """Return the value of each parameter that varies, and ``trial``, at indices along axes.

        Axes that ``index`` does not name are left out.
        """
        return {
            name: value for axis in self.axes if axis.name in index
            for name, value in axis.at(index[axis.name]).items()
        }

    def axes_of(self, *stages: Stage) -> tuple[Axis, ...]:
        """Return the axes that bind to the given stages, in the document's order."""
        return tuple(axis for axis in self.axes if axis.stage in stages)

    def size(self, *stages: Stage) -> int:
        """Return the number of grid points over the axes of the given stages."""
        return math.prod(len(axis) for axis in self.axes_of(*stages))

    def values_of(self, name: str) -> Sequence[Any]:
        """Return all values that a parameter takes on the grid; empty if it is drawn."""
        axis = self.axis_of(name)
        if axis is not None:
            return axis.columns[name]
        return (self.fixed[name],) if name in self.fixed else ()

    def any_value(self, name: str, condition: Callable[[Any], bool]) -> bool:
        """Return whether a parameter takes a value for which ``condition`` holds."""
        return any(condition(value) for value in self.values_of(name) if value is not None)


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
    reading = read_keys(document, source, folder, files, camera_files, plugins, SECTIONS)
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
