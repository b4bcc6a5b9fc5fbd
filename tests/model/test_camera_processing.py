"""JPEG, demosaicing, and all effects of the camera's processing together: windows, extremes."""

from functools import cache

import cv2
import numpy as np
import pytest

from support.blocks import run_cells
from support.exact_image import clipped_image, values
from support.lengths import lengths
from support.small_scenes import SMALL, image_of, scenes_of
from sweep.evaluation.search import search_windows
from sweep.experiment.pipeline import Pipeline
from sweep.measure.detectors import DetectorSetting
from sweep.measure.flags import BoundStatus
from sweep.model.exposure import marker_boxes
from sweep.model.sensor import compressed

EVERYTHING = [
    "blur_px=0.6", "sharpening=1", "sharpening_px=1.5", "bloom=0.2", "tone_gamma=0.8",
    "tone_toe=0.3", "tone_knee=0.4", "noise_grey=2", "noise_correlation=0.5",
    "noise_table=[0, 3, 255, 1]", "bayer=GRBG", "demosaic=edge_aware", "bayer_red=0.9",
    "bayer_blue=1.1", "jpeg_quality=60",
]


@cache
def exact_levels():
    """The levels of SMALL by polygon clipping."""
    levels, share = clipped_image(values(
        width_px=57, height_px=45, fx_px=80.0, size_m=0.1, distance_m=0.4, tilt_deg=35.0,
        azimuth_deg=70.0, roll_deg=25.0, black=30.3, white=221.7,
    ))
    return levels + (1 - share) * 90.4


# JPEG.

@pytest.mark.parametrize("quality", [1, 50, 100])
def test_jpeg_is_opencvs_encoder_on_the_whole_frame(quality):
    plain = image_of(["noise_grey=5"])
    done, code = cv2.imencode(".jpg", plain, [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    expected = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
    image = image_of(["noise_grey=5", f"jpeg_quality={quality}"])
    np.testing.assert_array_equal(image, expected)
    # 57 and 45 px are no multiples of 8: so are the windows' ends.
    left, top, right, bottom = marker_boxes(
        scenes_of(["noise_grey=5", f"jpeg_quality={quality}"])
    )[0].tolist()
    for window in ((left, top, right, bottom), (left, top, 57, 45), (left - 3, 0, 55, bottom + 1)):
        a, b, c, d = window
        part = image_of(["noise_grey=5", f"jpeg_quality={quality}"], window)
        np.testing.assert_array_equal(part, expected[b:d, a:c])


def test_images_larger_than_jpeg_are_compressed_in_parts():
    rng = np.random.default_rng(8)
    image = rng.integers(0, 256, (9, 70_001)).astype(np.uint8)
    parts_of_it = [
        cv2.imdecode(
            cv2.imencode(".jpg", piece, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], cv2.IMREAD_GRAYSCALE
        )
        for piece in (image[:, :40_000], image[:, 40_000:])
    ]
    np.testing.assert_array_equal(compressed(image, 70), np.concatenate(parts_of_it, axis=1))


# Demosaicing.

def mosaic_of(levels, pattern, gains):
    """The raw image, pixel by pixel, in 16 bits."""
    raw = np.empty(levels.shape, dtype=np.uint16)
    for v, u in np.ndindex(levels.shape):
        gain = gains[pattern[2 * (v % 2) + u % 2]]
        raw[v, u] = min(max(np.floor(gain * levels[v, u] * 257 + 0.5), 0), 65535)
    return raw


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize("method", ["bilinear", "edge_aware"])
def test_demosaicing_is_opencvs_on_the_whole_frame(pattern, method):
    settings = [f"bayer={pattern}", f"demosaic={method}", "bayer_red=0.7"]
    raw = mosaic_of(exact_levels(), pattern, {"R": 0.7, "G": 1.0, "B": 1.0})
    ending = "" if method == "bilinear" else "_EA"
    colour = cv2.cvtColor(raw, getattr(cv2, f"COLOR_Bayer{pattern}2BGR{ending}"))
    expected = colour @ np.array([0.114, 0.587, 0.299]) / 257
    image = image_of(settings)
    # Quantisation, and a unit of 16 bits of OpenCV's grey and of the levels in `raw`.
    assert np.abs(image - expected).max() <= 0.5 + 0.02


# Windows.

COMBINATIONS = {
    "all": EVERYTHING,
    "sharpening": ["sharpening=2", "sharpening_px=3"],
    "wide sharpening": ["sharpening=1", "sharpening_px=20", "noise_grey=3"],
    "correlated": ["noise_grey=9", "noise_correlation=0.99", "noise_table=[0, 9, 255, 1]"],
    "bayer and JPEG": ["bayer=BGGR", "full_well_e=900", "jpeg_quality=1"],
    "tone and light": ["tone_gamma=2.2", "vignetting=4", "illumination_gradient=0.5", "bloom=1"],
    "fine bits": ["tone_knee=1", "bit_depth=12", "sharpening=0.5", "gain=1.4"],
    "defocus": ["aperture_mm=9", "focus_distance_m=0.5", "sharpening=1", "tone_toe=0.5"],
    "bent sheet": [
        "curvature_per_m=4", "geometry_px=0.5", "marker_scale=1.1", "sharpening=1", "bayer=RGGB",
        "jpeg_quality=40",
    ],
    "warp": ["renderer=warp", "distortion=[-0.3, 0.1, 0, 0]"],
    "samples": ["renderer=supersample-2-jittered", "distortion=[-0.3, 0.1, 0, 0]"],
    "motion": ["exposure_s=0.01", "velocity_x_m_s=2", "row_time_s=1e-4", "sharpening=1"],
}


@pytest.mark.parametrize("name", COMBINATIONS)
@lengths(2, 20)
def test_window_has_the_pixels_of_the_whole_frame(count, name):
    rng = np.random.default_rng(12)
    for trial in range(count):
        settings = [
            *COMBINATIONS[name], f"distance_m={rng.uniform(0.5, 2)}",
            f"bearing_x_deg={rng.uniform(-20, 20)}", f"bearing_y_deg={rng.uniform(-15, 15)}",
            f"seed={trial}",
        ]
        scenes = scenes_of(settings)
        box = marker_boxes(scenes)[0]
        frame = image_of(settings)
        for _ in range(3):
            left, top = (rng.integers(0, box[:2] + 1)).tolist()
            right, bottom = rng.integers(box[2:], np.array([57, 45]) + 1).tolist()
            if right <= left or bottom <= top:
                continue
            image = image_of(settings, (left, top, right, bottom))
            np.testing.assert_array_equal(image, frame[top:bottom, left:right])


# What follows from the declarations.

def test_effects_are_axes_and_distributions_and_the_bound_says_that_it_lacks_them():
    text = SMALL + """bound = "known_blur"
noise_grey = 2
tone_toe = { uniform = [0.1, 0.5] }
[axes]
jpeg_quality = [0, 40]
noise_table = [[], [0, 2, 255, 1]]
"""
    pipeline = Pipeline.from_text(text)
    cells = run_cells(pipeline, [index.ravel() for index in np.indices((2, 2))])
    assert (np.asarray(cells.columns["bound"][0]) == BoundStatus.not_in_model).all()


def test_coarse_noise_is_searched_in_wider_windows_and_steep_light_on_whole_frames():
    setting = DetectorSetting()
    wide = ["width_px=900", "height_px=700", "distance_m=0.9"]

    def left_of(*settings):
        scenes = scenes_of([*wide, *settings])
        (window,) = search_windows(scenes, marker_boxes(scenes), setting, np.array([False]))
        return int(window[0])

    plain, noisy = left_of(), left_of("noise_grey=3")
    assert plain - noisy == 32
    assert plain - left_of("noise_grey=3", "noise_correlation=0.5") == 64
    assert plain - left_of("noise_table=[0, 3]", "noise_correlation=0.5") == 64
    # Without noise nothing is made coarse; blocks begin at multiples of 8.
    assert 0 <= plain - left_of("jpeg_quality=50") <= 8
    assert 64 <= plain - left_of("jpeg_quality=50", "noise_grey=3") <= 72
    assert left_of("vignetting=4") == plain
    for steep in ("tone_gamma=0.5", "tone_toe=0.5", "tone_knee=0.5", "jpeg_quality=9"):
        assert left_of("vignetting=4", steep) == 0
    # Bloom acts before the light's slope, on a background of one level.
    assert left_of("vignetting=4", "bloom=0.5") == plain
    assert left_of("tone_gamma=0.5") == plain
