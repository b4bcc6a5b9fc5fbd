"""Arrays whose first axis runs over groups of poses: several put together, some cells among all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.typing import Integers, Masks


def interleaved(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return n arrays (groups, ...) as one (groups * n, ...), the n values of a group together.

    Examples
    --------
    >>> interleaved([np.array([1, 2]), np.array([10, 20])]).tolist()
    [1, 10, 2, 20]
    """
    stacked = np.stack(arrays, axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])


def scattered(array: NDArray[Any], where: Masks, fill: float = 0.0) -> NDArray[Any]:
    """Return an array (groups, some cells) as one of all cells, ``fill`` for the others.

    Examples
    --------
    >>> scattered(np.array([[1, 2]]), np.array([True, False, True])).tolist()
    [[1, 0, 2]]
    """
    whole = np.full((len(array), len(where)), fill, dtype=array.dtype)
    whole[:, where] = array
    return whole


def group_numbers(array: NDArray[Any]) -> Integers:
    """Return the group of each element of (groups, ...)."""
    numbers = np.arange(len(array)).reshape(-1, *[1] * (array.ndim - 1))
    return np.broadcast_to(numbers, array.shape)


MAX_SLICES = 8
"""Settings up to which they are summed one by one: below 8 NumPy adds in the same order."""


def sum_of_settings(array: NDArray[Any]) -> NDArray[Any]:
    """Return the sums over the last axis of (groups, cells, draws, settings), bit for bit.

    NumPy's loop along a short last axis takes three times as long.

    Examples
    --------
    >>> sum_of_settings(np.array([[[[True, True], [False, True]]]])).tolist()
    [[[2, 1]]]
    """
    if not 0 < array.shape[3] < MAX_SLICES:
        return np.asarray(array.sum(axis=3))
    total = array[..., 0].astype(np.int64 if array.dtype.kind == "b" else array.dtype)
    for k in range(1, array.shape[3]):
        total += array[..., k]
    return total
