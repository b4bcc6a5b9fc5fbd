"""The sources keep to the size and the words that the project agreed on."""

import ast
import functools
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "sweep"
MODULES = sorted(PACKAGE.rglob("*.py"))

MAX_LINES = 400

RETIRED = {
    "about", "apart", "bent", "here", "look", "looks", "mend", "mended", "mending", "place",
    "placed", "places", "subject", "subjects", "tell", "telling", "there", "told",
}
"""Words that were names of things that have better ones: a store's URL, an error's message."""


def name_of(path):
    return path.relative_to(PACKAGE).as_posix()


@functools.cache
def parsed(text):
    return ast.parse(text)


def first_docstring(path):
    return ast.get_docstring(parsed(path.read_text())) or ""


def declared_names(tree):
    """Yield the names that a module gives: of functions, classes, arguments and variables."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef(name) | ast.AsyncFunctionDef(name) | ast.ClassDef(name):
                yield name
            case ast.arg(name):
                yield name
            case ast.Name(name, ast.Store()) | ast.Attribute(_, name, ast.Store()):
                yield name


def unexplained_length(path):
    """Tell whether a module is long and its first docstring has no sentence that says why."""
    lines = path.read_text().count("\n")
    return lines > MAX_LINES and f"{MAX_LINES} lines" not in first_docstring(path)


def retired_in(path):
    words = {name.strip("_").lower() for name in declared_names(parsed(path.read_text()))}
    return (words | {path.stem.lower()}) & RETIRED


def test_modules_are_short_or_say_why_not():
    assert [name_of(path) for path in MODULES if unexplained_length(path)] == []


def test_modules_say_what_they_are_for():
    assert [name_of(path) for path in MODULES if not first_docstring(path)] == []


def test_retired_words_are_names_no_more():
    found = {name_of(path): retired_in(path) for path in MODULES}
    assert {name: words for name, words in found.items() if words} == {}


def test_a_long_module_and_retired_words_are_noticed(tmp_path):
    path = tmp_path / "module.py"
    path.write_text('"""A module."""\n' + "\n" * MAX_LINES)
    assert unexplained_length(path)
    path.write_text('"""A table, which is why it has more than 400 lines."""\n' + "\n" * MAX_LINES)
    assert not unexplained_length(path)
    path.write_text("def _told(place): apart = look.subject = placed_at = 1\n")
    assert retired_in(path) == {"told", "place", "apart", "subject"}
