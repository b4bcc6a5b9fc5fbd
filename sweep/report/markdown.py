"""The report as Markdown, with its figures and scenes as files in a folder beside it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import quote

from sweep.report.answer import Answer
from sweep.report.figure import RenderedFigure
from sweep.report.gallery import Scene
from sweep.report.provenance_facts import Provenance
from sweep.report.svg import write_panels
from sweep.report.table import markdown_text


def write_figure(figure: RenderedFigure, folder: Path) -> None:
    """Write a figure as NAME.svg and NAME.png into a folder."""
    if figure.write is not None:
        for suffix in ("svg", "png"):
            figure.write(str(folder / f"{figure.name}.{suffix}"))
    else:
        write_panels(figure.panels, folder / figure.name)


def markdown(
    title: str, answer: Answer, provenance: Provenance, figures: Sequence[RenderedFigure],
    scenes: Iterable[Scene], folder: Path, link_folder: str, require: Sequence[str] = (),
) -> str:
    """Return the report as Markdown; pictures of scenes are written into ``folder``.

    ``link_folder`` is the name of the folder with figures and pictures in the links of the text.
    """
    base = quote(link_folder)
    parts = [
        f"# {markdown_text(title)}", f"**{markdown_text(answer.headline)}**",
        *([f"Required: {markdown_text('; '.join(require))}."] if require else []),
        markdown_text(answer.paragraph),
        *(table.markdown() for table in answer.tables),
        *([f"With {markdown_text(answer.of)}, over the whole grid:"] if answer.of else []),
        "\n".join(
            f"- {markdown_text(tile.heading)}: **{markdown_text(tile.value)}**"
            + (f" ({markdown_text(tile.detail)})" if tile.detail else "")
            for tile in answer.tiles
        ),
    ]
    parts.append("## Figures")
    for figure in figures:
        parts += [
            f"### {markdown_text(figure.title)}",
            f"![{markdown_text(figure.title)}]({base}/{quote(figure.name)}.png)",
            markdown_text(figure.caption),
            _folded("The numbers", figure.table.markdown()),
        ]
    for number, scene in enumerate(scenes):
        if number == 0:
            parts.append("## Scenes")
        parts.append("### " + ", ".join(markdown_text(text.capitalize()) for text in scene.titles))
        if scene.picture is not None:
            name = f"scene-{number + 1}.png"
            (folder / name).write_bytes(scene.picture)
            parts.append(f"![{markdown_text(scene.alt)}]({base}/{name})")
        parts += [
            markdown_text(text) for text in (scene.result, scene.coordinates, scene.problem) if text
        ]
        parts.append(_code(scene.command, "sh"))
    parts += ["## More numbers", *(table.markdown() for table in answer.details)]
    parts += _origin(provenance)
    return "\n\n".join(parts) + "\n"


def _origin(provenance: Provenance) -> list[str]:
    """Return the origin of the numbers, and the commands that make them again."""
    parts = [
        "## Origin of the numbers",
        "\n".join(f"- {name}: {markdown_text(text)}" for name, text in provenance.facts.items()),
        "Commands that reproduce the store and this report:",
        _code("\n".join(provenance.commands), "sh"),
        _folded(f"The pipeline, {provenance.file}", _code(provenance.pipeline, "toml")),
    ]
    if provenance.axes is not None:
        parts.append(provenance.axes.markdown())
    if provenance.drawn:
        parts.append(f"Drawn in each trial: {markdown_text(provenance.drawn)}.")
    return parts


def _code(text: str, language: str) -> str:
    fence = "```"
    while fence in text:
        fence += "`"
    return f"{fence}{language}\n{text.rstrip()}\n{fence}"


def _folded(summary: str, content: str) -> str:
    return f"<details><summary>{markdown_text(summary)}</summary>\n\n{content}\n\n</details>"
