"""The declared experiment: pipeline file, axes, validation, random streams, dataset template."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

#: Returns a line for each fault of requirements and of the names of precisions. What has an
#: interval is known to the analysis, a room above this one: `sweep` gives its function.
quantity_faults: Callable[[Sequence[str], Collection[str]], Sequence[str]]
