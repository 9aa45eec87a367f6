"""Metrics against independent programs, closed forms and the mistakes they must not make."""

import importlib.machinery
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab
from skimage.metrics import peak_signal_noise_ratio

from eval.score import metrics
from eval.score.metrics import delta_e_2000, flip, highlights, lpips, masked_psnr, mean_of, psnr, psnr_uint8_wrap, ssim
from eval.score.scores import score_picture


def random_pair(seed: int, size: int = 48) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.integers(0, 256, (size, size, 3), np.uint8)
    noisy = np.clip(target + rng.normal(0, 1 + 10 * seed, target.shape), 0, 255)
    return np.rint(noisy).astype(np.uint8), target


@pytest.mark.parametrize("seed", range(4))
def test_psnr_equals_scikit_image_and_is_symmetric(seed: int) -> None:
    pred, target = random_pair(seed)
    assert psnr(pred, target) == pytest.approx(peak_signal_noise_ratio(target, pred, data_range=255), abs=1e-9)
    assert psnr(pred, target) == psnr(target, pred)


def test_identical_pictures_are_infinitely_good() -> None:
    _, target = random_pair(0)
    assert psnr(target, target) == psnr_uint8_wrap(target, target) == math.inf
    assert ssim(target, target) == pytest.approx(1.0)
    assert delta_e_2000(target, target).max() == 0


def test_an_error_of_16_everywhere_is_24_db_and_wraps_to_none() -> None:
    target = np.random.default_rng(0).integers(0, 240, (32, 32, 3), np.uint8)
    pred = target + np.uint8(16)
    assert psnr(pred, target) == pytest.approx(20 * math.log10(255 / 16))
    assert psnr(pred, target) == pytest.approx(24.05, abs=5e-3)
    assert psnr_uint8_wrap(pred, target) == psnr_uint8_wrap(target, pred) == math.inf


def test_wrapped_psnr_is_psnr_while_no_error_reaches_16() -> None:
    rng = np.random.default_rng(1)
    target = rng.integers(20, 230, (32, 32, 3), np.uint8)
    pred = (target + rng.integers(-15, 16, target.shape)).astype(np.uint8)
    assert psnr_uint8_wrap(pred, target) == pytest.approx(psnr(pred, target), abs=1e-9)


def test_random_noise_scores_as_the_specification_says() -> None:
    rng = np.random.default_rng(2)
    pred, target = rng.integers(0, 256, (2, 256, 256, 3), np.uint8)
    assert psnr(pred, target) == pytest.approx(7.75, abs=0.05)
    assert psnr_uint8_wrap(pred, target) == pytest.approx(27.9, abs=0.05)


def test_masked_psnr_sees_the_mask_only() -> None:
    pred, target = random_pair(1)
    mask = np.zeros(target.shape[:2], bool)
    mask[5:20, 7:30] = True
    expected = peak_signal_noise_ratio(target[5:20, 7:30], pred[5:20, 7:30], data_range=255)
    assert masked_psnr(pred, target, mask) == pytest.approx(expected, abs=1e-9)
    ruined = np.where(mask[..., None], pred, 255 - target).astype(np.uint8)
    assert masked_psnr(ruined, target, mask) == masked_psnr(pred, target, mask)
    assert masked_psnr(pred, target, np.ones_like(mask)) == pytest.approx(psnr(pred, target))


def test_ssim_equals_a_direct_evaluation_of_wang_2004() -> None:
    from scipy.ndimage import correlate

    pred, target = random_pair(3, size=24)
    x, y = pred / 255, target / 255
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(taps, taps)[..., None] / taps.sum() ** 2
    blur = lambda image: correlate(image, window)[5:-5, 5:-5]  # noqa: E731
    mean_x, mean_y = blur(x), blur(y)
    var_x, var_y, cov = blur(x * x) - mean_x**2, blur(y * y) - mean_y**2, blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
    structure = (2 * cov + 0.03**2) / (var_x + var_y + 0.03**2)
    assert ssim(pred, target) == pytest.approx(float((luminance * structure).mean()), abs=1e-9)


def test_delta_e_equals_scikit_image() -> None:
    pred, target = random_pair(2)
    expected = deltaE_ciede2000(rgb2lab(target), rgb2lab(pred))
    # Their white points differ in the fifth digit.
    np.testing.assert_allclose(delta_e_2000(pred, target), expected, atol=0.02)


def hunt_lab(level: tuple[int, int, int]) -> np.ndarray:
    """CIE Lab of an sRGB colour as FLIP has it: chroma fades with lightness."""
    lab = rgb2lab(np.array(level, np.uint8)[None])[0]
    return lab * [1, 0.01 * lab[0], 0.01 * lab[0]]


def flip_of_colours(one: tuple[int, int, int], other: tuple[int, int, int]) -> float:
    """FLIP of two pictures of one colour each, which have no features: Andersson et al. 2020, section 4.1."""

    def difference(a: np.ndarray, b: np.ndarray) -> float:
        return (abs(a[0] - b[0]) + math.hypot(*(a - b)[1:])) ** 0.7

    most = difference(hunt_lab((0, 255, 0)), hunt_lab((0, 0, 255)))
    found = difference(hunt_lab(one), hunt_lab(other))
    knee = 0.4 * most
    return 0.95 * found / knee if found < knee else 0.95 + 0.05 * (found - knee) / (most - knee)


@pytest.mark.parametrize(
    ("one", "other"),
    [((0, 255, 0), (0, 0, 255)), ((0, 0, 0), (255, 255, 255)), ((128, 128, 128), (150, 150, 150)), ((9, 99, 200),) * 2],
)
def test_flip_of_even_pictures_is_that_of_the_paper(one: tuple[int, int, int], other: tuple[int, int, int]) -> None:
    pytest.importorskip("flip_evaluator")
    pred, target = (np.full((24, 24, 3), level, np.uint8) for level in (one, other))
    # Of the margins, too: FLIP repeats the outermost pixels.
    assert flip(pred, target) == pytest.approx(flip_of_colours(one, other), abs=1e-3)


def test_flip_is_the_same_each_time_and_sees_features() -> None:
    pytest.importorskip("flip_evaluator")
    pred, target = random_pair(2)
    found = flip(pred, target)
    assert found is not None and 0.1 < found < 1
    assert flip(pred, target) == found
    line = target.copy()
    line[:, 20] = 0
    assert 0 < (flip(line, target) or 0) < 0.2


def test_highlights_are_the_brightest_of_the_pixels_of_glass() -> None:
    target, pred = np.zeros((2, 20, 20, 3), np.uint8)
    glass = np.zeros((20, 20), bool)
    glass[:, :10] = True
    target[..., 0], target[:, 10:] = np.arange(400).reshape(20, 20) // 3, 255  # Brighter, but no glass.
    target[3, 3:5] = pred[3, 3:5] = 200
    target[7, 2:4] = 200, 220, 240
    bright = highlights(target, glass)
    assert np.argwhere(bright).tolist() == [[3, 3], [3, 4], [7, 2], [7, 3]]
    scores = score_picture(pred, target, glass)
    assert scores["highlight_error"] == -110 and scores["highlight_psnr_db"] == masked_psnr(pred, target, bright)
    assert score_picture(pred, target, np.zeros_like(glass))["highlight_error"] is None


def test_without_their_packages_and_weights_perceptual_scores_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stand-in for lpips, since its weights cannot be had here; with it nothing may be loaded without a file."""
    made = []

    class Distance:
        def __init__(self, *, net: str, verbose: bool) -> None:
            made.append((net, verbose))

        def __call__(self, pred, target):
            assert pred.shape == (1, 3, 48, 48) and pred.min() >= -1 and pred.max() <= 1
            return (pred - target).abs().mean()

    package, vision = ModuleType("lpips"), ModuleType("torchvision")
    package.LPIPS = Distance
    pred, target = random_pair(3)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(metrics, "_flip_package", lambda: None)
    metrics._lpips_distance.cache_clear()
    for name, module in (("lpips", package), ("torchvision", vision)):
        module.__spec__ = importlib.machinery.ModuleSpec(name, None)
        monkeypatch.setitem(sys.modules, name, module)
    try:
        assert lpips(pred, target) is None and flip(pred, target) is None
        assert made == []
        metrics._lpips_distance.cache_clear()
        weights = tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
        weights.parent.mkdir(parents=True)
        weights.touch()
        expected = np.abs(pred.astype(float) - target).mean() / 127.5
        assert lpips(pred, target) == pytest.approx(expected, rel=1e-5)
        assert lpips(pred[:30], target[:30]) is None
        assert made == [("alex", False)]
    finally:
        metrics._lpips_distance.cache_clear()


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([30.0, 32.0], 31.0),
        ([30.0, math.inf, 32.0], 31.0),
        ([30.0, None], 30.0),
        ([math.inf, math.inf, None], math.inf),
        ([None, None], None),
    ],
)
def test_mean_leaves_out_what_has_no_finite_value(values: list[float | None], expected: float | None) -> None:
    assert mean_of(values) == expected
