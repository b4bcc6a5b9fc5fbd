"""The rooms of the package and the imports between them, drawn from the sources.

    python tests/support/room_picture.py        # writes sweep/rooms.svg

Layers are those of the import contract in pyproject.toml. An arrow stands for an import that no
chain of other arrows implies (the transitive reduction), so that the picture stays readable;
imports of the lowest layer, which every room may use, are left out.
"""

import ast
import textwrap
import tomllib
from html import escape
from pathlib import Path

TOP = Path(__file__).parent.parent.parent
PICTURE = TOP / "sweep" / "rooms.svg"
WIDTH, HEIGHT, GAP_X, GAP_Y, MARGIN = 250, 62, 26, 30, 12
CHARACTERS = 42  # of a line of text in a box


def layers():
    """Return the rooms of each layer of the contract, from the top."""
    contracts = tomllib.loads((TOP / "pyproject.toml").read_text())["tool"]["importlinter"]
    listed = contracts["contracts"][0]["layers"]
    return [[name.strip() for name in layer.replace(":", "|").split("|")] for layer in listed
            if layer != "__main__"]


def imports():
    """Return the set of (room, imported room), from the import statements of all modules."""
    arrows = set()
    for path in (TOP / "sweep").rglob("*.py"):
        room = path.relative_to(TOP / "sweep").parts[0].removesuffix(".py")
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [node.module] if node.module != "sweep" else [
                    f"sweep.{alias.name}" for alias in node.names]
            arrows |= {(room, parts[1]) for name in names
                       if (parts := name.split("."))[0] == "sweep" and len(parts) > 1}
    return {(a, b) for a, b in arrows if a != b}


def reduced(arrows):
    """Return the arrows that no chain of two or more other arrows implies."""
    below = {}

    def reach(room):
        if room not in below:
            below[room] = set()
            for a, b in arrows:
                if a == room:
                    below[room] |= {b} | reach(b)
        return below[room]

    return {(a, b) for a, b in arrows
            if not any(b in reach(other) for start, other in arrows if start == a and other != b)}


def subject(room):
    """Return the first sentence of a room's docstring."""
    path = TOP / "sweep" / room
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return " ".join(text.split("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def drawn():
    """Return the picture as SVG."""
    *upper, lowest = layers()
    rooms = {room for layer in upper for room in layer}
    widest = max(map(len, upper))
    full = 2 * MARGIN + widest * WIDTH + (widest - 1) * GAP_X
    at = {}
    for row, layer in enumerate(upper):
        used = len(layer) * WIDTH + (len(layer) - 1) * GAP_X
        for column, room in enumerate(layer):
            at[room] = ((full - used) / 2 + column * (WIDTH + GAP_X),
                        MARGIN + row * (HEIGHT + GAP_Y), row)
    bottom = MARGIN + len(upper) * (HEIGHT + GAP_Y)
    parts = [
        (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {full} {bottom + 34 + MARGIN}" '
        'font-family="Helvetica, Arial, sans-serif">'),
        ('<marker id="head" markerWidth="9" markerHeight="8" refX="8" refY="4" orient="auto">'
        '<path d="M0,0 L9,4 L0,8 z" fill="#555"/></marker>'),
        f'<rect width="{full}" height="{bottom + 34 + MARGIN}" fill="white"/>',
    ]
    arrows = sorted(pair for pair in reduced(imports()) if set(pair) <= rooms)
    parts += [arrow(at[a], at[b]) for a, b in arrows]
    for room, (x, y, _) in at.items():
        parts.append(f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="6" '
                     'fill="#eef4fa" stroke="#0072b2"/>')
        parts.append(f'<text x="{x + 10}" y="{y + 18}" font-size="14" font-weight="bold">'
                     f'{room}/</text>')
        lines = textwrap.wrap(subject(room), CHARACTERS)[:3]
        parts += [f'<text x="{x + 10}" y="{y + 32 + 12 * number}" font-size="10.5">'
                  f'{escape(line)}</text>' for number, line in enumerate(lines)]
    parts.append(f'<rect x="{MARGIN}" y="{bottom}" width="{full - 2 * MARGIN}" height="34" rx="6" '
                 'fill="#f4f4f4" stroke="#888"/>')
    parts.append(f'<text x="{full / 2}" y="{bottom + 22}" font-size="12" text-anchor="middle">'
                 f'for all of them: {", ".join(f"{name}.py" for name in lowest)}</text>')
    return "\n".join([*parts, "</svg>"]) + "\n"


def arrow(start, end):
    """Return an arrow from the lower edge of a box to the upper edge of one below it."""
    (x0, y0, row0), (x1, y1, row1) = start, end
    x0, x1, y0 = x0 + WIDTH / 2, x1 + WIDTH / 2, y0 + HEIGHT
    if row1 == row0 + 1:
        path = f"M{x0},{y0} L{x1},{y1 - 1}"
    else:  # around the boxes between
        side = -1 if x1 <= x0 else 1
        bend = x0 + side * (WIDTH * 0.62 + 12 * (row1 - row0))
        path = (f"M{x0 + side * WIDTH * 0.3},{y0} C{bend},{y0 + 40} {bend},{y1 - 40} "
                f"{x1 + side * WIDTH * 0.3},{y1 - 1}")
    return f'<path d="{path}" fill="none" stroke="#555" marker-end="url(#head)"/>'


if __name__ == "__main__":
    PICTURE.write_text(drawn())
