"""The markers of boards as poses of their own: for rates and corners of each marker."""

from __future__ import annotations

import xarray as xr

from sweep.errors import DatasetError

AXIS = "board_marker"
"""The dimension of a board's markers where they are an axis."""

OF_MARKERS = {"marker_detection": "detection", "marker_corner_error_px": "corner_error_px"}
"""Variable of boards -> its name where the markers are an axis."""

OF_TARGETS = ("true_rvec", "true_tvec_m")
"""Variables of the whole board that hold for each of its markers, too."""


def per_marker(results: xr.Dataset) -> xr.Dataset:
    """Return the detections of a board's markers, each marker on its own.

    Parameters
    ----------
    results
        The dataset of a run whose scenes show boards.

    Returns
    -------
    xr.Dataset
        The markers are the axis ``board_marker``, numbered in reading order from 0 on; lazy if
        ``results`` is.

        - ``detection``: the flags of each marker, ``not_on_board`` (which no rate counts) where a
          scene's board has fewer markers than another's.
        - ``corner_error_px``: found corner minus true corner of the detected ones.
        - ``board_marker_id``, and ``true_rvec`` and ``true_tvec_m`` of the board.

        Estimates are the board's and are left out, as are bounds and the area.

    Raises
    ------
    DatasetError
        If the scenes show no boards.

    Notes
    -----
    Markers of one image see the same draws. Where they are pooled they count as one draw, as
    settings do (`sweep.analysis.layout`), so that intervals of rates over all markers are right
    however much neighbours fail together.

    Examples
    --------
    >>> twice = xr.concat([results["detection"]] * 2, dim="marker").transpose(..., "marker")
    >>> markers = per_marker(results.assign(marker_detection=twice))
    >>> markers["detection"].dims[-1], markers["detection"].sizes["board_marker"]
    ('board_marker', 2)
    """
    if "marker_detection" not in results:
        raise DatasetError("no variable marker_detection: the scenes show no boards")
    kept = [name for name in (*OF_TARGETS, "board_marker_id", *OF_MARKERS) if name in results]
    markers = results[kept].rename({
        "marker": AXIS, **{name: new for name, new in OF_MARKERS.items() if name in kept}
    })
    return markers.transpose(..., *(
        dim for dim in ("corner", "xy", "xyz") if dim in markers.dims))
