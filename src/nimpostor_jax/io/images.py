"""Pictures: reading, area downsampling, compositing and writing.

Axes: H rows (top first), W columns. Values are display-referred (as stored in the file, usually
sRGB) in [0, 1]; nothing is linearised, as in all nerf-synthetic work. Inside the package colours
are premultiplied by alpha, files hold straight alpha.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from PIL import Image, UnidentifiedImageError

from nimpostor_jax.io.atomic import atomic_path

_READABLE_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")  # 8 bits a channel or fewer
_BACKGROUNDS = {"white": 1.0, "black": 0.0}


def image_header(path: str | Path) -> tuple[int, int, bool]:
    """Width, height and whether there is an alpha channel, without decoding the pixels.

    Raises FileNotFoundError for a missing file, ValueError for one that is no image, or a grey
    one of more than 8 bits; other channels of 16 bits are read as 8.
    """
    with _open(Path(path)) as image:
        return image.width, image.height, _has_alpha(image)


def read_image(path: str | Path) -> tuple[Float[np.ndarray, "H W 4"], bool]:
    """An image as premultiplied float32 RGBA, and whether the file has an alpha channel.

    Without one, alpha is 1 everywhere. Raises FileNotFoundError for a missing file, ValueError for
    one that is unreadable or truncated; both name it.
    """
    path = Path(path)
    with _open(path) as image:
        has_alpha = _has_alpha(image)
        try:
            straight = np.asarray(image.convert("RGBA"), np.float32) / 255.0
        except (OSError, SyntaxError, ValueError) as error:  # Pillow's errors for damaged data
            raise ValueError(
                f"{path} is damaged or truncated ({error}); replace the file"
            ) from error
    straight[..., :3] *= straight[..., 3:]
    return straight, has_alpha


def area_downsample(
    image: Float[np.ndarray, "H W C"], width: int, height: int
) -> Float[np.ndarray, "height width C"]:
    """Average of each target pixel's exact footprint; the factors need not be whole numbers.

    Give premultiplied colours: the average of straight ones would bleed the colour of clear pixels.
    Raises ValueError where the target is empty or larger than the image.
    """
    source_height, source_width = image.shape[:2]
    if not (1 <= width <= source_width and 1 <= height <= source_height):
        raise ValueError(
            f"cannot downsample {source_width}x{source_height} to {width}x{height}; "
            "ask for at most the stored size"
        )
    if (width, height) == (source_width, source_height):
        return image.copy()
    rows = np.tensordot(_box_weights(source_height, height), image, axes=(1, 0))
    pixels = np.tensordot(rows, _box_weights(source_width, width), axes=(1, 1))
    return np.ascontiguousarray(np.moveaxis(pixels, 2, 1), dtype=image.dtype)


def composite(
    premultiplied: Float[np.ndarray, "*batch 4"],
    background: Literal["white", "black"] | ArrayLike,
) -> Float[np.ndarray, "*batch 3"]:
    """Colours over a background, `rgb + (1 - alpha) * background`.

    `background` is "white", "black" or anything that broadcasts against `[*batch, 3]`.
    """
    if isinstance(background, str):
        if background not in _BACKGROUNDS:
            raise ValueError(
                f"background must be one of {tuple(_BACKGROUNDS)} or a colour, got {background!r}"
            )
        background = _BACKGROUNDS[background]
    behind = np.asarray(background, premultiplied.dtype)
    return premultiplied[..., :3] + (1.0 - premultiplied[..., 3:]) * behind


def unpremultiply(premultiplied: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Straight colours in [0, 1] and alpha; black where alpha is 0."""
    alpha = premultiplied[..., 3:]
    divisor = np.where(alpha > 0, alpha, 1.0)
    straight = np.where(alpha > 0, premultiplied[..., :3] / divisor, 0.0)
    return np.concatenate([np.clip(straight, 0.0, 1.0), alpha], axis=-1).astype(premultiplied.dtype)


def to_uint8(image: ArrayLike) -> np.ndarray:
    """Floats to 8 bits: clipped to [0, 1], scaled by 255, rounded; uint8 passes through.

    Raises ValueError for NaN, infinity, and other dtypes.
    """
    values = np.asarray(image)
    if values.dtype == np.uint8:
        return values
    if not np.issubdtype(values.dtype, np.floating):
        raise ValueError(f"pixels must be floats in [0, 1] or uint8, got {values.dtype}")
    bad = int(np.count_nonzero(~np.isfinite(values)))
    if bad:
        first = tuple(int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise ValueError(
            f"{bad} non-finite values in an image of shape {values.shape} (first at {first})"
        )
    return np.rint(np.clip(values, 0.0, 1.0) * 255.0).astype(np.uint8)


def write_png(path: str | Path, image: ArrayLike, *, optimize: bool = False) -> None:
    """Write `[H, W, 1]` grey, `[H, W, 3]` RGB or `[H, W, 4]` straight-alpha RGBA as an 8-bit PNG.

    The file appears whole or not at all. `optimize` spends time on a smaller file. Raises
    ValueError for other shapes and for values that are not finite.
    """
    values = np.asarray(image)
    if values.ndim != 3 or values.shape[2] not in (1, 3, 4) or 0 in values.shape:
        raise ValueError(
            f"{path}: an image must be [H, W, 1], [H, W, 3] or [H, W, 4], got {values.shape}"
        )
    try:
        pixels = to_uint8(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    picture = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    with atomic_path(path) as partial:
        picture.save(partial, format="PNG", optimize=optimize)


def _open(path: Path) -> Image.Image:
    if not path.is_file():
        raise FileNotFoundError(f"image {path} does not exist")
    try:
        image = Image.open(path)
    except UnidentifiedImageError as error:
        raise ValueError(f"{path} is not a readable image; replace the file") from error
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"{path} cannot be read as an image ({error})") from error
    if image.mode not in _READABLE_MODES:
        image.close()
        raise ValueError(f"{path} has pixel type {image.mode!r}; save it as an 8-bit RGBA PNG")
    return image


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info


def _box_weights(source: int, target: int) -> Float[np.ndarray, "target source"]:
    """Share of each source cell in each target cell's footprint; rows sum to 1."""
    edges = np.arange(target + 1) * (source / target)
    cells = np.arange(source)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    return np.clip(overlap, 0.0, None) * (target / source)
