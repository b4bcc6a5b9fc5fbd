"""The report as Markdown, with its figures and scenes as files in a folder beside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import quote

from sweep.report.answer import Answer
from sweep.report.figure import RenderedFigure
from sweep.report.gallery import Scene
from sweep.report.provenance_facts import Provenance
from sweep.report.table import markdown_text
from sweep.report.theme import write_panels


def write_figure(shown: RenderedFigure, folder: Path) -> None:
    """Write a figure as NAME.svg and NAME.png in a folder."""
    if shown.write is not None:
        for suffix in ("svg", "png"):
            shown.write(str(folder / f"{shown.name}.{suffix}"))
    else:
        write_panels(shown.panels, folder / shown.name)


def markdown(
    title: str, found: Answer, made: Provenance, figures: Sequence[RenderedFigure],
    scenes: Iterable[Scene], folder: Path, shown_folder: str,
) -> str:
    """Return the report as Markdown; pictures of scenes are written into ``folder``.

    ``shown_folder`` is the folder's name as the text refers to it; the figures are there.
    """
    place = quote(shown_folder)
    parts = [
        f"# {markdown_text(title)}", markdown_text(found.paragraph),
        "\n".join(
            f"- {markdown_text(tile.heading)}: **{markdown_text(tile.value)}**"
            + (f" ({markdown_text(tile.detail)})" if tile.detail else "")
            for tile in found.tiles
        ),
        "## Where the numbers come from",
        "\n".join(f"- {name}: {markdown_text(text)}" for name, text in made.facts.items()),
        "Store and report are made again by", _code("\n".join(made.commands), "sh"),
        _folded(f"The pipeline, {made.file}", _code(made.pipeline, "toml")),
    ]
    if made.axes is not None:
        parts.append(made.axes.markdown())
    if made.drawn:
        parts.append(f"Drawn per trial: {markdown_text(made.drawn)}.")
    parts += [table.markdown() for table in found.tables]
    parts.append("## Figures")
    for shown in figures:
        parts += [
            f"### {markdown_text(shown.title)}",
            f"![{markdown_text(shown.title)}]({place}/{quote(shown.name)}.png)",
            markdown_text(shown.caption),
            _folded("The numbers behind it", shown.table.markdown()),
        ]
    for number, scene in enumerate(scenes):
        if number == 0:
            parts.append("## Scenes")
        parts.append("### " + ", ".join(markdown_text(text.capitalize()) for text in scene.titles))
        if scene.picture is not None:
            name = f"scene-{number + 1}.png"
            (folder / name).write_bytes(scene.picture)
            parts.append(f"![{markdown_text(scene.alt)}]({place}/{name})")
        parts += [
            markdown_text(text) for text in (scene.told, scene.coordinates, scene.problem) if text
        ]
        parts.append(_code(scene.command, "sh"))
    return "\n\n".join(parts) + "\n"


def _code(text: str, language: str) -> str:
    fence = "```"
    while fence in text:
        fence += "`"
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"


def _folded(summary: str, content: str) -> str:
    return f"<details><summary>{markdown_text(summary)}</summary>\n\n{content}\n\n</details>"
