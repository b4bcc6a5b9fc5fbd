"""The report as one self-contained HTML page: no network, no script, no other file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence

from jinja2 import Environment, PackageLoader, StrictUndefined

from sweep.report.answer import Answer
from sweep.report.figure import RenderedFigure
from sweep.report.gallery import Scene
from sweep.report.provenance_facts import Provenance
from sweep.report.scene_drawing import CHESSBOARD_LEGEND, LEGEND, css_colour
from sweep.report.svg import panel_svg
from sweep.report.theme import css_variables

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"
"""Content security policy: a browser refuses and logs every request of the page."""


def page(
    title: str, answer: Answer, provenance: Provenance, figures: Sequence[RenderedFigure],
    scenes: Iterable[Scene], require: Sequence[str] = (),
) -> str:
    """Return the report as HTML, from the templates beside this module; all text is escaped."""
    scenes = list(scenes)
    legend = (*LEGEND, *([CHESSBOARD_LEGEND] if any(scene.chessboard for scene in scenes) else []))
    return _environment().get_template("page.html").render(
        policy=POLICY, title=title, answer=answer, provenance=provenance, figures=figures,
        scenes=scenes, require=require,
        legend=[(text, css_colour(colour)) for text, colour in legend],
    )


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("sweep.report"), autoescape=True, undefined=StrictUndefined,
    )
    environment.filters |= {
        "base64": _base64, "panel_svg": panel_svg, "sentence_case": str.capitalize,
    }
    environment.globals["css_variables"] = css_variables
    return environment


def _base64(content: bytes | str) -> str:
    encoded = content.encode() if isinstance(content, str) else content
    return base64.b64encode(encoded).decode()
