"""The values of one parameter for N scenes: one for all of them, or one each."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


@dataclass(frozen=True, slots=True)
class Column:
    """The values of one parameter for N scenes.

    Only this class knows in which of its forms a parameter comes: functions of one value are
    applied by :meth:`map`, arithmetic is done on :attr:`values`, arrays are made by
    :meth:`broadcast`.

    Attributes
    ----------
    values
        The value of all scenes, or N values: an array of numbers, or a list of anything else.
    constant
        Whether all scenes share the value.

    Examples
    --------
    >>> Column.of(0.3).broadcast(2)
    array([0.3, 0.3])
    >>> Column.of(["exact", "warp"]).map(len).values
    [5, 4]
    >>> Column.of(None).broadcast(2)
    array([nan, nan])
    """

    values: Any
    constant: bool

    @staticmethod
    def of(values: Any) -> Column:
        """Return a column of N values (a list or an array), of one value, or as it is."""
        if isinstance(values, Column):
            return values
        # An array without dimensions is one number.
        constant = not isinstance(values, list) and getattr(values, "ndim", 0) == 0
        return Column(values, constant)

    @property
    def missing(self) -> bool:
        """Whether the parameter is not given: None for all scenes."""
        return self.constant and self.values is None

    def broadcast(self, count: int, dtype: DTypeLike = np.float64) -> NDArray[Any]:
        """Return a contiguous array (count,) of the values; None becomes NaN."""
        column = np.asarray(self.values, dtype=dtype)
        return np.ascontiguousarray(np.broadcast_to(column, (count,)))

    def listed(self, count: int) -> list[Any]:
        """Return the values as a list of ``count``."""
        if self.constant:
            return [self.values] * count
        each: list[Any] = (
            self.values.tolist() if isinstance(self.values, np.ndarray) else self.values
        )
        return each

    def map(self, function: Callable[[Any], Any]) -> Column:
        """Return the column of ``function`` of each value."""
        return map_columns(function, [self])

    def differs_from(self, value: Any) -> bool:
        """Return whether any scene has another value than ``value``."""
        if isinstance(self.values, np.ndarray):
            return bool(np.any(self.values != value))
        return any(each != value for each in ([self.values] if self.constant else self.values))


def map_columns(function: Callable[..., Any], columns: Sequence[Column]) -> Column:
    """Return the column of ``function`` of the values that each scene has in ``columns``.

    ``function`` is called once where all columns are constant.
    """
    if all(column.constant for column in columns):
        return Column(function(*(column.values for column in columns)), constant=True)
    rows = zip(
        *(
            itertools.repeat(column.values) if column.constant else column.listed(0)
            for column in columns
        ),
        strict=False,  # constants repeat without end
    )
    return Column([function(*row) for row in rows], constant=False)
