"""Image quality on the host: PSNR, SSIM and LPIPS of two pictures `[H, W, 3]` with values in [0,
1].

All three compare display-referred colours over a background, as the papers of the field report
them.
"""

import functools
import math

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from skimage.metrics import structural_similarity

from nimpostor_jax.lpips import LpipsWeights, lpips_distance, read_weights

SSIM_MIN_SIDE = 11  # pixels: a Gaussian of sigma 1.5 cut at 3.5 sigma


def psnr(a: ArrayLike, b: ArrayLike) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1, `-10 log10(mean((a - b)^2))`; inf where
    equal.

    Any equal shapes. Raises ValueError for unequal or empty ones and for values that are not
    finite.
    """
    first, second = _checked_pair(a, b, "psnr")
    mean_squared = float(np.mean((first - second) ** 2))
    return math.inf if mean_squared == 0 else -10.0 * math.log10(mean_squared)


def ssim(a: ArrayLike, b: ArrayLike) -> float:
    """Structural similarity, mean over pixels and channels (Wang et al. 2004).

    Gaussian window of sigma 1.5, population covariance, data range 1. Raises ValueError as `psnr`,
    for pictures that are not `[H, W, C]`, and for those smaller than the 11-pixel window.
    """
    first, second = _checked_pair(a, b, "ssim")
    if first.ndim != 3:
        raise ValueError(f"ssim compares pictures [H, W, C], got shape {first.shape}")
    if min(first.shape[:2]) < SSIM_MIN_SIDE:
        raise ValueError(
            f"ssim needs at least {SSIM_MIN_SIDE}x{SSIM_MIN_SIDE} pixels, got shape {first.shape}"
        )
    value = structural_similarity(
        first,
        second,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=-1,
    )
    return float(value)


def lpips(a: ArrayLike, b: ArrayLike) -> float | None:
    """LPIPS v0.1 distance with AlexNet features (Zhang et al. 2018); None without the extra
    `lpips`.

    0 for equal pictures, larger for less similar ones. Raises ValueError as `psnr`, for pictures
    that are not `[H, W, 3]` with values in [0, 1], and for those smaller than 31 pixels on a side.
    """
    first, second = _checked_pair(a, b, "lpips")
    outside = max(-min(first.min(), second.min()), max(first.max(), second.max()) - 1.0)
    if (
        outside > 1e-3
    ):  # float32 renders may pass 1 by rounding; a range of 255 or [-1, 1] is a mistake
        raise ValueError(f"lpips needs values in [0, 1]; they leave it by {outside:g}")
    weights = _weights()
    return None if weights is None else lpips_distance(weights, first, second)


@functools.cache
def _weights() -> LpipsWeights | None:
    return read_weights()


def _checked_pair(
    a: ArrayLike, b: ArrayLike, name: str
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    first, second = np.asarray(a, np.float64), np.asarray(b, np.float64)
    if first.shape != second.shape or first.size == 0:
        raise ValueError(
            f"{name} compares equal shapes that are not empty, got {first.shape} and {second.shape}"
        )
    for label, values in (("first", first), ("second", second)):
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            raise ValueError(
                f"{name}: {bad} of {values.size} values of the {label} picture are not finite"
            )
    return first, second
