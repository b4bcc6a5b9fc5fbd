"""Rates and corners of the markers of boards, against plain NumPy."""

import numpy as np
import pytest
import xarray as xr

from sweep.analysis import (
    detection_rate,
    per_marker,
    renderer_bias,
    store_differences,
)
from sweep.measure.flags import DetectionStatus, uncounted_values


def _boards() -> xr.Dataset:
    """Return 2 sizes x 30 draws of boards of 3 markers, the first size with 2 of them."""
    rng = np.random.default_rng(4)
    flags = rng.choice(
        [DetectionStatus.detected, DetectionStatus.rejected, DetectionStatus.not_visible],
        size=(2, 30, 3), p=[0.6, 0.3, 0.1],
    ).astype(np.uint8)
    flags[0, :, 2] = DetectionStatus.not_on_board
    errors = rng.normal(size=(2, 30, 3, 4, 2)).astype(np.float32)
    errors[flags != DetectionStatus.detected] = np.nan
    scene = ("size_m", "trial")
    return xr.Dataset(
        {
            "true_tvec_m": ((*scene, "xyz"), np.ones((2, 30, 3))),
            "detection": (scene, flags.min(axis=2)),
            "marker_detection": ((*scene, "marker"), flags),
            "marker_corner_error_px": ((*scene, "marker", "corner", "xy"), errors),
            "board_marker_id": ((*scene, "marker"), np.tile(np.float32([4, 5, 6]), (2, 30, 1))),
        },
        {"size_m": [0.02, 0.04], "trial": np.arange(30), "marker": np.arange(3)},
    )


def test_rates_of_markers_count_those_that_are_on_the_board_and_visible() -> None:
    boards = _boards()
    flags = boards["marker_detection"].to_numpy()
    markers = per_marker(boards)
    counted = ~np.isin(flags, uncounted_values(DetectionStatus))
    table = detection_rate(markers, per=["size_m", "board_marker"])
    np.testing.assert_array_equal(table["looked_for"], counted.sum(axis=1))
    np.testing.assert_array_equal(table["detected"], (flags == 1).sum(axis=1))
    assert np.isnan(table["detection_rate"].sel(size_m=0.02, board_marker=2))
    pooled = detection_rate(markers)
    assert pooled["looked_for"] == counted.sum()
    assert pooled["draws"] <= 60, "markers of one image are one draw at most"
    by_id = detection_rate(markers, bins={"board_marker_id": [4, 5, 7]})
    assert by_id["looked_for"].values.tolist() == [counted[..., 0].sum(), counted[..., 1:].sum()]
    squares = np.nanmean(boards["marker_corner_error_px"].to_numpy() ** 2, axis=(0, 1, 3, 4))
    found = (markers["corner_error_px"] ** 2).mean(["size_m", "trial", "corner", "xy"])
    np.testing.assert_allclose(found, squares, rtol=1e-5)


def test_corners_of_boards_are_paired_where_both_found_them() -> None:
    rng = np.random.default_rng(7)
    names = ["exact", "other"]
    boards = xr.concat([_boards(), _boards()], dim="renderer").assign_coords(renderer=names)
    errors = boards["marker_corner_error_px"].to_numpy()
    errors[1] += rng.normal(scale=0.1, size=errors[1].shape).astype(np.float32)
    errors[1][rng.random(errors.shape[1:4]) < 0.3] = np.nan  # markers that the second lost
    errors[1, :, :5] = errors[0, :, :5]
    solved = boards["detection"].to_numpy() == DetectionStatus.detected
    zeros = np.zeros((*solved.shape, 3), dtype=np.float32)
    dims = boards["detection"].dims
    made = boards.assign(
        estimate=(dims, solved.astype(np.uint8)), flipped=(dims, solved.astype(np.uint8)),
        rotation_error_rad=((*dims, "xyz"), zeros), translation_error_m=((*dims, "xyz"), zeros),
    )
    table = renderer_bias(made)
    shift = np.square(errors[1].astype(float) - errors[0])
    found = np.isfinite(shift).any(axis=(2, 3, 4)) & solved[0]
    each = np.nanmean(shift[found], axis=(1, 2, 3))
    other = table.sel(renderer="other")
    assert other["corner_shift_rms_px"] == pytest.approx(np.sqrt(each.mean()), rel=1e-9)
    table = store_differences(*(made.sel(renderer=name, drop=True) for name in names))
    found = [np.isfinite(each).all(axis=-1) for each in errors]
    assert table["corners_compared"] == (found[0] & found[1]).sum()
    assert table["corners_found_once"] == (found[0] ^ found[1]).sum()
    assert table["corners_differing"] == (
        (errors[0] != errors[1]).any(axis=-1) & found[0] & found[1]).sum()
