"""Noise, its statistics and what it depends on; quantisation.

Every draw is seeded. Statistical tests pass a correct sensor with a probability of 1 - 1e-6 or
more each.
"""

import itertools

import numba
import numpy as np
import pytest
from scipy import stats

from support.lengths import lengths
from sweep.experiment.pipeline import Pipeline
from sweep.model import sensor
from sweep.model.exposure import marker_boxes
from sweep.model.renderers import marker_levels, render_all
from sweep.model.scene import build_scenes

UNLIKELY = 1e-6
FAR = 5.5
"""Standard deviations that a normal number exceeds with a probability of 4e-8."""


# A frame of one level: its marker is 8 px in the middle, and left out.


def scenes_of(pipeline, trial=0):
    axes = pipeline.experiment.scene_axes
    return build_scenes(pipeline.experiment.scene_values([np.array([trial])] * len(axes)), 1)


def image_of(pipeline, trial=0, window=None):
    scenes = scenes_of(pipeline, trial)
    window = window or (0, 0, *scenes.frame[0].tolist())
    return render_all(scenes, np.array([0]), marker_boxes(scenes), np.array([window]))[0]


def flat(level, *settings, seed=1, trial=0, tilt_deg=0, height=720):
    """Pixels (height - 20, 1000) of a frame of one level, the marker's rows cut out."""
    if trial:
        settings = (*settings, f"trial={trial + 1}")
    document = {
        "seed": seed, "camera": {"width_px": 1000, "height_px": height},
        "pose": {"side_px": 8, "tilt_deg": tilt_deg}, "scene": {"background": level},
    }
    image = image_of(Pipeline.from_dict(document, settings), trial)
    middle = height // 2
    return np.concatenate([image[: middle - 10], image[middle + 10 :]])


def chi_square(counts, probabilities, total):
    """p-value of counts, cells of a low expectation joined with their neighbours."""
    joined, expected, have, want = [], [], 0, 0.0
    for count, probability in zip(counts, probabilities, strict=True):
        have, want = have + count, want + total * probability
        if want >= 20:
            joined.append(have)
            expected.append(want)
            have, want = 0, 0.0
    joined[-1] += have
    expected[-1] += want
    expected = np.array(expected)
    return stats.chisquare(joined, expected * (total / expected.sum())).pvalue


# What a pixel of a level is: the distribution, and the settings that make it.
LEVELS = [
    *((mean, f"noise_grey={noise}", stats.norm(mean, noise)) for mean, noise in (
        (100.25, 5), (3, 20), (200, 90))),
    *((mean, "full_well_e=255", stats.poisson(mean)) for mean in (
        0.1, 1.0, 9.99, 10.0, 200.0)),  # an electron is a level
]


@pytest.mark.parametrize(("mean", "noise", "distribution"), LEVELS)
def test_noise_is_normal_or_poisson_rounded_and_clipped(mean, noise, distribution):
    image = flat(mean, noise)
    upper = distribution.cdf(np.arange(256) + 0.5)
    upper[255] = 1.0
    counts = np.bincount(image.ravel(), minlength=256)
    assert chi_square(counts, np.diff(upper, prepend=0.0), image.size) > UNLIKELY


@numba.njit
def many(mean, start, count):
    """Draw Poisson numbers of ``count`` pixel keys."""
    drawn = np.empty(count)
    for i in range(count):
        pixel = sensor.mixed(np.uint64(start) + np.uint64(0x9E3779B97F4A7C15) * np.uint64(i + 1))
        drawn[i] = sensor._poisson(mean, pixel, 4)
    return drawn


@pytest.mark.parametrize("mean", [5.0, 11.3, 1e3, 1e9])
@lengths(200_000, 4_000_000)
def test_poisson_numbers_are_exactly_distributed(count, mean):
    drawn = many(mean, 7, count)
    # At most 200 cells of about the same probability.
    edges = np.unique(stats.poisson.ppf(np.linspace(0.001, 0.999, 200), mean))
    upper = np.append(stats.poisson.cdf(edges, mean), 1.0)
    counts = np.bincount(np.searchsorted(edges, drawn), minlength=len(upper))
    assert chi_square(counts, np.diff(upper, prepend=0.0), count) > UNLIKELY
    assert abs(drawn.mean() - mean) < FAR * np.sqrt(mean / count)
    # The variance of a sample variance of Poisson numbers: (2 mean² + mean) / n.
    assert abs(drawn.var() - mean) < FAR * np.sqrt((2 * mean**2 + mean) / count)


def correlation(a, b):
    """Correlation of two fields, in standard deviations of that of independent ones."""
    return abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) * np.sqrt(a.size)


@pytest.mark.parametrize("noise", ["noise_grey=20", "full_well_e=300"])
def test_noise_of_pixels_scenes_trials_and_seeds_is_independent(noise):
    image = flat(128, noise).astype(float)
    for down, right in ((0, 1), (1, 0), (1, 1), (0, 32), (64, 0), (5, 7)):
        for field in (image, np.abs(image - image.mean())):
            moved = field[down:, right:], field[: 700 - down, : 1000 - right]
            assert correlation(*moved) < FAR
    for other in (
        flat(128, noise, trial=1), flat(128, noise, seed=2), flat(128, noise, tilt_deg=1),
        flat(128, noise, "marker_id=3"), flat(128, noise, "focal_length_mm=4.5"),
    ):
        assert (other != image).mean() > 0.9
        assert correlation(image, other.astype(float)) < FAR


@pytest.mark.parametrize("noise", [["noise_grey=20"], ["full_well_e=300", "read_noise_e=4"]])
def test_noise_is_that_of_the_scene_whatever_renderer_window_and_levels(noise):
    image = flat(128, *noise)
    for given in (["renderer=warp"], ["renderer=supersample-2"], ["window=full"], ["black=30"],
                  ["white=200"], ["cornerRefinementMethod=subpix"], ["solver=ippe"]):
        assert np.array_equal(flat(128, *noise, *given), image), given
    assert np.array_equal(flat(128, *noise, seed=1, trial=0), image)


# Photon transfer.

@pytest.mark.parametrize(("full_well", "read", "gain", "grey"), [
    (500, 2, 1, 0), (20_000, 0, 1, 0), (500, 2, 0.5, 0), (1000, 20, 1, 0), (1000, 5, 1.5, 3),
])
def test_photon_transfer_is_within_one_percent_of_theory(full_well, read, gain, grey):
    """Variance against mean: gain² · (mean · 255 / full well + (read · 255 / full well)²) + grey²
    + 1/12 of quantisation, which holds where steps of an electron are smoothed over the levels: by
    many electrons a level, or by read noise. Of 700,000 pixels the variance has a standard
    deviation of 0.17 %."""
    for level in (40, 120):
        image = flat(
            level, f"full_well_e={full_well}", f"read_noise_e={read}", f"gain={gain}",
            f"noise_grey={grey}",
        ).astype(float)
        a_level = 255 / full_well
        theory = gain**2 * (level * a_level + (read * a_level) ** 2) + grey**2 + 1 / 12
        assert abs(image.var() / theory - 1) < 0.01
        assert abs(image.mean() - gain * level) < FAR * np.sqrt(theory / image.size)


def test_full_well_and_saturation_clip():
    # 255 of level is a full well of 100 electrons on average; more do not fit.
    image = flat(255, "full_well_e=100", "gain=0.5")
    assert image.max() == 128  # 127.5 rounds up
    share = stats.poisson.sf(99, 100)
    deviation = np.sqrt(share * (1 - share) / image.size)
    assert abs((image == 128).mean() - share) < FAR * deviation
    assert (flat(250, "full_well_e=1e6", "gain=2") == 255).all()
    assert (flat(0, "full_well_e=1000", "gain=2") == 0).all()


# Quantisation.

def test_quantisation_is_rounding_half_up_clipped_and_seen_in_8_bits():
    document = {
        "camera": {"width_px": 64, "height_px": 48}, "pose": {"tilt_deg": 20, "roll_deg": 33},
        "scene": {"black": 30.3, "white": 201.7, "background": 90.4},
    }
    for gain, bits in itertools.product((0.01, 0.7, 1.0, 5.0, 1e6), range(8, 17)):
        pipeline = Pipeline.from_dict(
            document, [f"gain={gain}", f"bit_depth={bits}", "side_px=20"])
        mean, share = marker_levels(scenes_of(pipeline), 0, (0, 0, 64, 48))
        most = 2**bits - 1
        scaled = gain * (mean + (1 - share) * 90.4) * most / 255
        counts = np.clip(np.floor(scaled + 0.5), 0, most).astype(np.int64)
        expected = (2 * 255 * counts + most) // (2 * most)
        decided = np.abs(scaled % 1 - 0.5) > 1e-6
        assert np.array_equal(image_of(pipeline)[decided], expected[decided])
