"""Figures and pictures of a trained impostor on held-out views."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from nimpostor_jax import metrics
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.io.images import composite, write_png
from nimpostor_jax.lpips import MIN_SIDE as LPIPS_MIN_SIDE
from nimpostor_jax.render.frame import Frame, frame_config, on_all_devices, render_frame, to_image
from nimpostor_jax.types import BakedImpostor, Camera, NeuralImpostor

Log = Callable[[str], None]

MAX_PSNR = 100.0  # of equal pictures: infinity is no JSON, and no part of a mean


def camera_of(views: PosedImages, index: int) -> Camera:
    """One camera of a set."""
    return jax.tree.map(lambda x: x[index], views.cameras)


def evaluate(
    impostor: NeuralImpostor | BakedImpostor,
    views: PosedImages,
    config: RenderConfig,
    *,
    background: str = "white",
    pictures: str | Path | None = None,
    log: Log = print,
) -> dict[str, Any]:
    """PSNR, SSIM and LPIPS on views, mean and per view; seconds a frame.

    SSIM and LPIPS are None of pictures that are too small for them, LPIPS also without the extra `lpips`.

    PSNR is `MAX_PSNR` at most. Truth and render stand over the view's own background where it has one, else
    over `background`. With `pictures`, writes `<view>.png` there: truth, render, error times 4, depth. The
    time is the median over the views of a whole frame, with everything but compilation.
    """
    per_view: list[dict[str, Any]] = []
    seconds = []
    sized = frame_config(impostor, camera_of(views, 0), config)
    impostor = on_all_devices(impostor)
    render_frame(impostor, camera_of(views, 0), sized)  # compiles
    for index, name in enumerate(views.names):
        start = time.perf_counter()
        frame = render_frame(impostor, camera_of(views, index), sized)
        seconds.append(time.perf_counter() - start)
        behind = views.background(index, background)
        image = composite_frame(frame, behind)
        truth = composite(views.images[index], behind)
        per_view.append(
            {
                "view": name,
                "psnr": min(metrics.psnr(image, truth), MAX_PSNR),
                "ssim": metrics.ssim(image, truth) if min(image.shape[:2]) >= metrics.SSIM_MIN_SIDE else None,
                "lpips": metrics.lpips(image, truth) if min(image.shape[:2]) >= LPIPS_MIN_SIDE else None,
            }
        )
        if pictures is not None:
            panel = [
                truth,
                image,
                np.clip(4 * np.abs(truth - image), 0, 1),
                depth_picture(frame.depth, frame.opacity),
            ]
            write_png(Path(pictures) / picture_name(views, index), np.concatenate(panel, axis=1))
    result: dict[str, Any] = {
        key: _mean([view[key] for view in per_view]) for key in ("psnr", "ssim", "lpips")
    }
    result |= {"seconds_per_frame": float(np.median(seconds)), "per_view": per_view}
    ssim, lpips = ("none" if result[key] is None else f"{result[key]:.4f}" for key in ("ssim", "lpips"))
    log(
        f"{len(views)} views: PSNR {result['psnr']:.2f} dB, SSIM {ssim}, LPIPS {lpips}, "
        f"{result['seconds_per_frame']:.2f} s a frame"
    )
    return result


def picture_name(views: PosedImages, index: int) -> str:
    """Of a view's picture: its file's name, with its folders' where names alone are not unique."""
    stems = [Path(name).with_suffix("") for name in views.names]
    alone = len({stem.name for stem in stems}) == len(stems)
    stem = stems[index]
    return f"{stem.name if alone else '_'.join(stem.parts)}.png"


def composite_frame(
    frame: Frame, background: str | Float[np.ndarray, "H W 3"]
) -> Float[np.ndarray, "H W 3"]:
    """A frame over "white", "black" or a picture, clipped to [0, 1]."""
    if isinstance(background, str):
        return to_image(frame, 1.0 if background == "white" else 0.0)
    return to_image(frame, background)


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def depth_picture(
    depth: Float[np.ndarray, "H W"], opacity: Float[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W 3"]:
    """Depth as grey, near bright, over the range of what is opaque; black where there is nothing."""
    solid = opacity > 0.5
    if not solid.any():
        return np.zeros((*depth.shape, 3), np.float32)
    near, far = depth[solid].min(), depth[solid].max()
    grey = 1 - 0.8 * np.clip((depth - near) / max(far - near, 1e-6), 0, 1)
    return np.repeat((np.where(opacity > 0.05, grey, 0) * np.ones_like(depth))[..., None], 3, axis=-1)


def write_json(path: str | Path, values: Any) -> None:
    """Write JSON whole or not at all."""
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def orbit(
    views: PosedImages, num_frames: int, *, size: int | None = None, elevation_degrees: float = 25.0
) -> list[Camera]:
    """Cameras on a circle around the vertical axis, looking at the centre of what the views look at.

    Vertical is what the views' cameras take for it: captured scenes may have any axis up. The radius is the
    views' median distance, the lens the first view's.
    """
    positions = views.camera_to_world[:, :3, 3]
    forward = -views.camera_to_world[:, :3, 2]
    # The point nearest to all optical axes, by least squares.
    projectors = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    center = np.linalg.lstsq(projectors.sum(0), np.einsum("nij,nj->i", projectors, positions), rcond=None)[0]
    radius = np.median(np.linalg.norm(positions - center, axis=1))
    up = vertical(views)
    across = np.eye(3)[np.argmin(np.abs(up) > 0.9)]  # x, unless that is near the vertical
    across -= (across @ up) * up
    across /= np.linalg.norm(across)
    frame = np.stack([across, np.cross(up, across), up], axis=1)
    size = size or views.width
    zoom = size / views.width
    height = round(views.height * zoom)
    cameras = []
    for azimuth in np.linspace(0, 2 * np.pi, num_frames, endpoint=False):
        elevation = np.radians(elevation_degrees)
        back = np.array(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
            ]
        )
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        pose = np.eye(4)
        back, right = frame @ back, frame @ right
        pose[:3] = np.stack([right, np.cross(back, right), back, center + radius * back], axis=1)
        cameras.append(
            Camera(
                camera_to_world=jnp.asarray(pose, jnp.float32),
                focal=jnp.asarray(views.focal[0] * zoom, jnp.float32),
                principal=jnp.asarray([size / 2, height / 2], jnp.float32),
                width=size,
                height=height,
            )
        )
    return cameras


def vertical(views: PosedImages) -> Float[np.ndarray, " 3"]:
    """The unit direction that is up in most pictures.

    Where cameras are held level, that at right angles to all their horizontal axes; else their mean up.
    """
    right, upward = views.camera_to_world[:, :3, 0], views.camera_to_world[:, :3, 1].mean(axis=0)
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    if spread[0] < _LEVEL < spread[1]:
        return axes[:, 0] if axes[:, 0] @ upward >= 0 else -axes[:, 0]
    length = np.linalg.norm(upward)
    return upward / length if length > _LEVEL else np.array([0.0, 0.0, 1.0])


_LEVEL = 0.02  # mean square of a horizontal axis' vertical part: hand-held cameras are tilted by degrees
