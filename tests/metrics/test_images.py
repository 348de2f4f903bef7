"""PSNR, SSIM and errors of depth against values worked out another way."""

import numpy as np
import pytest

from engine.metrics.images import DepthErrors, fit_colours, psnr, score_picture, ssim


def _picture(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (24, 20, 3), dtype=np.uint8)


def test_psnr_matches_a_known_error_and_is_capped_for_equal_pictures() -> None:
    grey = np.full((8, 8, 3), 0.5)
    assert psnr(grey, grey + 0.1) == pytest.approx(20.0)
    assert psnr(_picture(1), _picture(1)) == 100.0
    assert ssim(_picture(1), _picture(1)) == pytest.approx(1.0)


def test_ssim_matches_a_plain_convolution() -> None:
    from scipy.signal import convolve2d

    a, b = _picture(3)[..., 0] / 255.0, _picture(4)[..., 0] / 255.0
    offsets = np.arange(11) - 5
    line = np.exp(-(offsets**2) / (2 * 1.5**2))
    window = np.outer(line, line) / line.sum() ** 2

    def mean(x: np.ndarray) -> np.ndarray:
        return convolve2d(x, window, mode="same", boundary="fill")

    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b, cov = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2, mean(a * b) - mean_a * mean_b
    expected = ((2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)) / (
        (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
    )
    assert ssim(np.stack([a] * 3, -1), np.stack([b] * 3, -1)) == pytest.approx(expected.mean(), abs=1e-10)


def test_fitting_colours_before_psnr_removes_a_gain_and_an_offset() -> None:
    rendered = _picture(1) / 255.0
    photo = rendered * [0.5, 0.7, 0.9] + [0.3, 0.1, 0.0]
    everywhere = np.ones(rendered.shape[:2], bool)
    np.testing.assert_allclose(fit_colours(rendered, photo, everywhere), photo, atol=1e-12)
    np.testing.assert_allclose(fit_colours(np.full_like(photo, 0.2), photo, everywhere)[0, 0], photo.mean((0, 1)))


@pytest.mark.parametrize("seed", range(5))
def test_fitting_colours_never_lowers_psnr(seed: int) -> None:
    scores = score_picture(_picture(seed), _picture(seed + 50))
    assert scores.psnr_fitted >= scores.psnr


def test_psnr_leaves_black_borders_out() -> None:
    truth = np.full((200, 200, 3), 150, np.uint8)
    photo, rendered = truth.copy(), truth + np.uint8(10)
    photo[:12] = 0
    scores = score_picture(rendered, photo)
    assert scores.psnr == pytest.approx(psnr(rendered, truth))
    assert scores.psnr_fitted == 100.0
    assert psnr(rendered, photo) < scores.psnr - 5


def _plane(metres: float) -> np.ndarray:
    return np.full((4, 5), metres, np.float32)


def test_the_median_depth_error_covers_all_pixels_of_all_views() -> None:
    errors, random = DepthErrors(), np.random.default_rng(0)
    every = []
    for _ in range(3):
        measured = random.uniform(0.5, 6.0, (40, 50)).astype(np.float32)
        rendered = measured + random.normal(0.0, 0.06, measured.shape).astype(np.float32)
        errors.add(rendered, np.ones_like(measured), measured)
        every.append(np.abs(rendered.astype(np.float64) - measured))
    assert errors.median == pytest.approx(np.median(every), abs=1e-4)


def test_the_depth_error_ignores_pixels_without_depth() -> None:
    errors = DepthErrors()
    measured, alpha = _plane(2.0), _plane(1.0)
    measured[0], alpha[1] = 0.0, 0.4
    rendered = _plane(9.0)
    rendered[2:] = 2.02
    errors.add(rendered, alpha, measured)
    assert errors.median == pytest.approx(0.02, abs=1e-4)


def test_depth_errors_beyond_the_last_histogram_bin_still_count() -> None:
    errors = DepthErrors()
    errors.add(_plane(60.0), _plane(1.0), _plane(2.0))
    assert errors.median is not None and errors.median > 9.9
