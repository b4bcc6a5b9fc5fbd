"""YAML, JSON and OpenCV's XML read within bounds: any bytes give a tree or a reason, and soon.

A tree has dictionaries, lists and scalars. Scalars of YAML and XML stay text, as written: what is
a number is decided by who expects one. Tags, anchors and references make no objects.
"""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree as ET

import yaml

from sweep.messages import plain

MAX_BYTES = 4_000_000
"""The largest file that is read; a calibration with all its image points is a tenth of that."""

MAX_NODES = 300_000
"""The most values of a tree; libyaml reads so many in about a second."""

MAX_DEPTH = 30
"""The deepest nesting."""

_TAGS = ("tag:yaml.org,2002:opencv-", "tag:yaml.org,2002:python/tuple")
"""Beginnings of the tags that mean a plain mapping or list; other tags may make objects."""

_MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"

_COMMENT = re.compile(r"^[ \t]*//[^\n]*$", re.MULTILINE)


def read_tree(content: bytes) -> Any:
    """Return the tree of a file's content.

    Raises
    ------
    ValueError
        Why it has none, in words that follow the file's name and a colon.
    """
    if len(content) > MAX_BYTES:
        raise ValueError(f"more than {MAX_BYTES:,} bytes")
    if content.startswith(b"\x1f\x8b"):
        raise ValueError("compressed; unpack it")
    text = _decoded(content)
    if "\0" in text:
        raise ValueError("not text")
    if not text.strip():
        raise ValueError("empty")
    beginning = text.lstrip()[:1]
    try:
        if beginning == "<":
            return _xml_tree(text)
        if beginning == "{":
            return _json_tree(text)
        return _yaml_tree(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _decoded(content: bytes) -> str:
    """Return the text of UTF-8, of UTF-16 with its mark, or else of Latin-1.

    Windows' shells redirect in UTF-16. OpenCV's programs write the date in the locale's encoding,
    and no camera's numbers are outside of ASCII.
    """
    try:
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            return content.decode("utf-16")
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def _json_tree(text: str) -> Any:
    try:
        # OpenCV writes comments into JSON, each on a line of its own.
        tree = json.loads(_COMMENT.sub("", text))
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON, or cut short: {error.msg} in line {error.lineno}") from None
    except ValueError:
        raise ValueError("not JSON: a number of too many digits") from None
    _check_size(tree)
    return tree


def _check_size(tree: Any) -> None:
    """Demand a tree within the bounds."""
    level, nodes = [tree], 0
    for _ in range(MAX_DEPTH):
        nodes += len(level)
        if nodes > MAX_NODES:
            raise ValueError(f"more than {MAX_NODES:,} values")
        level = [
            part for each in level if isinstance(each, (dict, list))
            for part in (each.values() if isinstance(each, dict) else each)
        ]
        if not level:
            return
    raise ValueError("nested too deeply")


def _xml_tree(text: str) -> Any:
    # Entities are declared in document types; storages have none.
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("XML with a document type, which no camera file has")
    try:
        root = ET.fromstring(text)  # noqa: S314  (no entities are declared)
    except ET.ParseError as error:
        raise ValueError(f"not XML, or cut short: {error}") from None
    if root.tag != "opencv_storage":
        raise ValueError(f"XML of another kind: <{plain(root.tag)}>, not <opencv_storage>")
    return _element(root, 0)


def _element(element: ET.Element, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError("nested too deeply")
    children = list(element)
    if not children:
        return (element.text or "").strip().strip('"')
    if all(child.tag == "_" for child in children):
        return [_element(child, depth + 1) for child in children]
    tree = {child.tag: _element(child, depth + 1) for child in children}
    if len(tree) < len(children):
        raise ValueError(f"XML that has an element of <{plain(element.tag)}> twice")
    return tree


def _yaml_tree(text: str) -> Any:
    if text.startswith("%YAML"):  # OpenCV's "%YAML:1.0" is no directive of YAML
        text = text.partition("\n")[2]
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    events = _Events(yaml.parse(text, Loader=loader))
    try:
        for event in events:
            if isinstance(event, yaml.NodeEvent):
                return events.node(event, 0)
            if isinstance(event, yaml.StreamEndEvent):
                break
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise ValueError(f"not YAML, or cut short: {problem}{line}") from None
    raise ValueError("empty")


class _Events:
    """The events of a YAML parser, of which trees are made without recursion into objects."""

    def __init__(self, events: Iterator[Any]) -> None:
        self._events = events
        self._nodes = 0

    def __iter__(self) -> Iterator[Any]:
        return self._events

    def node(self, event: Any, depth: int) -> Any:
        """Return the tree that begins with an event."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise ValueError(f"more than {MAX_NODES:,} values")
        if depth > MAX_DEPTH:
            raise ValueError("nested too deeply")
        if isinstance(event, yaml.AliasEvent):
            raise ValueError("YAML with references (*), which no camera file has")  # noqa: TRY004
        tag = event.tag or ""
        if tag == "tag:yaml.org,2002:binary":
            raise ValueError("YAML with base64; write the file with numbers")
        if tag.startswith(("tag:", "!")) and tag != "!" and not tag.startswith(_TAGS) and (
            not re.fullmatch("tag:yaml.org,2002:(str|float|int|seq|map|bool|null)", tag)
        ):
            cut = "; is the file cut short?" if _MATRIX_TAG.startswith(tag) else ""
            raise ValueError(f"YAML with the tag {plain(tag)}, which no camera file has{cut}")
        if isinstance(event, yaml.ScalarEvent):
            return str(event.value)
        if isinstance(event, yaml.SequenceStartEvent):
            items = []
            while not isinstance(inner := next(self._events), yaml.SequenceEndEvent):
                items.append(self.node(inner, depth + 1))
            return items
        tree: dict[str, Any] = {}
        while not isinstance(inner := next(self._events), yaml.MappingEndEvent):
            key = self.node(inner, depth + 1)
            if not isinstance(key, str):
                raise ValueError("YAML with a key that is no text")  # noqa: TRY004
            if key in tree:
                raise ValueError(f"YAML that has the key {plain(key)} twice")
            tree[key] = self.node(next(self._events), depth + 1)
        return tree
