"""Flags in words: the labels that a dataset's attributes give to the values of its flags."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from sweep.errors import ArgumentError

UNKNOWN = "unknown"
"""Label of a value that the attributes do not name."""

UNNAMED = 255
"""Where a table of labels has :data:`UNKNOWN`: flags are stored as uint8, and none has so many."""

Labelled = TypeVar("Labelled", xr.Dataset, xr.DataArray)


def decode_flags(results: Labelled) -> Labelled:
    """Return results with every flag in words: ``"detected"`` in place of 1.

    Parameters
    ----------
    results
        A dataset or one of its variables, or any part of them. Variables without the attributes
        ``flag_values`` and ``flag_meanings`` (CF conventions, 3.5) stay as they are.

    Returns
    -------
    The same, lazy where it was. Flags are strings; cells without a value (NaN, as after ``where``)
    are ``not_run``, the meaning of the fill value 0; what is no flag's value, such as a mean of
    flags, is ``unknown``.

    Raises
    ------
    ArgumentError
        For what is no dataset and no variable of one.

    Examples
    --------
    >>> flags = xr.DataArray([1, 0], attrs={
    ...     "flag_values": [0, 1], "flag_meanings": "not_run detected"})
    >>> decode_flags(flags).values.tolist()
    ['detected', 'not_run']
    """
    if isinstance(results, xr.DataArray):
        return _decoded(results)
    if not isinstance(results, xr.Dataset):
        raise ArgumentError(
            "results", type(results).__name__,
            "expected a dataset, as sweep.open returns it, or a variable of one",
        )
    return results.assign({  # without its coordinates, which are those of the results
        name: _decoded(variable).variable for name, variable in results.data_vars.items()
    })


def _decoded(variable: xr.DataArray) -> xr.DataArray:
    attributes = dict(variable.attrs)
    meanings = str(attributes.pop("flag_meanings", "")).split()
    values = np.atleast_1d(np.asarray(attributes.pop("flag_values", [])))
    if not meanings or len(meanings) != len(values) or variable.dtype.kind not in "uif":
        return variable
    labels = np.full(256, UNKNOWN, dtype=f"U{max(map(len, (*meanings, UNKNOWN)))}")
    labels[values.astype(np.intp)] = meanings

    def look_up(flags: NDArray[Any]) -> NDArray[Any]:
        known = np.nan_to_num(flags, nan=0.0) if flags.dtype.kind == "f" else np.asarray(flags)
        index = np.clip(known, 0, UNNAMED).astype(np.uint8)
        return labels[np.where(index == known, index, UNNAMED)]

    words: xr.DataArray = xr.apply_ufunc(
        look_up, variable, dask="parallelized", output_dtypes=[labels.dtype]
    )
    words.attrs = attributes
    return words
