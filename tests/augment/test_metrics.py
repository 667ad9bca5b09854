import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from augment.metrics.image import (
    PIXELS_PER_DEGREE,
    DepthErrors,
    depth_errors,
    flip,
    flip_map,
    psnr,
    ssim,
)
from tests.augment.loss_definition import ssim_map


def pictures(height=23, width=31, *, noise=0.1, seed=0):
    """A smooth picture and a noisy copy, floats in [0, 1]."""
    rng = np.random.default_rng(seed)
    smooth = ndimage.gaussian_filter(rng.uniform(0, 1, (height, width, 3)), (3, 3, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth)
    return np.clip(smooth + rng.normal(0, noise, smooth.shape), 0, 1), smooth


def ssim_by_definition(a, b):
    """Wang et al. 2004, eq. 13, pixel by pixel, with zeros around the picture."""
    offsets = np.arange(11) - 5
    line = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2
    total = []
    for c in range(3):
        x, y = np.pad(a[..., c], 5), np.pad(b[..., c], 5)
        for i in range(a.shape[0]):
            for j in range(a.shape[1]):
                p, q = x[i : i + 11, j : j + 11], y[i : i + 11, j : j + 11]
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                total.append(
                    (2 * mp * mq + 1e-4)
                    * (2 * cov + 9e-4)
                    / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4))
                )
    return np.mean(total)


def test_psnr_of_a_known_error():
    black = np.zeros((4, 5, 3))
    assert psnr(black + 0.1, black) == pytest.approx(20, abs=1e-9)  # rounding of 0.1**2
    assert psnr(black + 1, black) == pytest.approx(0, abs=1e-12)
    assert psnr(np.full((4, 5, 3), 51, np.uint8), black) == pytest.approx(-20 * math.log10(0.2))


def test_equal_pictures_are_perfect():
    _, picture = pictures()
    assert psnr(picture, picture) == math.inf
    assert ssim(picture, picture) == pytest.approx(1, abs=1e-12)
    assert flip(picture, picture) == 0


@pytest.mark.parametrize("size", [(23, 31), (3, 40), (1, 1), (12, 11)])
def test_ssim_is_its_definition(size):
    a, b = pictures(*size) if min(size) > 1 else (np.full((1, 1, 3), 0.3), np.full((1, 1, 3), 0.7))
    # Variances by differences of means: float64 leaves about 1e-16 / C2.
    assert ssim(a, b) == pytest.approx(ssim_by_definition(a, b), abs=1e-11)


def test_ssim_is_that_of_3d_gaussian_splatting():
    a, b = pictures(40, 52)
    line = torch.exp(-((torch.arange(11).double() - 5) ** 2) / (2 * 1.5**2))
    line /= line.sum()
    window = (line[:, None] * line).expand(3, 1, 11, 11)

    def blur(t):
        return torch.nn.functional.conv2d(t, window, padding=5, groups=3)

    x, y = (torch.from_numpy(i).permute(2, 0, 1)[None] for i in (a, b))
    mx, my = blur(x), blur(y)
    vx, vy, cov = blur(x * x) - mx**2, blur(y * y) - my**2, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    expected = ((2 * mx * my + c1) * (2 * cov + c2)) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    assert ssim(a, b) == pytest.approx(float(expected.mean()), abs=1e-11)  # as above


def test_ssim_of_constant_pictures_is_the_luminance_term_away_from_the_border():
    size = 211
    a, b = np.full((size, size, 3), 0.4), np.full((size, size, 3), 0.6)
    luminance = (2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4)
    border = 1 - (size - 10) ** 2 / size**2  # zeros beyond the border reach 5 pixels in
    assert abs(ssim(a, b) - luminance) < border * 0.1
    assert ssim(a, b) == ssim(b, a)


def test_whatever_is_left_out_changes_nothing():
    a, b = pictures()
    weight = np.ones(a.shape[:2])
    weight[5:12, 7:20] = 0
    spoilt = a.copy()
    spoilt[weight == 0] = np.random.default_rng(3).uniform(0, 1, (int((weight == 0).sum()), 3))
    for score in (psnr, ssim, flip):
        assert score(a, b, weight) == score(spoilt, b, weight)
        assert score(a, b, weight) == score(a, b, weight > 0)
        assert score(a, b, np.ones_like(weight)) == pytest.approx(score(a, b), abs=1e-12)
    wrong_inside = np.where((weight == 0)[..., None], 1 - b, b)
    assert psnr(wrong_inside, b, weight) == math.inf
    assert ssim(wrong_inside, b, weight) == pytest.approx(1, abs=1e-12)
    assert flip(wrong_inside, b, weight) == 0


def test_weights_average():
    b = np.zeros((2, 1, 3))
    a = b.copy()
    a[0] = 0.5
    error = 0.25 * 3 / 4
    assert psnr(a, b, np.array([[3.0], [1.0]])) == pytest.approx(-10 * math.log10(error))


def test_8_bit_and_float_pictures_agree():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 256, (2, 9, 13, 3), dtype=np.uint8)
    for score in (psnr, ssim, flip):
        assert score(a, b) == score(a / 255.0, b)


def test_flip_of_black_and_white():
    black, white = np.zeros((8, 8, 3)), np.ones((8, 8, 3))
    # The package's own figure for it; the colour term of two greys does not reach 1.
    assert flip(white, black) == pytest.approx(0.9674, abs=1e-3)


def test_flip_map_shows_where():
    _, b = pictures(30, 60)
    a = b.copy()
    a[:, 40:] = 1 - a[:, 40:]
    error = flip_map(a, b)
    assert error.shape == (30, 60) and error.dtype == np.float32
    assert error[:, :20].max() < 0.01 < error[:, 45:].mean()
    screen = math.pi / 180 * 0.7 * 3840 / 0.7
    assert abs(PIXELS_PER_DEGREE - screen) < 1e-3  # given to four places


def test_flip_grows_with_noise_and_leaves_its_inputs_alone():
    scores = []
    for noise in (0.02, 0.05, 0.2):
        a, b = (image.astype(np.float32) for image in pictures(noise=noise))
        kept = a.copy(), b.copy()
        scores.append(flip(a, b))
        assert (a == kept[0]).all() and (b == kept[1]).all()
    assert scores == sorted(scores) and scores[0] < scores[-1]


@pytest.mark.parametrize(
    ("a", "b", "weight", "words"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), None, r"one size; got \(4, 4, 3\)"),
        (np.zeros((4, 4)), np.zeros((4, 4, 3)), None, r"\[H, W, 3\]"),
        (np.zeros((0, 4, 3)), np.zeros((0, 4, 3)), None, "H, W >= 1"),
        (np.zeros((4, 4, 3), np.int32), np.zeros((4, 4, 3)), None, "uint8, or floats"),
        (np.full((4, 4, 3), 1.01), np.zeros((4, 4, 3)), None, "clamp it first"),
        (np.full((4, 4, 3), np.nan), np.zeros((4, 4, 3)), None, r"\[0, 1\]"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.ones((4, 5)), r"weight must be \[4, 4\]"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), -np.ones((4, 4)), ">= 0"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.full((4, 4), np.nan), "finite"),
        (np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), np.zeros((4, 4)), "no pixel counts"),
    ],
)
def test_bad_pictures_are_refused(a, b, weight, words):
    for score in (psnr, ssim, flip):
        with pytest.raises(ValueError, match=words):
            score(a, b, weight)


def test_depth_errors_of_known_values():
    true = np.arange(1, 11).astype(np.float64)
    errors = depth_errors(true + 0.01 * np.arange(1, 11), true)
    assert errors.pixels == 10
    assert errors.median_m == pytest.approx(0.05)
    assert errors.p90_m == pytest.approx(0.09)
    assert errors.abs_rel == pytest.approx(0.01)
    # 0.05 itself is rounded in both terms: 4 or 5 of the 10 are within it.
    assert 0.4 <= errors.within_5cm <= 0.5
    assert depth_errors(true, true) == DepthErrors(10, 0.0, 0.0, 0.0, 1.0)


def test_depth_quantiles_are_those_of_repeated_values():
    rng = np.random.default_rng(0)
    true = rng.uniform(2, 50, (7, 9))
    depth = true + rng.normal(0, 0.3, true.shape)
    times = rng.integers(0, 4, true.shape)
    weighted = depth_errors(depth, true, times)
    plain = depth_errors(np.repeat(depth, times.ravel()), np.repeat(true, times.ravel()))
    assert (weighted.median_m, weighted.p90_m) == (plain.median_m, plain.p90_m)
    assert weighted.abs_rel == pytest.approx(plain.abs_rel)
    assert weighted.within_5cm == pytest.approx(plain.within_5cm)
    error = np.sort(np.repeat(np.abs(depth - true), times.ravel()))
    assert plain.p90_m == np.quantile(error, 0.9, method="inverted_cdf")


def test_depth_without_pixels_is_unknown():
    for errors in (
        depth_errors(np.zeros(0), np.zeros(0)),
        depth_errors(np.full(3, np.nan), np.zeros(3), np.zeros(3)),
    ):
        assert errors.pixels == 0 and math.isnan(errors.median_m) and math.isnan(errors.within_5cm)


def test_bad_depths_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        depth_errors(np.ones(3), np.ones(4))
    with pytest.raises(ValueError, match="1 of 2 depths"):
        depth_errors(np.array([1, np.nan]), np.ones(2))
    with pytest.raises(ValueError, match="2 true depths"):
        depth_errors(np.ones(3), np.array([0, 1, np.inf]))


def test_ssim_is_the_one_that_reconstruction_learns_with():
    a, b = pictures(17, 40)
    learnt = ssim_map(torch.from_numpy(a), torch.from_numpy(b))
    assert ssim(a, b) == pytest.approx(float(learnt.mean()), abs=1e-11)  # both float64
