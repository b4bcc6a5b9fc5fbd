"""Noise, its statistics, its correlation and what it depends on; quantisation.

Every draw is seeded. Statistical tests pass a correct sensor with a probability of 1 - 1e-6 or
more each.
"""

import itertools
import math

import numba
import numpy as np
import pytest
from scipy import stats

from support.lengths import lengths
from support.small_scenes import image_of, scenes_of
from sweep.model import sensor
from sweep.model.renderers import marker_levels

UNLIKELY = 1e-6
FAR = 5.5
"""Standard deviations that a normal number exceeds with a probability of 4e-8."""


def flat(level, *settings, index=0):
    """Pixels (700, 1000) of a frame of one level, the rows of its marker of 8 px cut out."""
    image = image_of(settings, index=index, text={
        "seed": 1, "camera": {"width_px": 1000, "height_px": 720}, "pose": {"side_px": 8},
        "scene": {"background": level},
    })
    return np.concatenate([image[:350], image[370:]])


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


@pytest.mark.parametrize(("mean", "noise", "distribution"), [
    *((mean, f"noise_grey={noise}", stats.norm(mean, noise)) for mean, noise in (
        (100.25, 5), (3, 20), (200, 90))),
    *((mean, "full_well_e=255", stats.poisson(mean)) for mean in (
        0.1, 1.0, 9.99, 10.0, 200.0)),  # an electron is a level
])
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


@pytest.mark.parametrize("noise", [["noise_grey=20"], ["full_well_e=300", "read_noise_e=4"]])
def test_noise_is_independent_and_follows_the_scene_alone(noise):
    image = flat(128, *noise).astype(float)
    for down, right in ((0, 1), (1, 0), (1, 1), (0, 32), (64, 0), (5, 7)):
        for field in (image, np.abs(image - image.mean())):
            moved = field[down:, right:], field[: 700 - down, : 1000 - right]
            assert correlation(*moved) < FAR
    for other in ("seed=2", "tilt_deg=1", "marker_id=3", "focal_length_mm=4.5", "trial=2"):
        differing = flat(128, *noise, other, index=int(other == "trial=2"))
        assert (differing != image).mean() > 0.9
        assert correlation(image, differing.astype(float)) < FAR
    for same in ("renderer=warp", "renderer=supersample-2", "window=full", "black=30", "white=200",
                 "cornerRefinementMethod=subpix", "solver=ippe", "seed=1"):
        assert np.array_equal(flat(128, *noise, same), image), same


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


# Correlated noise, and noise by level.

@pytest.mark.parametrize("correlation", [0.01, 0.3, 0.5, 0.8, 0.99])
def test_weights_have_the_correlation_of_the_closed_form(correlation):
    kernel = sensor.noise_kernel(correlation)
    at = [math.fsum(kernel[: len(kernel) - lag] * kernel[lag:]) for lag in range(5)]
    assert at[0] == pytest.approx(1, abs=1e-14)
    assert at[1] == pytest.approx(correlation, rel=1e-10)
    if correlation >= 0.8:  # nearly a continuous Gaussian: r(2 lags) = r(lag)**4
        assert at[2] == pytest.approx(correlation**4, rel=0.01)


@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.5, 0.9])
@lengths(300, 1500)
def test_field_has_mean_variance_and_correlations_of_the_weights(count, correlation):
    field = sensor.normal_field(np.uint64(77), 0, 5, 9, (count, count), correlation)
    kernel = sensor.noise_kernel(correlation) if correlation else np.ones(1)
    reach = 2 * len(kernel) + 4
    padded = np.convolve(kernel, kernel[::-1])
    along = np.zeros(2 * reach + 1)
    half = len(padded) // 2
    along[reach - half : reach + half + 1] = padded
    plane = np.outer(along, along)
    deviation = math.sqrt(plane.sum()) / count
    assert abs(field.mean()) < FAR * deviation
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1), (0, 2), (3, 0)):
        product = field[down:, right:] * field[: count - down, : count - right]
        expected = plane[reach + down, reach + right]
        # Covariances of products of a normal field (Isserlis): r(k)² + r(k + d) r(k - d).
        moved = np.roll(plane, (down, right), (0, 1)) * np.roll(plane, (-down, -right), (0, 1))
        deviation = math.sqrt((plane**2 + moved).sum() / product.size)
        assert abs(product.mean() - expected) < FAR * deviation, (down, right)


@pytest.mark.parametrize("table", [(0, 2.0, 255, 10.0), (60, 8.0, 120, 3.0, 200, 5.0), (9, 4.0)])
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_over_the_level_is_the_table(table, correlated):
    settings = [f"noise_table={list(table)}", *["noise_correlation=0.5"] * correlated]
    for level in (45, 90, 120, 190, 230):
        noise = flat(level, *settings)[:120, :475] - float(level)
        spread = np.interp(level, table[::2], table[1::2])
        pixels = noise.size / (6 if correlated else 1)
        # Clipping takes less than 1e-4 of a normal number's variance beyond 4 deviations.
        theory = math.sqrt(spread**2 + 1 / 12)
        assert noise.std() == pytest.approx(theory, rel=FAR / math.sqrt(2 * pixels) + 2e-4)


# Quantisation.

def test_quantisation_is_rounding_half_up_clipped_and_seen_in_8_bits():
    document = {
        "camera": {"width_px": 64, "height_px": 48},
        "pose": {"tilt_deg": 20, "roll_deg": 33, "side_px": 20},
        "scene": {"black": 30.3, "white": 201.7, "background": 90.4},
    }
    for gain, bits in itertools.product((0.01, 0.7, 1.0, 5.0, 1e6), range(8, 17)):
        settings = [f"gain={gain}", f"bit_depth={bits}"]
        mean, share = marker_levels(scenes_of(settings, document), 0, (0, 0, 64, 48))
        most = 2**bits - 1
        scaled = gain * (mean + (1 - share) * 90.4) * most / 255
        counts = np.clip(np.floor(scaled + 0.5), 0, most).astype(np.int64)
        expected = (2 * 255 * counts + most) // (2 * most)
        decided = np.abs(scaled % 1 - 0.5) > 1e-6
        image = image_of(settings, text=document)
        assert np.array_equal(image[decided], expected[decided])
