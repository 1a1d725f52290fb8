"""Posed images in nerf-synthetic layout: `transforms_<split>.json` and RGBA pictures.

Cameras follow OpenGL axes (look down -z, y up); matrices are camera-to-world. Focal lengths and
principal points are in pixels of the returned images, pixel centres at half integers. Everything
that can be known from the JSON and the image headers is checked before a pixel is decoded. Where
images have no alpha, frames may name a `background_path`: a picture of what is behind the object.
"""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from nimpostor_jax.config import DataConfig
from nimpostor_jax.io.images import area_downsample, image_header, read_image
from nimpostor_jax.io.transforms import (
    DISTORTION_KEYS,
    check_near_origin,
    check_no_masks,
    image_path,
    intrinsics,
    number,
    read_json,
    read_matrix,
)
from nimpostor_jax.types import Camera


@dataclasses.dataclass(frozen=True, eq=False)
class PosedImages:
    """N pictures of one size with their cameras, on the host.

    `images` are premultiplied by alpha, values in [0, 1]; `names` are paths relative to the scene's
    folder; `has_alpha[i]` is False where the file had no alpha channel (alpha is then 1).
    `backgrounds` are what would be seen without the object, where that is known: the object's alpha
    is then learned from the difference.
    """

    images: Float[np.ndarray, "N H W 4"]
    camera_to_world: Float[np.ndarray, "N 4 4"]
    focal: Float[np.ndarray, "N 2"]
    principal: Float[np.ndarray, "N 2"]
    names: tuple[str, ...]
    has_alpha: Bool[np.ndarray, " N"]
    backgrounds: Float[np.ndarray, "N H W 3"] | None = None

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
    def show_masks(self) -> bool:
        """Whether alpha says where the object is: all have it, and it is not opaque everywhere."""
        return bool(self.has_alpha.all() and self.masks.min() < 1)

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
            backgrounds=None if self.backgrounds is None else self.backgrounds[index],
        )

    def background(self, index: int, default: str) -> Float[np.ndarray, "H W 3"] | str:
        """What stands behind view `index`: its own background, else the `default`."""
        return default if self.backgrounds is None else self.backgrounds[index]


def load_blender(folder: str | Path, split: str, resolution: int | None = None) -> PosedImages:
    """Read one split (`train`, `test`, `val`, ...) of a nerf-synthetic folder.

    `resolution` is the target width in pixels (None: as stored); pictures are averaged over exact
    pixel footprints in premultiplied alpha, and the intrinsics scale along. `camera_angle_x` is the
    horizontal field of view; `fl_x`, `fl_y`, `cx`, `cy` (pixels of a `w` x `h` picture) take
    precedence, in the file or in a frame. `background_path` names a picture of the same size for
    all frames or for none. Raises FileNotFoundError for a missing folder, JSON or
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
    remedy = "give RGBA images whose alpha is the object's mask, supply a cage, or use experiments/capture.py"
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
    backgrounds: tuple[Path, ...] | None


def _transforms_path(folder: Path, split: str) -> Path:
    return folder / f"transforms_{split}.json"


def _inspect(folder: Path, split: str) -> _Split:
    """Read and check the JSON and the image headers of a split."""
    json_path = _transforms_path(folder, split)
    meta = read_json(folder, json_path)
    frames = meta["frames"]
    check_no_masks(frames, json_path)
    matrices = np.stack([read_matrix(frame, i, json_path) for i, frame in enumerate(frames)])
    paths = tuple(image_path(folder, frame, i, json_path) for i, frame in enumerate(frames))
    headers = [image_header(path) for path in paths]
    width, height, _ = headers[0]
    for path, (w, h, _) in zip(paths, headers, strict=True):
        if (w, h) != (width, height):
            raise ValueError(
                f"{path} is {w}x{h} but {paths[0]} is {width}x{height}; "
                "all images of a split must have one size"
            )
    lenses = []
    for i, frame in enumerate(frames):
        values = {**meta, **frame}
        _check_undistorted(values, f"{json_path}: frame {i}")
        lenses.append(intrinsics(values, width, height, json_path, i))
    focal = np.array([focal for focal, _ in lenses])
    check_near_origin(matrices, focal, json_path)
    return _Split(
        json_path=json_path,
        paths=paths,
        names=tuple(_relative(path, folder) for path in paths),
        camera_to_world=matrices,
        focal=focal,
        principal=np.array([principal for _, principal in lenses]),
        width=width,
        height=height,
        has_alpha=np.array([alpha for _, _, alpha in headers]),
        backgrounds=_inspect_backgrounds(folder, frames, (width, height), json_path),
    )


def _inspect_backgrounds(
    folder: Path, frames: list[dict], size: tuple[int, int], json_path: Path
) -> tuple[Path, ...] | None:
    """Pictures of what is behind the object, of all frames or of none."""
    key = "background_path"
    without = [i for i, frame in enumerate(frames) if key not in frame]
    if len(without) == len(frames):
        return None
    if without:
        raise ValueError(
            f"{json_path}: frame {without[0]} has no '{key}' but others have; give it to all or to none"
        )
    paths = tuple(image_path(folder, frame, i, json_path, key) for i, frame in enumerate(frames))
    for path in paths:
        width, height, _ = image_header(path)
        if (width, height) != size:
            raise ValueError(
                f"background {path} is {width}x{height} but the images are {size[0]}x{size[1]}"
            )
    return paths


def _check_undistorted(values: dict, where: str) -> None:
    bent = [key for key in DISTORTION_KEYS if number(values, key, 0.0, where) != 0.0]
    if bent:
        raise ValueError(
            f"{where}: lens distortion '{bent[0]}' is not supported here; undistort the images "
            "(experiments/capture.py does)"
        )


def _decode(split: _Split, resolution: int | None) -> PosedImages:
    width, height = _target_size(split, resolution)
    images = np.empty((len(split.paths), height, width, 4), np.float32)
    for i, path in enumerate(split.paths):
        images[i] = area_downsample(read_image(path)[0], width, height)
    backgrounds = None
    if split.backgrounds is not None:
        backgrounds = np.empty((len(split.paths), height, width, 3), np.float32)
        for i, path in enumerate(split.backgrounds):
            backgrounds[i] = area_downsample(read_image(path)[0][..., :3], width, height)
    shrink = np.array([width / split.width, height / split.height])
    return PosedImages(
        images=images,
        camera_to_world=split.camera_to_world,
        focal=split.focal * shrink,
        principal=split.principal * shrink,
        names=split.names,
        has_alpha=split.has_alpha,
        backgrounds=backgrounds,
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


def _relative(path: Path, folder: Path) -> str:
    return Path(os.path.relpath(path, folder)).as_posix()  # it may lie elsewhere
