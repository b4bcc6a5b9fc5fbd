"""A report written: whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from sweep.errors import StoreError
from sweep.measure.flags import DetectionStatus
from sweep.report.answer import answer
from sweep.report.figures import figures_of
from sweep.report.gallery import scenes_of
from sweep.report.markdown import markdown, write_figure
from sweep.report.page import page
from sweep.report.provenance_facts import provenance
from sweep.report.report_data import AREA, Subject, reading

FORMATS = ("html", "md")
PICTURES = (".svg", ".png")
MENDED = "`sweep verify --repair` repairs it"


def check_output(
    output: Path, figures: Path | None = None, form: str = "html", store: str = ""
) -> None:
    """See that a report can be written, before any work is done for it.

    ``store`` is where the report's store is.

    Raises
    ------
    StoreError
        Where the output is a folder, or its folder is missing or cannot be written; where the
        figures' folder is a file; where anything would be written into a store; or where the
        Markdown's folder, which is replaced as a whole, holds something else than pictures.
    """
    folder = figures_folder(output) if form == "md" else None
    for wanted in (output, figures, folder):
        if wanted is not None:
            _check_outside(wanted, store)
    if output.is_dir():
        raise StoreError(f"{output}: cannot be written: it is a folder; name a file in it")
    _check_folder(output, output.absolute().parent)
    for wanted in (figures, folder):
        if wanted is not None and os.path.lexists(wanted) and not wanted.is_dir():
            raise StoreError(f"{wanted}: cannot hold figures: it is a file; name a folder")
    if figures is not None:
        _check_folder(figures, figures if figures.is_dir() else figures.absolute().parent)
    if figures is not None and folder is not None and (
        Path(os.path.realpath(folder)) in Path(os.path.realpath(figures)).parents):
        raise StoreError(f"{figures}: cannot hold figures: {folder} is replaced as a whole")
    if folder is not None and folder.is_dir():
        _check_folder(folder, folder)
        others = sorted(path.name for path in folder.iterdir()
                        if path.suffix not in PICTURES or path.is_dir())
        if others:
            raise StoreError(f"{folder}: cannot be replaced: it holds {others[0]}, which is no "
                             "figure; name another output")


def figures_folder(output: Path) -> Path:
    """Return the folder with the figures and scenes of a report in Markdown."""
    return output.with_name(f"{output.stem}_figures")


def _check_outside(wanted: Path, store: str) -> None:
    """See that a path is not in a local store, its own or any other."""
    local = store.removeprefix("file://")
    own = None if not local or "://" in local else Path(os.path.realpath(local))
    place = Path(os.path.realpath(wanted))
    for path in (*reversed(place.parents), place):
        if path == own or (path / "zarr.json").is_file():
            raise StoreError(f"{wanted}: cannot be written: it lies in the store {path}")


def _check_folder(wanted: Path, folder: Path) -> None:
    if not folder.is_dir():
        raise StoreError(f"{wanted}: cannot be written: there is no folder {folder}")
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise StoreError(f"{wanted}: cannot be written: {error.strerror}") from None


def write_report(
    subject: Subject, output: Path, form: str = "html", figures: Path | None = None
) -> int:
    """Write a store's report; return how many figures it has.

    Parameters
    ----------
    output
        The page, or the Markdown text; what stands there is replaced.
    form
        ``html``, one page that needs nothing else, or ``md``, Markdown with its figures and
        scenes in a folder beside it, ``output`` without its suffix and ``_figures`` behind; an
        older one is replaced as a whole.
    figures
        Where each figure goes as an SVG and a PNG file too.

    Raises
    ------
    StoreError
        Where there are no results, some are missing or cannot be read, or something cannot be
        written.
    """
    if form not in FORMATS:
        raise StoreError(f"--format {form}: expected one of {', '.join(FORMATS)}")
    check_output(output, figures, form, subject.store)
    _check_results(subject)
    subject = subject.in_memory()
    _check_poses(subject)
    title = subject.pipeline.title.strip() or subject.pipeline.name
    found, made = answer(subject), provenance(subject, str(output))
    shown = [kind.show(subject) for kind in figures_of(subject)]
    try:
        with _beside(output) as place:
            pictures = place / "figures"
            pictures.mkdir(parents=True)
            if form == "md" or figures is not None:
                for figure in shown:
                    write_figure(figure, pictures)
            drawn = sorted(pictures.iterdir())
            scenes = scenes_of(subject)
            folder = figures_folder(output)
            if form == "md":
                text = markdown(title, found, made, shown, scenes, pictures, folder.name)
            else:
                text = page(title, found, made, shown, scenes)
            written = place / "report"
            # What is not valid Unicode on its own, from a file's name for instance, is shown as ?.
            written.write_text(text, encoding="utf-8", errors="replace")
            # Nothing is where it was asked for before all is done.
            if figures is not None:
                figures.mkdir(exist_ok=True)
                for path in drawn:
                    shutil.copyfile(path, figures / path.name)
            if form == "md":
                _replace_folder(folder, pictures, place / "old")
            written.replace(output)
    except OSError as error:
        raise StoreError(f"{output}: cannot be written: {error.strerror or error}") from None
    return len(shown)


def _check_results(subject: Subject) -> None:
    """See that there is something to report."""
    if subject.results["estimate"].size == 0:
        raise StoreError(f"{subject.store}: there are no results")


def _check_poses(subject: Subject) -> None:
    """See that every pose of a finished store was run: a chunk that is lost reads as not run."""
    lost = xr.zeros_like(subject.results[AREA], dtype=bool)
    for name in ("detection", "estimate", "flipped"):
        flag = subject.results[name]
        missing = flag == DetectionStatus.not_run
        lost |= missing.any([dim for dim in flag.dims if dim not in lost.dims])
    with reading(subject.store):
        count = int(lost.sum())
    if count:
        poses = "1 pose is" if count == 1 else f"{count:,} poses are"
        raise StoreError(f"{subject.store}: {poses} missing; {MENDED}")


def _replace_folder(folder: Path, new: Path, old: Path) -> None:
    """Move a new folder to a place; what is there goes to ``old``, and back if that fails."""
    if folder.exists():
        folder.rename(old)
    try:
        new.rename(folder)
    except OSError:
        if old.exists():
            old.rename(folder)
        raise


@contextlib.contextmanager
def _beside(output: Path) -> Iterator[Path]:
    """Give the path of a folder beside the output, which is removed in the end."""
    path = output.absolute().with_name(f".{output.name}.{uuid.uuid4().hex[:8]}.{os.getpid()}")
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
