"""Tone, bloom, sharpening, JPEG and demosaicing, each against a reference; together in windows."""

import math
from functools import cache

import cv2
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.blurred import FineImage
from support.exact_image import clipped_image, values
from support.lengths import lengths
from support.small_scenes import SMALL, image_of, scenes_of
from sweep.evaluation.search import search_windows
from sweep.measure.detectors import DetectorSetting
from sweep.model.exposure import marker_boxes
from sweep.model.sensor import apply_tone, compressed

VALUE = values(
    width_px=57, height_px=45, fx_px=80.0, size_m=0.1, distance_m=0.4, tilt_deg=35.0,
    azimuth_deg=70.0, roll_deg=25.0, black=30.3, white=221.7, background=90.4,
)
"""The scene of `support.small_scenes`, for the references."""


@cache
def exact_levels():
    """The levels of the scene by polygon clipping."""
    levels, share = clipped_image(VALUE)
    return levels + (1 - share) * 90.4


def light_of(power):
    """The fall-off of light towards the frame's edges, cosines to a power."""
    v, u = np.mgrid[:45, :57]
    return (1 + ((u - 28) ** 2 + (v - 22) ** 2) / 80**2) ** (-power / 2)


# The response curve, and bloom.

def cubics(share, gamma, toe, knee):
    """The response as two cubics, multiplied out, and a power; in 30 digits."""
    with mpmath.workdps(30):
        x, a, b = mpmath.mpf(share), mpmath.mpf(toe), mpmath.mpf(knee)
        if x < 0.5:
            y = (1 - a) * x + 4 * a * x**2 - 4 * a * x**3
        else:
            z = 1 - x
            y = 1 - ((1 - b) * z + 4 * b * z**2 - 4 * b * z**3)
        return float(255 * mpmath.power(y, mpmath.mpf(gamma)))


@settings(derandomize=True, deadline=None, max_examples=40)
@given(share=st.floats(0, 1), gamma=st.floats(0.1, 10), toe=st.floats(-1, 1), knee=st.floats(-1, 1))
def test_response_is_its_closed_form(share, gamma, toe, knee):
    level = np.array([[255 * share]])
    apply_tone(level, gamma, toe, knee)
    # A rounding of the power's base near 0 or 1 is multiplied by gamma, of at most 10.
    assert level[0, 0] == pytest.approx(cubics(share, gamma, toe, knee), rel=1e-13, abs=1e-13)


@pytest.mark.parametrize("background", [0, 1, 37, 128, 200, 254, 255])
def test_image_has_the_response_to_each_level(background):
    for gamma, toe, knee in ((0.45, 0.0, 0.0), (1.0, 0.6, 0.4), (2.2, -0.5, 0.9), (1, 0, 0)):
        image = image_of([
            f"background={background}", f"tone_gamma={gamma}", f"tone_toe={toe}",
            f"tone_knee={knee}", "distance_m=2",
        ])
        assert image[0, 0] == np.floor(cubics(background / 255, gamma, toe, knee) + 0.5)


def test_bloom_is_the_term_in_share_times_the_rest():
    for bloom in (0.3, -1.0, 1.0, 0.0):
        bright = (exact_levels() - 30.3) / (221.7 - 30.3)
        expected = 30.3 + (221.7 - 30.3) * (bright + bloom * bright * (1 - bright))
        assert np.abs(image_of([f"bloom={bloom}"]) - expected).max() <= 0.5 + 1e-6
    # White on black, exchanged: what is bright grows all the same.
    swapped = image_of(["black=221.7", "white=30.3", "bloom=0.3"]).astype(int)
    assert (swapped - image_of(["black=221.7", "white=30.3"]) >= 0).all()
    # Bloom comes before uneven light; both images are rounded.
    dark, even = (image_of(["bloom=0.5", f"vignetting={power}"]) for power in (3, 0))
    assert np.abs(dark - light_of(3) * even).max() <= 1.0


# Sharpening.

@pytest.mark.parametrize(("amount", "radius", "blur", "bearing_x"), [
    (1.0, 1.5, 0.6, 0.0), (-0.5, 2.0, 0.4, 15.0), (0.4, 0.7, 1.2, -22.0),
])
def test_sharpening_is_the_image_plus_its_difference_from_a_blurred_one(
    amount, radius, blur, bearing_x
):
    fine = FineImage(VALUE | {"bearing_x_deg": bearing_x}, 12)
    plain, wide = fine.seen(blur), fine.seen(math.hypot(blur, radius))
    expected = np.clip(plain + amount * (plain - wide), 0, 255)
    image = image_of([
        f"sharpening={amount}", f"sharpening_px={radius}", f"blur_px={blur}",
        f"bearing_x_deg={bearing_x}",
    ])
    # Quantisation; the reference is off by up to 0.1 levels, two blurs are weighted 2 and 1.
    assert np.abs(image - expected).max() <= 0.5 + 0.35
    # The effect is there: it moves levels by far more than the tolerance.
    assert np.abs(image - plain).max() > 4


@pytest.mark.parametrize(("other", "factor", "tolerance"), [
    ("noise_grey=6", 1.0, 2.0),  # four roundings
    ("gain=1.5", 1.5, 2.5), ("vignetting=4", light_of(4), 2.0),
    # Shot noise is that of the light, not of the overshoot: dark pixels stay at 0 electrons.
    ("full_well_e=2000", 1.0, 2.0),
])
def test_sharpening_leaves_the_noise_as_it_is_and_follows_gain_and_light(other, factor, tolerance):
    plain = ["black=100", "white=140", "background=90", "blur_px=0.6"]

    def added(*settings):
        sharp, blurred = (image_of([*plain, *more, *settings]).astype(float)
                          for more in (["sharpening=1", "sharpening_px=1.5"], []))
        return sharp - blurred

    assert np.abs(added()).max() > 5
    assert np.abs(added(other) - factor * added()).max() <= tolerance


def test_sharpening_over_a_background_image_acts_on_the_marker_alone(tmp_path):
    behind = np.random.default_rng(4).integers(60, 160, (45, 57)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "wall.png"), behind)
    text = SMALL.replace("background = 90.4", f'background = "{tmp_path / "wall.png"}"')
    image = image_of(["sharpening=1", "blur_px=0.5", "distance_m=1.2"], text=text)
    np.testing.assert_array_equal(image[[*range(6), *range(-6, 0)]],
                                  behind[[*range(6), *range(-6, 0)]])


# JPEG and demosaicing, of whole frames.

@pytest.mark.parametrize("quality", [1, 50, 100])
def test_jpeg_is_opencvs_encoder_on_the_whole_frame(quality):
    done, code = cv2.imencode(
        ".jpg", image_of(["noise_grey=5"]), [cv2.IMWRITE_JPEG_QUALITY, quality])
    assert done
    expected = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
    # 57 and 45 px are no multiples of 8: so are the windows' ends.
    settings = ["noise_grey=5", f"jpeg_quality={quality}"]
    left, top, right, bottom = marker_boxes(scenes_of(settings))[0].tolist()
    for a, b, c, d in ((0, 0, 57, 45), (left, top, right, bottom), (left, top, 57, 45),
                       (left - 3, 0, 55, bottom + 1)):
        np.testing.assert_array_equal(image_of(settings, (a, b, c, d)), expected[b:d, a:c])


def test_images_larger_than_jpeg_are_compressed_in_parts():
    image = np.random.default_rng(8).integers(0, 256, (9, 70_001)).astype(np.uint8)
    parts = [
        cv2.imdecode(
            cv2.imencode(".jpg", piece, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], cv2.IMREAD_GRAYSCALE
        )
        for piece in (image[:, :40_000], image[:, 40_000:])
    ]
    np.testing.assert_array_equal(compressed(image, 70), np.concatenate(parts, axis=1))


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
@pytest.mark.parametrize(("method", "ending"), [("bilinear", ""), ("edge_aware", "_EA")])
def test_demosaicing_is_opencvs_on_the_whole_frame(pattern, method, ending):
    levels, gains = exact_levels(), {"R": 0.7, "G": 1.0, "B": 1.0}
    raw = np.empty(levels.shape, dtype=np.uint16)
    for v, u in np.ndindex(levels.shape):
        gain = gains[pattern[2 * (v % 2) + u % 2]]
        raw[v, u] = min(max(np.floor(gain * levels[v, u] * 257 + 0.5), 0), 65535)
    colour = cv2.cvtColor(raw, getattr(cv2, f"COLOR_Bayer{pattern}2BGR{ending}"))
    expected = colour @ np.array([0.114, 0.587, 0.299]) / 257
    image = image_of([f"bayer={pattern}", f"demosaic={method}", "bayer_red=0.7"])
    # Quantisation, and a unit of 16 bits of OpenCV's grey and of the levels in `raw`.
    assert np.abs(image - expected).max() <= 0.5 + 0.02


def test_pixels_of_a_larger_image_are_displaced_along_both_axes():
    # Pixel i is number floor(5 i / 3): at 0, 1 and 3 of 5, 0.2 px right, 0.2 px left and in place.
    def seen(*settings):
        return image_of(["blur_px=0.8", *settings]).astype(float)

    expected, moved = seen(), (0.2, -0.2, 0.0)
    for i, j in np.ndindex(3, 3):
        at = seen(f"cx_px={28 - moved[j]}", f"cy_px={22 - moved[i]}")
        expected[i::3, j::3] = at[i::3, j::3]
    assert np.abs(seen("decimation=1.667") - expected).max() <= 1.5
    assert np.abs(seen() - expected).max() > 12
    np.testing.assert_array_equal(seen("decimation=2"), seen())


# Windows.

COMBINATIONS = {
    "all": [
        "blur_px=0.6", "sharpening=1", "sharpening_px=1.5", "bloom=0.2", "tone_gamma=0.8",
        "tone_toe=0.3", "tone_knee=0.4", "noise_grey=2", "noise_correlation=0.5",
        "noise_table=[0, 3, 255, 1]", "bayer=GRBG", "demosaic=edge_aware", "bayer_red=0.9",
        "bayer_blue=1.1", "jpeg_quality=60",
    ],
    "wide sharpening": ["sharpening=1", "sharpening_px=20", "noise_grey=3"],
    "correlated": ["noise_grey=9", "noise_correlation=0.99", "noise_table=[0, 9, 255, 1]"],
    "bayer and JPEG": ["bayer=BGGR", "full_well_e=900", "jpeg_quality=1"],
    "tone and light": ["tone_gamma=2.2", "vignetting=4", "illumination_gradient=0.5", "bloom=1"],
    "fine bits": ["tone_knee=1", "bit_depth=12", "sharpening=0.5", "gain=1.4", "decimation=1.4"],
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
@lengths(1, 20)
def test_window_has_the_pixels_of_the_whole_frame(count, name):
    rng = np.random.default_rng(12)
    for trial in range(count):
        settings = [
            *COMBINATIONS[name], f"distance_m={rng.uniform(0.5, 2)}",
            f"bearing_x_deg={rng.uniform(-20, 20)}", f"bearing_y_deg={rng.uniform(-15, 15)}",
            f"seed={trial}",
        ]
        box, frame = marker_boxes(scenes_of(settings))[0], image_of(settings)
        for _ in range(3):
            left, top = (rng.integers(0, box[:2] + 1)).tolist()
            right, bottom = rng.integers(box[2:], np.array([57, 45]) + 1).tolist()
            if right > left and bottom > top:
                image = image_of(settings, (left, top, right, bottom))
                np.testing.assert_array_equal(image, frame[top:bottom, left:right])


WHOLE = (math.inf, math.inf)
WIDER = {
    "noise_grey=3": (32, 32), "noise_grey=3 noise_correlation=0.5": (64, 64),
    "noise_table=[0,3] noise_correlation=0.5": (64, 64),
    # Without noise nothing is made coarse; blocks begin at multiples of 8.
    "jpeg_quality=50": (0, 8), "jpeg_quality=50 noise_grey=3": (64, 72),
    # What grows steep light, on whole frames; bloom acts before the light, on one level.
    "vignetting=4": (0, 0), "vignetting=4 bloom=0.5": (0, 0), "tone_gamma=0.5": (0, 0),
    **{f"vignetting=4 {steep}": WHOLE
       for steep in ("tone_gamma=0.5", "tone_toe=0.5", "tone_knee=0.5", "jpeg_quality=9")},
}
"""By how many pixels, least and most, settings widen windows to the left."""


@pytest.mark.parametrize("settings", WIDER)
def test_windows_are_wider_for_coarse_noise_and_whole_frames_for_steep_light(settings):
    def left_of(*settings):
        scenes = scenes_of(["width_px=900", "height_px=700", "distance_m=0.9", *settings])
        (window,) = search_windows(
            scenes, marker_boxes(scenes), DetectorSetting(), np.array([False]))
        return int(window[0])

    plain, (least, most) = left_of(), WIDER[settings]
    assert plain - min(most, plain) <= left_of(*settings.split()) <= plain - min(least, plain)
