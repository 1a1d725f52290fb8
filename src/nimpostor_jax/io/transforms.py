"""What a `transforms*.json` says: frames, poses, intrinsics (nerf-synthetic, instant-ngp, nerfstudio).

Cameras follow OpenGL axes (look down -z, y up); matrices are camera-to-world. Focal lengths and
principal points are in pixels, pixel centres at half integers. Errors name the file and the frame.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")

_MAX_ROUNDING = 0.25  # pixels by which float32 may move what a camera sees
_RIGID_TOLERANCE = 1e-3  # on the entries of R^T R - I; JSON files carry 6 digits or more


def read_json(folder: Path, path: Path) -> dict[str, Any]:
    """A transforms file whose `frames` are objects; the folder's JSON files are named if it is missing."""
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


def read_matrix(frame: dict[str, Any], index: int, json_path: Path) -> Float[np.ndarray, "4 4"]:
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


def check_no_masks(frames: list[dict[str, Any]], json_path: Path) -> None:
    """Raise ValueError for masks in files of their own, which would be left out."""
    for i, frame in enumerate(frames):
        if frame.get("mask_path"):
            raise ValueError(
                f"{json_path}: frame {i}: 'mask_path' is not read: write the masks into the images as alpha "
                "(undistorted, for experiments/train.py), or remove the key"
            )


def image_path(
    folder: Path, frame: dict[str, Any], index: int, json_path: Path, key: str = "file_path"
) -> Path:
    """The frame's picture at `key`; the suffix may be left out (nerf-synthetic leaves out `.png`)."""
    name = frame.get(key)
    if not isinstance(name, str) or not name:
        raise ValueError(f"{json_path}: frame {index}: {key!r} is missing or not a string")
    path = folder / name
    if path.is_file():
        return path
    for suffix in IMAGE_SUFFIXES:
        for spelling in (suffix, suffix.upper()):
            with_suffix = path.with_name(path.name + spelling)
            if with_suffix.is_file():
                return with_suffix
    missing = path if path.suffix.lower() in IMAGE_SUFFIXES else path.with_name(path.name + ".png")
    raise FileNotFoundError(f"image {missing} does not exist ({json_path}, frame {index})")


def number(values: dict[str, Any], key: str, default: float, where: str) -> float:
    """A finite number of a transforms file; ValueError, with `where`, for anything else."""
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{where}: '{key}' must be a finite number, got {value!r}")
    return float(value)


def intrinsics(
    values: dict[str, Any], width: int, height: int, json_path: Path, index: int
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point in pixels of the stored picture, which may be a smaller copy.

    `fl_x`, `fl_y`, `cx`, `cy` (pixels of a `w` x `h` picture) take precedence over `camera_angle_x`.
    """
    where = f"{json_path}: frame {index}"
    stated_width, stated_height = number(values, "w", width, where), number(values, "h", height, where)
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
        focal_x = number(values, "fl_x", 0.0, where)
    elif "camera_angle_x" in values:
        angle = number(values, "camera_angle_x", 0.0, where)
        if not 0 < angle < math.pi:
            raise ValueError(f"{where}: 'camera_angle_x' must be in (0, pi) radians, got {angle!r}")
        focal_x = 0.5 * stated_width / math.tan(0.5 * angle)
    else:
        raise ValueError(f"{where}: 'camera_angle_x' (or 'fl_x') is missing")
    if "fl_x" not in values and "camera_angle_y" in values:
        angle = number(values, "camera_angle_y", 0.0, where)
        if not 0 < angle < math.pi:
            raise ValueError(f"{where}: 'camera_angle_y' must be in (0, pi) radians, got {angle!r}")
        focal_y = number(values, "fl_y", 0.5 * stated_height / math.tan(0.5 * angle), where)
    else:
        focal_y = number(values, "fl_y", focal_x, where)
    if min(focal_x, focal_y) <= 0:
        raise ValueError(
            f"{where}: focal lengths must be positive, got {focal_x:g} and {focal_y:g}"
        )
    center_x = number(values, "cx", 0.5 * stated_width, where)
    center_y = number(values, "cy", 0.5 * stated_height, where)
    scale_x, scale_y = width / stated_width, height / stated_height
    return (focal_x * scale_x, focal_y * scale_y), (center_x * scale_x, center_y * scale_y)


def check_near_origin(
    camera_to_world: Float[np.ndarray, "N 4 4"], focal: Float[np.ndarray, "N 2"], source: Path
) -> None:
    """Raise ValueError where cameras are so far from the origin that float32 moves what they see.

    By more than a quarter of a pixel, of something as far from a camera as cameras are from their mean.
    """
    positions = camera_to_world[:, :3, 3]
    mean = positions.mean(axis=0)
    offsets = positions - positions[0]  # of cameras in one place exactly 0
    distance = np.linalg.norm(offsets - offsets.mean(axis=0), axis=1).max()
    rounding = np.spacing(np.abs(positions).max().astype(np.float32)) / 2
    moved = rounding * np.median(focal) / distance if distance > 0 else 0.0
    if moved > _MAX_ROUNDING:
        raise ValueError(
            f"{source}: the cameras are within {distance:.3g} of {np.round(mean, 1).tolist()}: float32 would "
            f"move what they see by {moved:.2g} pixels; subtract that point from all positions"
        )
