"""Posed images in nerf-synthetic layout: `transforms_<split>.json` and RGBA pictures.

Cameras follow OpenGL axes (look down -z, y up); matrices are camera-to-world. Focal lengths and
principal points are in pixels of the returned images, pixel centres at half integers. Everything
that can be known from the JSON and the image headers is checked before a pixel is decoded.
"""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from nimpostor_jax.config import DataConfig
from nimpostor_jax.io.images import area_downsample, image_header, read_image
from nimpostor_jax.types import Camera

_RIGID_TOLERANCE = 1e-3  # on the entries of R^T R - I; JSON files carry 6 digits or more
_DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")


@dataclasses.dataclass(frozen=True, eq=False)
class PosedImages:
    """N pictures of one size with their cameras, on the host.

    `images` are premultiplied by alpha, values in [0, 1]; `names` are paths relative to the scene's
    folder; `has_alpha[i]` is False where the file had no alpha channel (alpha is then 1).
    """

    images: Float[np.ndarray, "N H W 4"]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    focal: Float[np.ndarray, "N 2"]
    principal: Float[np.ndarray, "N 2"]
    names: tuple[str, ...]
    has_alpha: Bool[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.names)

    @property
    def height(self) -> int:
        """H, in pixels."""
        return self.images.shape[1]

    @property
    def width(self) -> int:
        """W, in pixels."""
        return self.images.shape[2]

    @property
    def masks(self) -> Float[np.ndarray, "N H W"]:
        """Alpha: the share of each pixel that the object covers."""
        return self.images[..., 3]

    @property
    def cameras(self) -> Camera:
        """All cameras as one batched float32 record."""
        return Camera(
            camera_to_world=jnp.asarray(self.camera_to_world, jnp.float32),
            focal=jnp.asarray(self.focal, jnp.float32),
            principal=jnp.asarray(self.principal, jnp.float32),
            width=self.width,
            height=self.height,
        )

    def select(self, indices: Sequence[int] | Int[np.ndarray, " M"]) -> "PosedImages":
        """The views at `indices`, in that order. Raises IndexError for an index out of range."""
        index = np.asarray(indices, np.int64).reshape(-1)
        outside = index[(index < -len(self)) | (index >= len(self))]
        if outside.size:
            raise IndexError(f"view {outside[0]} does not exist; there are {len(self)}")
        return PosedImages(
            images=self.images[index],
            camera_to_world=self.camera_to_world[index],
            focal=self.focal[index],
            principal=self.principal[index],
            names=tuple(self.names[i] for i in index),
            has_alpha=self.has_alpha[index],
        )


def load_blender(folder: str | Path, split: str, resolution: int | None = None) -> PosedImages:
    """Read one split (`train`, `test`, `val`, ...) of a nerf-synthetic folder.

    `resolution` is the target width in pixels (None: as stored); pictures are averaged over exact
    pixel footprints in premultiplied alpha, and the intrinsics scale along. `camera_angle_x` is the
    horizontal field of view; `fl_x`, `fl_y`, `cx`, `cy` (pixels of a `w` x `h` picture) take
    precedence, in the file or in a frame. Raises FileNotFoundError for a missing folder, JSON or
    image, ValueError for anything inconsistent; both name the file, and the frame where there is
    one.
    """
    return _decode(_inspect(Path(folder), split), resolution)


def load_scene(folder: str | Path, config: DataConfig) -> tuple[PosedImages, PosedImages]:
    """Training and held-out views of a nerf-synthetic folder.

    Held out are the `test` split, else `val`, else every `config.test_every`-th training view from
    the first. Both splits are checked before either is decoded. Errors as in `load_blender`.
    """
    folder = Path(folder)
    train = _inspect(folder, "train")
    for split in ("test", "val"):
        if _transforms_path(folder, split).is_file():
            held_out = _inspect(folder, split)
            _target_size(held_out, config.resolution)
            return _decode(train, config.resolution), _decode(held_out, config.resolution)
    if len(train.paths) < 2:
        raise ValueError(
            f"{train.json_path}: 1 view cannot be split into training and held-out views"
        )
    views = _decode(train, config.resolution)
    is_test = np.arange(len(views)) % config.test_every == 0
    return views.select(np.flatnonzero(~is_test)), views.select(np.flatnonzero(is_test))


def check_masks(posed: PosedImages) -> None:
    """Raise ValueError, naming the image, unless every view has a mask that shows the object."""
    remedy = "give RGBA images whose alpha is the object's mask, or supply a cage"
    without = np.flatnonzero(~posed.has_alpha)
    if without.size:
        raise ValueError(
            f"{without.size} of {len(posed)} images have no alpha channel "
            f"(first: {posed.names[without[0]]}); {remedy}"
        )
    empty = np.flatnonzero(posed.masks.max(axis=(1, 2)) <= 0)
    if empty.size:
        raise ValueError(
            f"{empty.size} of {len(posed)} images have an empty mask "
            f"(first: {posed.names[empty[0]]}); remove these views or repair their alpha"
        )
    if posed.masks.min() >= 1:
        raise ValueError(
            f"the masks of all {len(posed)} images cover the whole image "
            f"(first: {posed.names[0]}); {remedy}"
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Split:
    """What is known of a split before its pixels are decoded."""

    json_path: Path
    paths: tuple[Path, ...]
    names: tuple[str, ...]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    focal: Float[np.ndarray, "N 2"]  # in pixels of the stored pictures
    principal: Float[np.ndarray, "N 2"]
    width: int
    height: int
    has_alpha: Bool[np.ndarray, " N"]


def _transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def _inspect(folder: Path, split: str) -> _Split:
    """Read and check the JSON and the image headers of a split."""
    json_path = _transforms_path(folder, split)
    meta = _read_json(folder, json_path)
    frames = meta["frames"]
    matrices = np.stack([_read_matrix(frame, i, json_path) for i, frame in enumerate(frames)])
    paths = tuple(_image_path(folder, frame, i, json_path) for i, frame in enumerate(frames))
    headers = [image_header(path) for path in paths]
    width, height, _ = headers[0]
    for path, (w, h, _) in zip(paths, headers, strict=True):
        if (w, h) != (width, height):
            raise ValueError(
                f"{path} is {w}x{h} but {paths[0]} is {width}x{height}; "
                "all images of a split must have one size"
            )
    intrinsics = [
        _intrinsics({**meta, **f}, width, height, json_path, i) for i, f in enumerate(frames)
    ]
    return _Split(
        json_path=json_path,
        paths=paths,
        names=tuple(_relative(path, folder) for path in paths),
        camera_to_world=matrices,
        focal=np.array([focal for focal, _ in intrinsics]),
        principal=np.array([principal for _, principal in intrinsics]),
        width=width,
        height=height,
        has_alpha=np.array([alpha for _, _, alpha in headers]),
    )


def _decode(split: _Split, resolution: int | None) -> PosedImages:
    width, height = _target_size(split, resolution)
    images = np.empty((len(split.paths), height, width, 4), np.float32)
    for i, path in enumerate(split.paths):
        images[i] = area_downsample(read_image(path)[0], width, height)
    shrink = np.array([width / split.width, height / split.height])
    return PosedImages(
        images=images,
        camera_to_world=split.camera_to_world,
        focal=split.focal * shrink,
        principal=split.principal * shrink,
        names=split.names,
        has_alpha=split.has_alpha,
    )


def _target_size(split: _Split, resolution: int | None) -> tuple[int, int]:
    if resolution is None:
        return split.width, split.height
    if not 1 <= resolution <= split.width:
        raise ValueError(
            f"resolution {resolution} is not in [1, {split.width}], the stored width of "
            f"{split.paths[0]}; "
            "lower DataConfig.resolution or leave it None"
        )
    return resolution, max(1, round(split.height * resolution / split.width))


def _read_json(folder: Path, path: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise FileNotFoundError(f"scene folder {folder} does not exist")
    if not path.is_file():
        found = ", ".join(sorted(p.name for p in folder.glob("*.json"))) or "none"
        raise FileNotFoundError(f"{path} does not exist (JSON files there: {found})")
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid JSON ({error})") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise ValueError(f"{path}: 'frames' must be a non-empty list of objects")
    return meta


def _read_matrix(frame: dict[str, Any], index: int, json_path: Path) -> Float[np.ndarray, "4 4"]:
    """The frame's camera-to-world matrix, checked to be a rotation and a translation."""
    where = f"{json_path}: frame {index}: 'transform_matrix'"
    if "transform_matrix" not in frame:
        raise ValueError(f"{where} is missing")
    try:
        matrix = np.asarray(frame["transform_matrix"], np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where} is not a matrix of numbers") from error
    if matrix.shape != (4, 4):
        raise ValueError(f"{where} has shape {matrix.shape}, expected (4, 4)")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{where} has non-finite entries")
    rotation = matrix[:3, :3]
    deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    last_row = np.abs(matrix[3] - [0, 0, 0, 1]).max()
    determinant = np.linalg.det(rotation)
    if max(deviation, last_row) > _RIGID_TOLERANCE or determinant < 0:
        raise ValueError(
            f"{where} is not rigid (rotation off orthonormal by {deviation:.2g}, determinant "
            f"{determinant:.3g}, last row {matrix[3].tolist()}); remove scale, shear and mirroring"
        )
    return matrix


def _image_path(folder: Path, frame: dict[str, Any], index: int, json_path: Path) -> Path:
    """The frame's picture; nerf-synthetic leaves the suffix `.png` out."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise ValueError(f"{json_path}: frame {index}: 'file_path' is missing or not a string")
    path = folder / name
    if path.is_file():
        return path
    with_suffix = path.with_name(path.name + ".png")
    if with_suffix.is_file():
        return with_suffix
    missing = path if path.suffix.lower() in (".png", ".jpg", ".jpeg") else with_suffix
    raise FileNotFoundError(f"image {missing} does not exist ({json_path}, frame {index})")


def _relative(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()


def _intrinsics(
    values: dict[str, Any], width: int, height: int, json_path: Path, index: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point in pixels of the stored picture."""
    where = f"{json_path}: frame {index}"

    def number(key: str, default: float) -> float:
        value = values.get(key, default)
        if (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or not math.isfinite(value)
        ):
            raise ValueError(f"{where}: '{key}' must be a finite number, got {value!r}")
        return float(value)

    bent = [key for key in _DISTORTION_KEYS if number(key, 0.0) != 0.0]
    if bent:
        raise ValueError(
            f"{where}: lens distortion '{bent[0]}' is not supported; undistort the images"
        )
    stated_width, stated_height = number("w", width), number("h", height)
    if min(stated_width, stated_height) <= 0:
        raise ValueError(
            f"{where}: 'w' and 'h' must be positive, got {stated_width:g}x{stated_height:g}"
        )
    # A copy that was downsampled may be off the stated aspect by its rounding: up to one pixel.
    if abs(stated_height * width / stated_width - height) > 1.0:
        raise ValueError(
            f"{where}: 'w' and 'h' say {stated_width:g}x{stated_height:g}, "
            f"the images are {width}x{height}"
        )
    if "fl_x" in values:
        focal_x = number("fl_x", 0.0)
    elif "camera_angle_x" in values:
        angle = number("camera_angle_x", 0.0)
        if not 0 < angle < math.pi:
            raise ValueError(f"{where}: 'camera_angle_x' must be in (0, pi) radians, got {angle!r}")
        focal_x = 0.5 * stated_width / math.tan(0.5 * angle)
    else:
        raise ValueError(f"{where}: 'camera_angle_x' (or 'fl_x') is missing")
    focal_y = number("fl_y", focal_x)
    if min(focal_x, focal_y) <= 0:
        raise ValueError(
            f"{where}: focal lengths must be positive, got {focal_x:g} and {focal_y:g}"
        )
    center_x, center_y = number("cx", 0.5 * stated_width), number("cy", 0.5 * stated_height)
    scale_x, scale_y = width / stated_width, height / stated_height
    return (focal_x * scale_x, focal_y * scale_y), (center_x * scale_x, center_y * scale_y)
