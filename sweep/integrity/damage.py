"""The kinds of damage that verification finds: to a file, an array, a block, a scene, the sample.

Each names its place in the store (``where``), what is wrong (``what``), and the number of the
block that it damages, None if it damages none. Repair acts by the kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class FileDamage:
    """A file that is missing, changed or unreadable.

    Examples
    --------
    >>> damage = FileDamage("detection/c/0/0", "missing", block=0)
    >>> as_json(damage)
    {'where': 'detection/c/0/0', 'what': 'missing', 'block': 0}
    """

    key: str
    what: str
    block: int | None = None

    @property
    def where(self) -> str:
        """The file's key."""
        return self.key


@dataclass(frozen=True, slots=True)
class ArrayDamage:
    """An array that is missing, foreign, or whose metadata or values do not fit the pipeline."""

    path: str
    what: str

    @property
    def where(self) -> str:
        """The array's path."""
        return self.path

    @property
    def block(self) -> None:
        """None: blocks hold none of its files."""
        return


@dataclass(frozen=True, slots=True)
class BlockDamage:
    """A block whose files fit their checksums and whose flags and numbers contradict each other."""

    block: int
    name: str
    what: str

    @property
    def where(self) -> str:
        """The block's name."""
        return f"block {self.name}"


@dataclass(frozen=True, slots=True)
class SceneDamage:
    """A scene that gives other values when it is recomputed."""

    at: str
    what: str
    block: int

    @property
    def where(self) -> str:
        """The scene's coordinates, as ``sweep repro`` takes them."""
        return f"--at {self.at}"


@dataclass(frozen=True, slots=True)
class SampleDamage:
    """A sample of which too many scenes differ; recomputing a block does not repair it."""

    what: str

    @property
    def where(self) -> str:
        """The word for it in lists of damage."""
        return "sample"

    @property
    def block(self) -> None:
        """None: it cannot be attributed to a block."""
        return


Damage = FileDamage | ArrayDamage | BlockDamage | SceneDamage | SampleDamage


def as_json(damage: Damage) -> dict[str, Any]:
    """Return a damage as ``sweep verify --json`` prints it."""
    return {"where": damage.where, "what": damage.what, "block": damage.block}
