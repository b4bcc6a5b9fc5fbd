"""Which plug-ins are installed, and what one declares."""

from __future__ import annotations

import importlib.metadata

from sweep.errors import ArgumentError, PluginError
from sweep.messages import nearest
from sweep.plugins import RECORDS
from sweep.plugins.declared import DeclaredPlugin, declare
from sweep.plugins.loading import file_of, group_of


def installed() -> list[dict[str, str]]:
    """Return kind, name and distribution of each installed plug-in; none is imported."""
    return [
        {"kind": kind, "name": name, "distribution": distribution}
        for kind in RECORDS
        for name, distribution in sorted({
            (entry.name, entry.dist.name if entry.dist else "")
            for entry in importlib.metadata.entry_points(group=group_of(kind))
        })
    ]


def described(name: str) -> list[DeclaredPlugin]:
    """Import the plug-ins of a name, of whichever kinds, and return what they declare.

    Raises
    ------
    ArgumentError
        If there is none, or one cannot be used.
    """
    listed = installed()
    kinds = [each["kind"] for each in listed if each["name"] == name]
    if file_of(name) is None and not kinds:
        hint = nearest(name, [each["name"] for each in listed]) or "; `sweep plugins` lists them"
        raise ArgumentError("name", name, f"no such plug-in{hint}")
    found, faults = [], []
    for kind in kinds or RECORDS:
        try:
            found.append(declare(kind, name, "."))
        except PluginError as error:
            faults.append(str(error))
    if not found or (kinds and faults):
        raise ArgumentError("name", name, f"expected {faults[0]}")
    return found
