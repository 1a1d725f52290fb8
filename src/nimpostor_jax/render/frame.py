"""Whole images, in chunks of rays that hit the cage: host code around the jitted renderer."""

import dataclasses
from functools import partial

import jax
import numpy as np
from jaxtyping import Float

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.capacity import MAX_GROWTH, fit_capacities, grow_march, rays_hit
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.types import Camera, NeuralImpostor, Rays, RenderOutput

TILE = 16  # pixels; rays are rendered tile by tile, so that neighbours march together
CHUNK = 8192  # rays a call
PROBE = 2048  # rays from which buffer sizes are measured

_march_tables = jax.jit(march_tables)
_render = jax.jit(render_rays, static_argnames="config")


@partial(jax.jit, static_argnames=("height", "width"))
def _tiled_rays(camera: Camera, height: int, width: int) -> Rays:
    return pixel_rays(camera, _tiled_pixels(height, width))


def _tile_order(height: int, width: int) -> np.ndarray:
    """Pixel indices tile by tile."""
    y, x = np.mgrid[0:height, 0:width]
    return np.lexsort(((x % TILE).ravel(), (y % TILE).ravel(), (x // TILE).ravel(), (y // TILE).ravel()))


def _tiled_pixels(height: int, width: int) -> jax.Array:
    return image_pixels(height, width).reshape(-1, 2)[_tile_order(height, width)]


def frame_config(impostor: NeuralImpostor, camera: Camera, config: RenderConfig, seed: int = 0) -> RenderConfig:
    """`config` with buffer sizes that fit this camera's view; use it for a whole animation.

    Sizes are measured on a random share of the pixels that hit the cage. `render_frame` re-renders with
    larger buffers what overflows nevertheless.
    """
    tables = _march_tables(impostor.mesh)
    rays = _tiled_rays(camera, camera.height, camera.width)
    hits = np.flatnonzero(rays_hit(impostor.mesh, tables, rays, config.march))
    if not hits.size:
        return config
    chosen = np.random.default_rng(seed).choice(hits, PROBE)
    probe = jax.tree.map(lambda x: x[np.sort(chosen)], rays)
    return fit_capacities(impostor.mesh, tables, probe, config)


def render_frame(impostor: NeuralImpostor, camera: Camera, config: RenderConfig) -> RenderOutput:
    """Render one camera: arrays of shape [height, width, ...], NumPy.

    Only pixels whose rays hit the cage are shaded, `CHUNK` at a time, so memory does not grow with the image
    beyond its output. Chunks whose buffers overflow are rendered again with larger ones; raises RuntimeError
    where 2**6 times the given sizes do not suffice. On several devices the chunks take turns.
    """
    height, width = camera.height, camera.width
    tables = _march_tables(impostor.mesh)
    rays = _tiled_rays(camera, height, width)
    hits = np.flatnonzero(rays_hit(impostor.mesh, tables, rays, config.march))
    devices = jax.local_devices() if jax.default_backend() == "cpu" else jax.local_devices()[:1]
    chunk = min(CHUNK, max(TILE * TILE, -(-len(hits) // len(devices))))
    replicas = [jax.device_put((impostor, tables), device) for device in devices]

    def submit(chosen: np.ndarray, turn: int, config: RenderConfig) -> RenderOutput:
        device = turn % len(devices)
        chunk_rays = jax.device_put(jax.tree.map(lambda x: x[chosen], rays), devices[device])
        replica, replica_tables = replicas[device]
        return _render(replica, chunk_rays, config, tables=replica_tables)

    chunks = [_padded(hits[start : start + chunk], chunk) for start in range(0, len(hits), chunk)]
    outputs = [submit(chosen, turn, config) for turn, chosen in enumerate(chunks)]
    order = _tile_order(height, width)
    dtype = impostor.mesh.vertices.dtype
    frame = RenderOutput(
        color=np.zeros((height * width, 3), dtype),
        opacity=np.zeros(height * width, dtype),
        depth=np.zeros(height * width, dtype),
        overflow=np.zeros(height * width, bool),
        coarsened=np.zeros(height * width, bool),
    )
    for turn, (chosen, output) in enumerate(zip(chunks, outputs, strict=True)):
        larger = config
        for _ in range(MAX_GROWTH):
            if not np.any(output.overflow):
                break
            larger = _grow(larger)
            output = submit(chosen, turn, larger)
        else:
            raise RuntimeError(
                f"{int(np.sum(output.overflow))} of {len(chosen)} rays need more than "
                f"{larger.march.max_tets_per_ray} tets; raise MarchConfig.max_tets_per_ray"
            )
        for target, source in zip(jax.tree.leaves(frame), jax.tree.leaves(output), strict=True):
            target[order[chosen]] = np.asarray(source)
    return jax.tree.map(lambda x: x.reshape(height, width, *x.shape[1:]), frame)


def _padded(chosen: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([chosen, np.full(size - len(chosen), chosen[-1])])


def _grow(config: RenderConfig) -> RenderConfig:
    sampler = dataclasses.replace(config.sampler, capacity_per_ray=None)
    return dataclasses.replace(grow_march(config), sampler=sampler, visible_per_ray=None)


def to_image(output: RenderOutput, background: Float[np.ndarray, " 3"] | float = 1.0) -> Float[np.ndarray, "H W 3"]:
    """A frame over a background colour, clipped to [0, 1]."""
    return np.clip(output.color + (1 - output.opacity)[..., None] * np.asarray(background), 0, 1)
