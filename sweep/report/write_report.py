"""Writing a report: completely, or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from sweep.errors import ArgumentError, StoreError
from sweep.measure.flags import DetectionStatus
from sweep.report.answer import Answer, answer
from sweep.report.figures import figure_kinds
from sweep.report.gallery import scenes_of
from sweep.report.grouping import AREA
from sweep.report.markdown import markdown, write_figure
from sweep.report.output_file import (
    check_output_file,
    write_errors_explained,
    write_output_file,
)
from sweep.report.page import page
from sweep.report.provenance_facts import provenance
from sweep.report.report_data import ReportData, store_errors
from sweep.store.locations import enclosing_store, is_remote

FORMATS = ("html", "md")
PICTURES = (".svg", ".png")
COMPUTED_FLAGS = ("detection", "estimate", "flipped")
"""Flags that are not ``not_run`` in any cell of a finished store."""

REPAIR = "`sweep verify --repair` repairs it"


def check_output(
    output: Path, figures: Path | None = None, form: str = "html", store: str = ""
) -> None:
    """Check that a report can be written, before it is computed.

    Parameters
    ----------
    output, figures, form
        As in :func:`write_report`.
    store
        Path or URL of the report's own store.

    Raises
    ------
    StoreError
        If the output is a folder, or its folder is missing or not writable; if the figures' folder
        is a file; if anything would be written into a store; or if the Markdown's folder, which is
        replaced as a whole, holds anything but pictures.
    """
    folder = figures_folder(output) if form == "md" else None
    for wanted in (output, figures, folder):
        if wanted is not None:
            with write_errors_explained(wanted):
                _check_outside(wanted, store)
    check_output_file(output)
    if folder is not None and output.exists() and not output.is_file():
        raise StoreError(
            f"{output}: cannot be written: Markdown needs a folder for its figures beside it; "
            "choose a file, or --format html"
        )
    for wanted in (figures, folder):
        if wanted is not None:
            with write_errors_explained(wanted):
                _check_folder(wanted)
    if figures is not None and folder is not None and (
        Path(os.path.realpath(folder)) in Path(os.path.realpath(figures)).parents):
        raise StoreError(f"{figures}: cannot hold figures: {folder} is replaced as a whole")
    if folder is not None and folder.is_dir():
        others = sorted(path.name for path in folder.iterdir()
                        if path.suffix not in PICTURES or path.is_dir())
        if others:
            raise StoreError(f"{folder}: cannot be replaced: it holds {others[0]}, which is not a "
                             "figure; choose another output")


def figures_folder(output: Path) -> Path:
    """Return the folder of the figures and scenes of a report in Markdown."""
    return output.with_name(f"{output.stem}_figures")


def _check_outside(wanted: Path, store: str) -> None:
    """Check that a path is not inside a local store, the report's own or any other."""
    own = None if not store or is_remote(store) else Path(os.path.realpath(store))
    resolved = Path(os.path.realpath(wanted))
    store_around = own if own in (resolved, *resolved.parents) else enclosing_store(resolved)
    if store_around is not None:
        raise StoreError(f"{wanted}: cannot be written: it is inside the store {store_around}")


def _check_folder(wanted: Path) -> None:
    """Check that files can be written into a folder, which may have to be made."""
    if os.path.lexists(wanted) and not wanted.is_dir():
        wanted.stat()  # a link that leads nowhere, or in a circle
        raise StoreError(f"{wanted}: cannot hold figures: it is a file; choose a folder")
    folder = wanted if wanted.is_dir() else Path(os.path.realpath(wanted)).parent
    if not folder.is_dir():
        raise StoreError(f"{wanted}: cannot be written: folder {folder} not found")
    trial = _temporary_path(folder)
    trial.mkdir()
    trial.rmdir()


def write_report(
    data: ReportData, output: Path, form: str = "html", figures: Path | None = None
) -> tuple[int, Answer]:
    """Write the report of a store; return its number of figures, and the answer.

    Parameters
    ----------
    data
        The store.
    output
        The file to write; an existing one is replaced.
    form
        ``html``: one self-contained page. ``md``: Markdown with its figures and scenes in a folder
        beside it, named as ``output`` with ``_figures`` in place of the suffix; an existing folder
        is replaced as a whole.
    figures
        Folder into which each figure is written as an SVG and a PNG file, too.

    Raises
    ------
    ArgumentError
        If ``form`` is neither of these, or for what cannot be required.
    StoreError
        If there are no results, some are missing or cannot be read, or a file cannot be written.
    """
    if form not in FORMATS:
        raise ArgumentError("form", form, f"expected one of {', '.join(FORMATS)}")
    check_output(output, figures, form, data.store)
    if data.results["estimate"].size == 0:
        raise StoreError(f"{data.store}: there are no results")
    data = data.in_memory()
    _check_complete(data)
    title = data.pipeline.heading
    numbers, origin = answer(data), provenance(data, str(output))
    rendered = [kind.render(data) for kind in figure_kinds(data)]
    folder = figures_folder(output) if form == "md" else None
    with contextlib.ExitStack() as stack:
        stack.enter_context(write_errors_explained(output))
        temporary = None
        if folder is not None or figures is not None:
            beside = Path(os.path.realpath(folder or figures or output)).parent
            temporary = stack.enter_context(_temporary_folder(beside))
            for figure in rendered:
                write_figure(figure, temporary / "figures")
        drawn = [] if temporary is None else sorted((temporary / "figures").iterdir())
        scenes = scenes_of(data)
        if folder is not None and temporary is not None:
            text = markdown(
                title, numbers, origin, rendered, scenes, temporary / "figures", folder.name,
                data.require,
            )
        else:
            text = page(title, numbers, origin, rendered, scenes, data.require)
        # Files are moved to their final paths only after all were written.
        if figures is not None:
            figures.mkdir(exist_ok=True)
            for path in drawn:
                write_output_file(figures / path.name, path.read_bytes())
        if folder is not None and temporary is not None:
            _replace_folder(
                Path(os.path.realpath(folder)), temporary / "figures", temporary / "old"
            )
        # Invalid Unicode, which a file's name may hold, is written as a question mark.
        write_output_file(output, text.encode("utf-8", errors="replace"))
    return len(rendered), numbers


def _check_complete(data: ReportData) -> None:
    """Check that every pose of the finished store was computed: a lost chunk reads as not run."""
    lost = xr.zeros_like(data.results[AREA], dtype=bool)
    for name in COMPUTED_FLAGS:
        flag = data.results[name]
        missing = flag == DetectionStatus.not_run
        lost |= missing.any([dim for dim in flag.dims if dim not in lost.dims])
    with store_errors(data.store):
        count = int(lost.sum())
    if count:
        poses = "1 pose is" if count == 1 else f"{count:,} poses are"
        raise StoreError(f"{data.store}: {poses} missing; {REPAIR}")


def _replace_folder(folder: Path, new: Path, old: Path) -> None:
    """Move ``new`` to ``folder``; an existing folder goes to ``old``, and back on failure."""
    if folder.exists():
        folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        if old.exists():
            old.rename(folder)
        raise


@contextlib.contextmanager
def _temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a folder with an empty folder ``figures``, which is removed in the end."""
    path = _temporary_path(parent)
    try:
        (path / "figures").mkdir(parents=True)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def _temporary_path(folder: Path) -> Path:
    return folder / f".sweep-{uuid.uuid4().hex}"
