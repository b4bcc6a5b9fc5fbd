"""Scores of other programs' answers, and hints at wrong conventions."""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from sweep.errors import ArgumentError, OtherExperimentError, PipelineError, StoreError, SweepError
from sweep.exchange.answers import CORNERS, Answers, Conventions, read_answers
from sweep.exchange.export import EXPERIMENT, image_batch, image_batches, read_mark, write_errors
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.messages import plain
from sweep.model.polygon import side_lengths
from sweep.plugins.recording import OF_TARGET, RECORDINGS, REJECTED, SUFFIX, Recording
from sweep.store.files import write_whole
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Faults of the conventions of answers, where the truth fits other ones better.

#: Markers that are compared with the truth.
SAMPLE = 500

MIN_MARKERS = 5


def hints(
    pipeline: Pipeline, answers: Answers, numbers: Integers, origins: Integers,
    conventions: Conventions,
) -> list[str]:
    """Return a line for each convention that the truth contradicts in most of the markers.

    Parameters
    ----------
    pipeline
        The export's.
    answers
        In what are said to be our conventions.
    numbers, origins
        Number of the scene, and (…, 2) first pixel in the frame, of each image.
    conventions
        Those that were said.
    """
    chosen = np.unique(np.linspace(0, max(len(answers.image) - 1, 0), SAMPLE).astype(np.int64))
    chosen = chosen[: len(answers.image)]
    if not len(chosen):
        return []
    image = answers.image[chosen]
    targets = image_batch(pipeline, numbers[image]).targets
    same = answers.marker_id[chosen, None] == targets.marker_id
    known = same.any(axis=1) & np.isfinite(answers.corners[chosen]).all(axis=(1, 2))
    if known.sum() < MIN_MARKERS:
        return []
    truth = targets.corners_px[known, same[known].argmax(axis=1)] - origins[image[known]][:, None]
    return _of_corners(answers.corners[chosen][known], truth, conventions)


def _of_corners(corners: Floats, truth: Floats, conventions: Conventions) -> list[str]:
    """Return the lines of corners (n, 4, 2) beside the truth."""
    side = side_lengths(truth).mean(axis=1)
    orders = list(itertools.permutations(range(4)))
    distance = np.array([
        np.median(np.linalg.norm(corners[:, order] - truth, axis=2).mean(axis=1) / side)
        for order in orders
    ])
    best = int(np.argmin(distance))
    lines = []
    if orders[best] != (0, 1, 2, 3) and distance[best] < 0.2 < distance[0]:
        # corner k of the truth is corner order[k] of the answers, which they call ...
        theirs = [""] * 4
        for k, j in enumerate(orders[best]):
            theirs[conventions.corner_order.index(CORNERS[j])] = CORNERS[k]
        lines.append(
            f'the corners come in the order {" ".join(theirs)}: pass --corner-order '
            f'"{" ".join(theirs)}"'
        )
        corners = corners[:, list(orders[best])]
    offset = np.median((corners - truth).mean(axis=1), axis=0)
    if (np.abs(np.abs(offset) - 0.5) < 0.1).all() and offset[0] * offset[1] > 0:
        center = conventions.pixel_center + round(2 * float(offset[0])) / 2
        lines.append(
            f"the corners are offset by {offset[0]:.2f}, {offset[1]:.2f} px: if the program puts "
            f"the centre of the first pixel at {center:g}, pass --pixel-center {center:g}"
        )
    return lines


# --------------------------------------------------------------------------------------------------
# Scoring of others' answers: the experiment of an export with recorded detections as detector.

DOUBLED = ("refuse", "nearest")

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,79}")


@dataclass(frozen=True, slots=True)
class Scored:
    """Answers that are ready to be scored.

    Attributes
    ----------
    pipeline
        The experiment, with the answers as its detectors.
    name
        The name that its store gets.
    lines
        Lines on the content of the answers, and on likely faults of their conventions.
    written
        Recordings that were not there before.
    """

    pipeline: Pipeline
    name: str
    lines: list[str]
    written: tuple[Path, ...] = ()

    @contextlib.contextmanager
    def withdrawn_if_refused(self) -> Iterator[None]:
        """Remove the recordings that were written if the body refuses to score them."""
        try:
            yield
        except (OtherExperimentError, ArgumentError, PipelineError):
            _remove(self.written)
            raise


@dataclass(frozen=True, slots=True)
class _Images:
    """The images of an export: their names with an index, and keys and origins by that index."""

    pipeline: Pipeline
    index: dict[str, int]
    numbers: Integers
    keys: np.ndarray[Any, np.dtype[np.uint64]]
    origins: Integers


def prepare(
    folder: str | Path,
    files: Sequence[str | Path],
    *,
    names: Sequence[str] = (),
    conventions: Conventions | None = None,
    doubled: str = "refuse",
    beside: bool = False,
    settings: Sequence[str] = (),
) -> Scored:
    """Read answers, record them beside the export's pipeline, and return what scores them.

    Parameters
    ----------
    folder
        An export.
    files
        CSV files, one a program.
    names
        A name for each program (default: the files' names).
    conventions
        Settings of the experiment (default: the export's).
    doubled
        "refuse" where an image has an ID twice, or "nearest".
    beside
        Whether the experiment's own detector searches the same images beside them.
    settings
        "key=value" for the experiment: solvers, beliefs, bounds.

    Raises
    ------
    ArgumentError, PipelineError
        If the files cannot be read as answers; a line for each fault.
    StoreError
        If there is no export, or the recordings cannot be written.
    """
    target = Path(folder)
    mark = read_mark(target)
    if mark is None:
        raise StoreError(
            f"{plain(target, 300)}: not an export; make one with `sweep export PIPELINE "
            f"{plain(target, 300)}`"
        )
    labels = _labels(files, names)
    if doubled not in DOUBLED:
        raise ArgumentError("doubled", doubled, f"expected one of {', '.join(DOUBLED)}")
    images = _images(target, windowed=mark.get("images") == "windows")
    home = target / EXPERIMENT
    recordings, lines = [], []
    poses = True
    corners = False
    for path, label in zip(files, labels, strict=True):
        source = Path(path)
        answers = read_answers(source, images.index, conventions or Conventions(), doubled)
        with_pose = bool(np.isfinite(answers.translation).any())
        poses &= with_pose
        corners |= bool(np.isfinite(answers.corners).any())
        lines += _summary(label, answers, len(images.index), with_pose)
        lines += [
            f"{label}: {line}"
            for line in hints(images.pipeline, answers, images.numbers, images.origins,
                              conventions or Conventions())
        ]
        content = RECORDINGS.content(_recording(answers, images))
        recordings.append((home / f"{label}{SUFFIX}", content))
    written = tuple(path for path, _ in recordings if not path.exists())
    detectors = [f"{label}{SUFFIX}" for label in labels]
    solver = "recorded" if poses and not beside else ""
    try:
        for path, content in recordings:
            _write_recording(path, content)
        pipeline = _pipeline(home, labels[0], detectors, beside, solver, settings)
    except SweepError:
        _remove(written)
        raise
    if poses and corners and not any("solver" in each for each in settings):
        lines.append(
            "the poses are scored; --set solver=ippe_square scores those of the corners, "
            "--set 'solver=[\"recorded\", \"ippe_square\"]' both"
        )
    return Scored(pipeline, "-".join(labels), lines, written)


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        with contextlib.suppress(OSError):
            path.unlink()


def _labels(files: Sequence[str | Path], names: Sequence[str]) -> list[str]:
    """Return a name for each file; ArgumentError if two are the same, or one cannot be."""
    if not files:
        raise ArgumentError("files", "none", "expected at least one")
    if names and len(names) != len(files):
        raise ArgumentError(
            "name", ", ".join(names), f"expected one for each of the {len(files)} files"
        )
    labels = list(names) or [
        re.sub(r"[^A-Za-z0-9._+-]", "-", Path(path).stem).lstrip("-._") or "answers"
        for path in files
    ]
    for label in labels:
        if not _NAME.fullmatch(label):
            raise ArgumentError(
                "name", repr(label), "expected letters, digits, and . _ + - between them"
            )
    if len(set(labels)) < len(labels):
        raise ArgumentError("name", ", ".join(labels), "expected another name for each file")
    return labels


def _images(folder: Path, *, windowed: bool) -> _Images:
    """Return the images of an export, from its pipeline."""
    pipeline = Pipeline.from_toml(folder / EXPERIMENT / "pipeline.toml")
    index: dict[str, int] = {}
    numbers, keys, origins = [], [], []
    for batch in image_batches(pipeline, windowed=windowed):
        names = batch.names
        for row in np.flatnonzero(batch.visible).tolist():
            index[names[row]] = len(index)
        numbers.append(batch.numbers[batch.visible])
        keys.append(batch.keys[batch.visible])
        origins.append(batch.windows[batch.visible, :2])
    return _Images(
        pipeline, index, np.concatenate(numbers), np.concatenate(keys), np.concatenate(origins)
    )


def _recording(answers: Answers, images: _Images) -> Recording:
    """Return answers as recorded detections: sorted by image, in pixels of the frame."""
    order = np.argsort(images.keys[answers.image], kind="stable")
    image = answers.image[order]
    return Recording(
        np.unique(images.keys), images.keys[image], answers.marker_id[order],
        answers.corners[order] + images.origins[image][:, None], answers.rotation[order],
        answers.translation[order],
    )


def _write_recording(path: Path, content: bytes) -> None:
    """Write a recording; StoreError if other detections have its name, which a store may use."""
    with write_errors(path.parent):
        if path.exists() and path.read_bytes() != content:
            raise StoreError(
                f"{plain(path, 300)}: holds other detections, which a store may refer to; choose "
                "another --name, or delete it"
            )
        write_whole(path, content)


def _summary(label: str, answers: Answers, images: int, with_pose: bool) -> list[str]:
    """Return lines on the content of answers."""
    decoded = int((answers.marker_id >= 0).sum())
    of_targets = int((answers.marker_id == OF_TARGET).sum())
    if not decoded + of_targets:
        return [f"{label}: no marker: each of {images:,} images counts as searched in vain"]
    rejected = len(answers.marker_id) - decoded - of_targets
    apart = f" and {of_targets:,} poses of targets" if of_targets else ""
    more = f", {rejected:,} candidates not decoded" if rejected else ""
    found = len(np.unique(answers.image[answers.marker_id != REJECTED]))
    poses = apart or (", with poses" if with_pose else "")
    return [f"{label}: {decoded:,} markers{poses} in {found:,} of {images:,} images{more}"]


def _pipeline(
    home: Path, name: str, detectors: Sequence[str], beside: bool, solver: str,
    settings: Sequence[str],
) -> Pipeline:
    """Return the export's pipeline with recorded detections in the place of its detector."""
    path = home / "pipeline.toml"
    exported = Pipeline.from_toml(path)
    document = tomlkit.parse(exported.text)
    axes: Any = document.get("axes", {})
    values: list[str] = list(detectors)
    if beside:
        values = [*map(str, exported.values_of("detector")), *values]
    else:
        document.pop("detector", None)
        for axis in exported.axes_of(Stage.detection):
            axes.pop(axis.name, None)
    for table in ("detector", "axes"):
        if table in document:
            document[table].pop("detector", None)
    if len(values) == 1:
        document.setdefault("detector", tomlkit.table())["detector"] = values[0]
    else:
        document.setdefault("axes", tomlkit.table())["detector"] = values
    if solver:
        document.setdefault("estimator", tomlkit.table())["solver"] = solver
        along = exported.axis_of("solver")
        if along is not None:
            axes.pop(along.name, None)
    return Pipeline.from_text(
        tomlkit.dumps(document), settings, name=name, source=str(path), folder=home
    )
