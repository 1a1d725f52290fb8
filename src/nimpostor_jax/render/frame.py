"""Whole images, in chunks of rays that hit the cage: host code around the jitted renderer."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.capacity import MAX_GROWTH, fit_capacities, grow_march, rays_hit
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.types import Camera, NeuralImpostor, Rays

CHUNK = 8192  # rays a call
REPAIR_CHUNK = 1024  # rays a call with buffers of the largest size
REPAIRABLE = 0.02  # share of overflowing rays that is cheaper to render again than to avoid


class Frame(NamedTuple):
    """A rendered image on the host, fields as in `RenderOutput`."""

    color: Float[np.ndarray, "H W 3"]
    opacity: Float[np.ndarray, "H W"]
    depth: Float[np.ndarray, "H W"]
    coarsened: Bool[np.ndarray, "H W"]


_march_tables = jax.jit(march_tables)
_render = jax.jit(render_rays, static_argnames="config")


@partial(jax.jit, static_argnames=("height", "width"))
def _tiled_rays(camera: Camera, height: int, width: int) -> Rays:
    return pixel_rays(camera, _tiled_pixels(height, width))


def _tiled_pixels(height: int, width: int) -> jax.Array:
    return image_pixels(height, width).reshape(-1, 2)[tile_order(height, width)]


def frame_config(impostor: NeuralImpostor, camera: Camera, config: RenderConfig) -> RenderConfig:
    """`config` with buffer sizes that fit this camera's view; use it for a whole animation.

    Sizes are measured on pixels spread over those that hit the cage. What overflows nevertheless,
    `render_frame` renders again.
    """
    tables = _march_tables(impostor.mesh)
    rays = _tiled_rays(camera, camera.height, camera.width)
    hits = np.flatnonzero(rays_hit(impostor.mesh, tables, rays, config.march))
    if not hits.size:
        return config
    chosen = hits[np.linspace(0, hits.size - 1, CHUNK).round().astype(int)]
    probe = jax.tree.map(lambda x: x[chosen], rays)
    config = fit_capacities(impostor.mesh, tables, probe, config)
    if config.visible_per_ray is None:
        return config
    output = _render(impostor, probe, config, tables=tables)
    mean = 1.25 * float(np.mean(output.num_visible)) + 1
    if mean <= config.visible_per_ray and np.mean(output.overflow) < REPAIRABLE:
        return config
    visible = 8 * int(np.ceil(max(mean, config.visible_per_ray) / 8))
    most = config.sampler.max_samples_per_ray
    return dataclasses.replace(config, visible_per_ray=None if 2 * visible > most else visible)


def render_frame(impostor: NeuralImpostor, camera: Camera, config: RenderConfig) -> Frame:
    """Render one camera.

    Only pixels whose rays hit the cage are shaded, `CHUNK` at a time, so memory does not grow with the image
    beyond its output. Rays whose buffers overflow are rendered again, fewer at a time, in larger ones; raises
    RuntimeError where 2**6 times the given sizes do not suffice. On several devices the chunks take turns.
    """
    height, width = camera.height, camera.width
    tables = _march_tables(impostor.mesh)
    rays = _tiled_rays(camera, height, width)
    pending = np.flatnonzero(rays_hit(impostor.mesh, tables, rays, config.march))
    order = tile_order(height, width)
    dtype, pixels = impostor.mesh.vertices.dtype, height * width
    frame = Frame(
        color=np.zeros((pixels, 3), dtype),
        opacity=np.zeros(pixels, dtype),
        depth=np.zeros(pixels, dtype),
        coarsened=np.zeros(pixels, bool),
    )
    devices = jax.local_devices() if jax.default_backend() == "cpu" else jax.local_devices()[:1]
    replicas = [jax.device_put((impostor, tables), device) for device in devices]
    chunk = CHUNK
    for _ in range(MAX_GROWTH):
        chunks, outputs = [pending[i : i + chunk] for i in range(0, len(pending), chunk)], []
        for turn, chosen in enumerate(chunks):
            device, (replica, replica_tables) = turn % len(devices), replicas[turn % len(devices)]
            padded = np.concatenate([chosen, np.full(chunk - len(chosen), chosen[-1])])
            chunk_rays = jax.device_put(jax.tree.map(lambda x, p=padded: x[p], rays), devices[device])
            outputs.append(_render(replica, chunk_rays, config, tables=replica_tables))
        overflowed = []
        for chosen, output in zip(chunks, outputs, strict=True):
            for name, target in frame._asdict().items():
                target[order[chosen]] = np.asarray(getattr(output, name))[: len(chosen)]
            overflowed.append(chosen[np.asarray(output.overflow)[: len(chosen)]])
        pending = np.concatenate(overflowed) if overflowed else pending[:0]
        if not pending.size:
            return Frame(*(x.reshape(height, width, *x.shape[1:]) for x in frame))
        config, chunk = _grow(config), REPAIR_CHUNK
    raise RuntimeError(
        f"{pending.size} rays need more than {config.march.max_tets_per_ray} tets or "
        f"{config.march.max_entries_per_ray} entries; raise MarchConfig's sizes"
    )


def _grow(config: RenderConfig) -> RenderConfig:
    sampler = dataclasses.replace(config.sampler, capacity_per_ray=None)
    return dataclasses.replace(grow_march(config), sampler=sampler, visible_per_ray=None)


def to_image(frame: Frame, background: Float[np.ndarray, " 3"] | float = 1.0) -> Float[np.ndarray, "H W 3"]:
    """A frame over a background colour, clipped to [0, 1]."""
    return np.clip(frame.color + (1 - frame.opacity)[..., None] * np.asarray(background), 0, 1)
