"""Animations: GIF and MP4 from frames `[N, H, W, 3]`, floats in [0, 1] or uint8, of one size."""

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from jaxtyping import UInt8
from numpy.typing import ArrayLike

from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.images import to_uint8

Frames = ArrayLike | Sequence[ArrayLike]

_MIN_GIF_FPS = 0.01
_MAX_GIF_FPS = 50.0  # GIF counts in 1/100 s, and viewers slow anything under 2/100 s down


def write_video(path: str | Path, frames: Frames, fps: float) -> None:
    """Write `.gif` or `.mp4`, by suffix; ValueError for another. Errors as in the two writers."""
    check_video(path, fps)
    writer = write_gif if Path(path).suffix.lower() == ".gif" else write_mp4
    writer(path, frames, fps)


def check_video(path: str | Path, fps: float) -> None:
    """Raise ValueError for a suffix that `write_video` does not write, and `fps` that it does not play."""
    suffix = Path(path).suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"{path}: the suffix must be one of .gif, .mp4")
    if suffix == ".gif" and not _MIN_GIF_FPS <= fps <= _MAX_GIF_FPS:
        raise ValueError(
            f"{path}: a GIF plays at {_MIN_GIF_FPS:g} to {_MAX_GIF_FPS:g} fps, got {fps}; "
            "write an MP4"
        )
    if not 0 < fps < float("inf"):
        raise ValueError(f"{path}: fps must be positive, got {fps}")


def write_gif(path: str | Path, frames: Frames, fps: float) -> None:
    """Write an endlessly repeating GIF; the file appears whole or not at all.

    Frame times are rounded to 1/100 s. Raises ValueError for frames that are none, unequal, not
    `[H, W, 3]` or not finite (naming the first), and for `fps` outside [0.01, 50].
    """
    check_video(Path(path).with_suffix(".gif"), fps)
    pixels = _checked_frames(path, frames)
    duration = 10 * round(100.0 / fps)  # milliseconds
    with atomic_path(path) as partial:
        iio.imwrite(partial, pixels, plugin="pillow", extension=".gif", duration=duration, loop=0)


def write_mp4(path: str | Path, frames: Frames, fps: float) -> None:
    """Write an H.264 MP4 that common players open; the file appears whole or not at all.

    Odd widths and heights are padded by one repeated pixel, which the pixel format (4:2:0) asks
    for. Raises ValueError as `write_gif` (`fps` need only be positive), RuntimeError where no
    ffmpeg is found.
    """
    check_video(Path(path).with_suffix(".mp4"), fps)
    pixels = _checked_frames(path, frames)
    _, height, width, _ = pixels.shape
    pixels = np.pad(pixels, ((0, 0), (0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    with atomic_path(path) as partial, _no_fork_hooks():
        iio.imwrite(
            partial,
            pixels,
            plugin="FFMPEG",
            extension=".mp4",
            fps=fps,
            codec="libx264",
            pixelformat="yuv420p",
            quality=8,
            macro_block_size=2,
            ffmpeg_log_level="error",
        )


@contextlib.contextmanager
def _no_fork_hooks() -> Iterator[None]:
    """Start ffmpeg by a plain spawn; imageio's shield against Ctrl-C forks under jax's threads."""
    name = "IMAGEIO_FFMPEG_NO_PREVENT_SIGINT"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _checked_frames(path: str | Path, frames: Frames) -> UInt8[np.ndarray, "N H W 3"]:
    pixels: list[np.ndarray] = []
    for i, frame in enumerate(np.asarray(f) for f in frames):  # type: ignore[union-attr, arg-type]
        if frame.ndim != 3 or frame.shape[2] != 3 or 0 in frame.shape:
            raise ValueError(f"{path}: frame {i} must be [H, W, 3], got {frame.shape}")
        if pixels and frame.shape != pixels[0].shape:
            raise ValueError(f"{path}: frame {i} is {frame.shape}, frame 0 is {pixels[0].shape}")
        try:
            pixels.append(to_uint8(frame))
        except ValueError as error:
            raise ValueError(f"{path}: frame {i}: {error}") from error
    if not pixels:
        raise ValueError(f"{path}: there are no frames to write")
    return np.stack(pixels)
