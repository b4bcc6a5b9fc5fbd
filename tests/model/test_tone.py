"""The response curve and bloom against closed forms; they keep the order of levels."""

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from support.exact_image import clipped_image, values
from support.small_scenes import image_of
from sweep.model.sensor import apply_tone

SLOPES = st.floats(-1, 1)
GAMMAS = st.floats(0.1, 10)
EXAMPLES = settings(derandomize=True, deadline=None, max_examples=40)


def cubics(share, gamma, toe, knee):
    """The response as two cubics, multiplied out, and a power; in 30 digits."""
    with mpmath.workdps(30):
        x, a, b = mpmath.mpf(share), mpmath.mpf(toe), mpmath.mpf(knee)
        if x < 0.5:
            y = (1 - a) * x + 4 * a * x**2 - 4 * a * x**3
        else:
            z = 1 - x
            y = 1 - ((1 - b) * z + 4 * b * z**2 - 4 * b * z**3)
        return mpmath.power(y, mpmath.mpf(gamma))


def toned(levels, gamma, toe, knee):
    levels = np.array(levels, dtype=float).reshape(1, -1)
    apply_tone(levels, gamma, toe, knee)
    return levels[0]


@EXAMPLES
@given(share=st.floats(0, 1), gamma=GAMMAS, toe=SLOPES, knee=SLOPES)
def test_response_is_its_closed_form(share, gamma, toe, knee):
    expected = float(255 * cubics(share, gamma, toe, knee))
    # A rounding of the power's base near 0 or 1 is multiplied by gamma, of at most 10.
    (level,) = toned([255 * share], gamma, toe, knee)
    assert level == pytest.approx(expected, rel=1e-13, abs=1e-13)


def test_neutral_response_is_the_identity_to_the_bit():
    levels = np.random.default_rng(3).uniform(0, 255, 1000)
    levels[:6] = 0.0, 255.0, 127.5, 1e-300, 254.99999999999997, 100.0
    # Division by 255 and multiplication round once each.
    np.testing.assert_allclose(toned(levels, 1.0, 0.0, 0.0), levels, rtol=2.3e-16)
    for neutral in (["tone_gamma=1"], ["tone_toe=0", "tone_knee=0"], ["bloom=0"]):
        np.testing.assert_array_equal(image_of(neutral), image_of())


@pytest.mark.parametrize("background", [0, 1, 37, 128, 200, 254, 255])
def test_image_has_the_response_to_each_level(background):
    for gamma, toe, knee in ((0.45, 0.0, 0.0), (1.0, 0.6, 0.4), (2.2, -0.5, 0.9)):
        image = image_of([
            f"background={background}", f"tone_gamma={gamma}", f"tone_toe={toe}",
            f"tone_knee={knee}", "distance_m=2",
        ])
        expected = float(255 * cubics(background / 255, gamma, toe, knee))
        assert image[0, 0] == np.floor(expected + 0.5)


# Bloom.


def test_bloom_is_the_term_in_share_times_the_rest():
    value = values(
        width_px=57, height_px=45, fx_px=80.0, size_m=0.1, distance_m=0.4, tilt_deg=35.0,
        azimuth_deg=70.0, roll_deg=25.0, black=30.3, white=221.7,
    )
    levels, share = clipped_image(value)
    sharp = levels + (1 - share) * 90.4
    for bloom in (0.3, -1.0, 1.0):
        bright = (sharp - 30.3) / (221.7 - 30.3)
        expected = 30.3 + (221.7 - 30.3) * (bright + bloom * bright * (1 - bright))
        assert np.abs(image_of([f"bloom={bloom}"]) - expected).max() <= 0.5 + 1e-6
    # White on black, exchanged: what is bright grows all the same.
    swapped = image_of(["black=221.7", "white=30.3", "bloom=0.3"]).astype(int)
    assert (swapped - image_of(["black=221.7", "white=30.3"]) >= 0).all()
    # Bloom comes before uneven light; both images are rounded.
    v, u = np.mgrid[:45, :57]
    fall_off = (1 + ((u - 28) ** 2 + (v - 22) ** 2) / 80**2) ** -1.5
    even = image_of(["bloom=0.5"])
    assert np.abs(image_of(["vignetting=3", "bloom=0.5"]) - fall_off * even).max() <= 1.0
