"""Scores of other programs' answers, and hints at wrong conventions."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import tomlkit

from sweep.errors import ArgumentError, StoreError
from sweep.exchange import export
from sweep.exchange.answers import CORNER_COLUMNS, CORNERS, Answers, Conventions, read_answers
from sweep.experiment.document import toml_item
from sweep.experiment.parameters import Stage
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import FITS, fitting_order
from sweep.messages import plain
from sweep.plugins.loading import REJECTED, SUFFIX, Recording
from sweep.store.files import write_whole
from sweep.store.locations import translate_errors
from sweep.typing import Floats, Integers

# --------------------------------------------------------------------------------------------------
# Faults of the conventions of answers, where the truth fits other ones better.

MIN_MARKERS = 5


def hints(corners: Floats, truth: Floats, conventions: Conventions) -> list[str]:
    """Return a line for each convention that the truth contradicts in most of the markers.

    Parameters
    ----------
    corners, truth
        (n, 4, 2) px, in what are said to be our conventions; NaN where a marker is not known.
    conventions
        Those that were said.
    """
    known = np.isfinite(corners - truth).all(axis=(1, 2))
    corners, truth = corners[known], truth[known]
    if len(truth) < MIN_MARKERS:
        return []
    order, distance = fitting_order(corners, truth)
    lines = []
    if order != (0, 1, 2, 3) and distance < FITS:
        # Corner k of the truth is corner order[k] of the answers: the one called CORNERS[order[k]].
        theirs = " ".join(CORNERS[order.index(CORNERS.index(name))] for name in conventions.corners)
        lines.append(f'the corners come in the order {theirs}: pass --corner-order "{theirs}"')
        corners = corners[:, order]
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


class Scored(NamedTuple):
    """Answers that are ready to be scored.

    Attributes
    ----------
    pipeline
        The experiment, with the answers as its detectors, by which it is named.
    lines
        Lines on the content of the answers, and on likely faults of their conventions.
    """

    pipeline: Pipeline
    lines: list[str]


@dataclass(frozen=True, slots=True)
class _Images:
    """The I images of an export.

    Attributes
    ----------
    pipeline
        The export's.
    index
        Name, without a suffix -> index.
    keys, origins
        (I,) keys, and (I, 2) first pixels in the frame.
    corners
        True corners in the image, a row each, by the image's index and the marker's ID.
    """

    pipeline: Pipeline
    index: dict[str, int]
    keys: np.ndarray[Any, np.dtype[np.uint64]]
    origins: Integers
    corners: pd.DataFrame

    @staticmethod
    def of(folder: Path) -> _Images:
        """Return those of a folder: StoreError if no export was finished there."""
        shown = plain(folder, 300)
        if export.read_mark(folder) is None:
            raise StoreError(
                f"{shown}: not an export; make one with `sweep export PIPELINE {shown}`")
        pipeline = Pipeline.from_toml(folder / export.EXPERIMENT / "pipeline.toml")
        origin = ["origin_x_px", "origin_y_px"]
        try:
            table = pd.read_csv(
                folder / "truth.csv", usecols=["image", "id", *origin, *CORNER_COLUMNS],
                dtype=dict.fromkeys(CORNER_COLUMNS, np.float64))
            image, names = pd.factorize(table["image"])
            indices = pipeline.experiment.all_scenes.indices(
                np.array([name.partition("-")[0] for name in names], dtype=np.intp))
        except (OSError, ValueError) as error:
            raise StoreError(f"{shown}: truth.csv cannot be read ({plain(error)}); the same "
                             "`sweep export` writes it") from None
        corners = table.set_index([image, "id"])[[*CORNER_COLUMNS]]
        return _Images(
            pipeline, {Path(name).stem: k for k, name in enumerate(names)},
            pipeline.experiment.image_keys(indices),
            table.groupby(image)[origin].first().to_numpy(np.int64),
            corners[~corners.index.duplicated()])

    def truth(self, answers: Answers) -> Floats:
        """Return the true corners (M, 4, 2) of answers; NaN of markers that are not there."""
        at = pd.MultiIndex.from_arrays([answers.image, answers.marker_id])
        return np.reshape(self.corners.reindex(at), (-1, 4, 2))

    def recording(self, answers: Answers) -> Recording:
        """Return answers as recorded detections: sorted by image, in pixels of the frame."""
        order = np.argsort(self.keys[answers.image], kind="stable")
        image = answers.image[order]
        return Recording(
            np.unique(self.keys), self.keys[image], answers.marker_id[order],
            answers.corners[order] + self.origins[image][:, None], answers.rotation[order],
            answers.translation[order],
        )


def prepare(
    folder: str | Path,
    files: Sequence[str | Path],
    *,
    names: Sequence[str] = (),
    conventions: Conventions | None = None,
    doubled: str = "refuse",
    beside: bool = False,
    settings: Sequence[str] = (),
    overwrite: bool = False,
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
        "refuse" where an image has an ID twice, or "nearest": the one nearest to the truth counts.
    beside
        Whether the experiment's own detector searches the same images beside them.
    settings
        "key=value" for the experiment: solvers, beliefs, bounds.
    overwrite
        Whether other detections of a name are replaced.

    Raises
    ------
    ArgumentError, PipelineError
        If the files cannot be read as answers; a line for each fault.
    StoreError
        If there is no finished export, or the recordings cannot be written.
    """
    conventions = conventions or Conventions()
    labels = _labels(files, names)
    images = _Images.of(Path(folder))
    answers = [read_answers(Path(path), images.index, conventions, doubled) for path in files]
    home, lines = Path(folder) / export.EXPERIMENT, []
    with translate_errors(plain(home, 300), "written"):
        for label, each in zip(labels, answers, strict=True):
            lines += [f"{label}: {line}" for line in (
                _summary(each, len(images.index)),
                *hints(each.corners, images.truth(each), conventions))]
            path, content = home / f"{label}{SUFFIX}", images.recording(each).content()
            if not overwrite and path.exists() and path.read_bytes() != content:
                raise StoreError(
                    f"{plain(path, 300)}: holds other detections, which a store may refer to; "
                    "choose another --name, or --overwrite"
                )
            write_whole(path, content)
    posed = all(np.isfinite(each.translation).any() for each in answers)
    return Scored(_pipeline(images.pipeline, home, labels, beside, posed, settings), lines)


def _labels(files: Sequence[str | Path], names: Sequence[str]) -> list[str]:
    """Return a name for each file; ArgumentError if two are the same, or one cannot be."""
    labels = list(names) or [
        re.sub(r"[^A-Za-z0-9._+-]", "-", Path(path).stem).lstrip("-._") or "answers"
        for path in files
    ]
    if len({*labels}) != len(files) or not all(
            re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,79}", label) for label in labels):
        raise ArgumentError(
            "name", ", ".join(labels), f"expected another name for each file, {len(files)} in all, "
            "of letters, digits, and . _ + - between them")
    return labels


def _summary(answers: Answers, images: int) -> str:
    """Return a line on the content of answers."""
    kinds = {
        "markers": answers.marker_id >= 0,
        "poses": np.isfinite(answers.translation[:, 0]),
        "candidates not decoded": answers.marker_id == REJECTED,
    }
    listed = ", ".join(f"{rows.sum():,} {kind}" for kind, rows in kinds.items() if rows.any())
    found = len(np.unique(answers.image[answers.marker_id != REJECTED]))
    return f"{listed or 'nothing'} in {found:,} of {images:,} images, the others searched in vain"


def _pipeline(
    exported: Pipeline, home: Path, labels: Sequence[str], beside: bool, posed: bool,
    settings: Sequence[str],
) -> Pipeline:
    """Return the export's pipeline with recorded detections in the place of its detector."""
    detectors = [*(dict.fromkeys(exported.values_of("detector")) if beside else ()),
                 *(f"{label}{SUFFIX}" for label in labels)]
    ours = {"detector": detectors if len(detectors) > 1 else detectors[0]} | (
        {"solver": "recorded"} if posed and not beside else {})
    document = tomlkit.parse(exported.text)
    if not beside:
        document.pop("detector", None)
    axes: Any = document.get("axes", {})
    for axis in exported.axes:
        if ours.keys() & axis.columns.keys() or (axis.stage is Stage.detection and not beside):
            axes.pop(axis.name, None)
            # Settings that went together with a detector beside which we search are axes.
            axes.update({name: toml_item([*dict.fromkeys(values)])
                         for name, values in axis.columns.items() if beside and name not in ours})
    chosen = [f"{name}={json.dumps(value)}" for name, value in ours.items()]
    scored = Pipeline.from_text(
        tomlkit.dumps(document), [*chosen, *settings], name="-".join(labels),
        source=str(home / "pipeline.toml"), folder=home)
    if not {*detectors} <= {*scored.values_of("detector")}:
        raise ArgumentError("settings", "detector", "expected none: the answers are the detector; "
                            "the experiment's own is added by --beside (in Python, beside=True)")
    return scored
