"""Sharpening: the exact image less one that is blurred more, against filters of finer images."""

import math

import cv2
import numpy as np
import pytest

from support.blurred import FineImage
from support.exact_image import values
from support.small_scenes import SMALL, image_of

ROUNDING = 0.5
"""Half a grey level: images are compared after quantisation."""

TOLERANCE = 0.35
"""Of the reference, which is off by up to 0.1 levels; two blurs are weighted 2 and 1."""


@pytest.mark.parametrize(("amount", "radius", "blur", "bearing_x"), [
    (1.0, 1.5, 0.6, 0.0), (-0.5, 2.0, 0.4, 15.0), (0.4, 0.7, 1.2, -22.0),
])
def test_sharpening_is_the_image_plus_its_difference_from_a_blurred_one(
    amount, radius, blur, bearing_x
):
    value = values(
        width_px=57, height_px=45, fx_px=80.0, size_m=0.1, distance_m=0.4, tilt_deg=35.0,
        azimuth_deg=70.0, roll_deg=25.0, black=30.3, white=221.7, background=90.4,
        bearing_x_deg=bearing_x,
    )
    fine = FineImage(value, 12)
    plain, wide = fine.seen(blur), fine.seen(math.hypot(blur, radius))
    expected = np.clip(plain + amount * (plain - wide), 0, 255)
    image = image_of([
        f"sharpening={amount}", f"sharpening_px={radius}", f"blur_px={blur}",
        f"bearing_x_deg={bearing_x}",
    ])
    assert np.abs(image - expected).max() <= ROUNDING + TOLERANCE
    # The effect is there: it moves levels by far more than the tolerance.
    assert np.abs(image - plain).max() > 4


def test_sharpening_leaves_the_noise_as_it_is_and_follows_gain_and_light():
    plain = "black=100", "white=140", "background=90", "blur_px=0.6"
    sharp = *plain, "sharpening=1", "sharpening_px=1.5"

    def image(*settings):
        return image_of(settings).astype(float)

    added = image(*sharp) - image(*plain)
    assert np.abs(added).max() > 5
    noisy = image(*sharp, "noise_grey=6") - image(*plain, "noise_grey=6")
    assert np.abs(noisy - added).max() <= 2  # four roundings
    brighter = image(*sharp, "gain=1.5") - image(*plain, "gain=1.5")
    assert np.abs(brighter - 1.5 * added).max() <= 2.5
    dark = image(*sharp, "vignetting=4") - image(*plain, "vignetting=4")
    v, u = np.mgrid[:45, :57]
    fall_off = (1 + ((u - 28) ** 2 + (v - 22) ** 2) / 80**2) ** -2
    assert np.abs(dark - fall_off * added).max() <= 2
    # Shot noise is that of the light, not of the overshoot: dark pixels stay at 0 electrons.
    shots = image(*sharp, "full_well_e=2000") - image(*plain, "full_well_e=2000")
    assert np.abs(shots - added).max() <= 2


def test_sharpening_over_a_background_image_acts_on_the_marker_alone(tmp_path):
    rng = np.random.default_rng(4)
    behind = rng.integers(60, 160, (45, 57)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "wall.png"), behind)
    settings = "sharpening=1", "sharpening_px=1.5", "blur_px=0.5", "distance_m=1.2"
    text = SMALL.replace("background = 90.4", f'background = "{tmp_path / "wall.png"}"')
    image = image_of(settings, text=text).astype(int)
    assert (image[:6] == behind[:6]).all()
    assert (image[-6:] == behind[-6:]).all()
