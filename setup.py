"""What setuptools cannot be told in pyproject.toml: the description that the package page shows.

It is README.md, whose links lead into the tree. On the package page they lead to the tree at the
address ``Source`` of [project.urls]; as long as there is none, their text stays and the link goes.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from setuptools import setup

TOP = Path(__file__).parent
LINK = re.compile(r"\[([^]]*)\]\((?!https?:)([^)\s]*)\)")
IMAGE = re.compile(r"<img [^>]*src=\"(?!https?:)([^\"]*)\"[^>]*>\n*")


def description(readme: str, source: str, version: str) -> str:
    """Return a page whose links and pictures are absolute, or left out where no source is known."""
    if not source:
        return LINK.sub(r"\1", IMAGE.sub("", readme))
    tree = f"{source.rstrip('/')}/blob/v{version}"
    image = f"{source.rstrip('/')}/raw/v{version}"
    readme = IMAGE.sub(lambda found: found[0].replace(found[1], f"{image}/{found[1]}"), readme)
    return LINK.sub(
        lambda found: f"[{found[1]}]({'' if found[2].startswith('#') else tree + '/'}{found[2]})",
        readme)


def main() -> None:
    """Build what is asked for."""
    project = tomllib.loads((TOP / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    version = re.search(r'"(.+)"', (TOP / "sweep" / "version.py").read_text(encoding="utf-8"))
    assert version is not None, "sweep/version.py"
    setup(
        long_description=description(
            (TOP / "README.md").read_text(encoding="utf-8"),
            project.get("urls", {}).get("Source", ""), version[1]),
        long_description_content_type="text/markdown")


if __name__ == "__main__":
    main()
