"""A report written: whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path

from sweep.errors import StoreError
from sweep.report.answer import answer
from sweep.report.figures import figures_of
from sweep.report.gallery import scenes_of
from sweep.report.markdown import markdown, write_figure
from sweep.report.page import page
from sweep.report.provenance_facts import provenance
from sweep.report.subject import Subject

FORMATS = ("html", "md")
NEEDED = ("detection", "estimate", "rotation_error_deg", "flipped")


def check_output(output: Path, figures: Path | None = None) -> None:
    """See that a report can be written, before any work is done for it.

    Raises
    ------
    StoreError
        Where the output is a folder, or its folder is missing or cannot be written.
    """
    if output.is_dir():
        raise StoreError(f"{output}: cannot be written: it is a folder; name a file in it")
    _check_folder(output, output.absolute().parent)
    if figures is not None:
        if figures.exists() and not figures.is_dir():
            raise StoreError(f"{figures}: cannot hold figures: it is a file; name a folder")
        _check_folder(figures, figures if figures.is_dir() else figures.absolute().parent)


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
        scenes in a folder beside it, ``output`` without its suffix and ``_figures`` behind.
    figures
        Where each figure goes as an SVG and a PNG file too.

    Raises
    ------
    StoreError
        Where there are no results, or something cannot be written.
    """
    if form not in FORMATS:
        raise StoreError(f"--format {form}: expected one of {', '.join(FORMATS)}")
    check_output(output, figures)
    missing = [name for name in NEEDED if name not in subject.results]
    if missing or subject.results["estimate"].size == 0:
        raise StoreError(f"{subject.store}: there are no results")
    subject = subject.in_memory()
    title = subject.pipeline.title or subject.pipeline.name
    found, made = answer(subject), provenance(subject, str(output))
    shown = [kind.show(subject) for kind in figures_of(subject)]
    try:
        with _beside(output) as place:
            place.mkdir()
            if form == "md" or figures is not None:
                for figure in shown:
                    write_figure(figure, place)
            drawn = sorted(place.iterdir())
            scenes = scenes_of(subject)
            folder = output.with_name(f"{output.stem}_figures")
            if form == "md":
                text = markdown(title, found, made, shown, scenes, place, folder.name)
            else:
                text = page(title, found, made, shown, scenes)
            # Nothing is where it was asked for before all is done.
            if figures is not None:
                figures.mkdir(exist_ok=True)
                for path in drawn:
                    shutil.copyfile(path, figures / path.name)
            if form == "md":
                folder.mkdir(exist_ok=True)
                for path in place.iterdir():
                    path.replace(folder / path.name)
            written = place / "report"
            # What is not valid Unicode on its own, from a file's name for instance, is shown as ?.
            written.write_text(text, encoding="utf-8", errors="replace")
            written.replace(output)
    except OSError as error:
        raise StoreError(f"{output}: cannot be written: {error.strerror or error}") from None
    return len(shown)


@contextlib.contextmanager
def _beside(output: Path) -> Iterator[Path]:
    """Give the path of a folder beside the output, which is removed in the end."""
    path = output.absolute().with_name(f".{output.name}.{uuid.uuid4().hex[:8]}.{os.getpid()}")
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
