"""Whole images, in chunks of rays that hit the cage: host code around the jitted renderer."""

import dataclasses
from functools import cache, partial
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Bool, Float

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.render.camera import TILE, image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.capacity import MAX_GROWTH, all_entries, fit_capacities, grow_march, ray_entries
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import Entries, MarchTables, march_tables
from nimpostor_jax.types import Camera, NeuralImpostor, Rays, RenderOutput

CHUNK = 8192  # rays a call
REPAIR_CHUNK = 1024  # rays a call with buffers of the largest size


class Frame(NamedTuple):
    """A rendered image on the host, fields as in `RenderOutput`."""

    color: Float[np.ndarray, "H W 3"]
    opacity: Float[np.ndarray, "H W"]
    depth: Float[np.ndarray, "H W"]
    coarsened: Bool[np.ndarray, "H W"]


_march_tables = jax.jit(march_tables)


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
    entries, march = all_entries(impostor.mesh, tables, rays, config.march)
    hits = np.flatnonzero(np.asarray(entries.holds)[:, 0] >= 0)
    if not hits.size:
        return config
    config = dataclasses.replace(config, march=march)
    chosen = hits[np.linspace(0, hits.size - 1, CHUNK).round().astype(int)]
    probe = jax.tree.map(lambda x: x[chosen], rays)
    return fit_capacities(impostor.mesh, tables, probe, config)


def render_frame(impostor: NeuralImpostor, camera: Camera, config: RenderConfig) -> Frame:
    """Render one camera.

    Only pixels whose rays hit the cage are shaded, `CHUNK` at a time, so memory does not grow with the image
    beyond its output; a chunk's rays are split over all local devices. Rays whose buffers overflow are
    rendered again, fewer at a time, in larger ones; raises RuntimeError where 2**6 times the given sizes do
    not suffice.
    """
    height, width = camera.height, camera.width
    tables = _march_tables(impostor.mesh)
    rays = _tiled_rays(camera, height, width)
    entries = ray_entries(impostor.mesh, tables, rays, config.march)
    pending = np.flatnonzero(np.asarray(entries.holds)[:, 0] >= 0)
    order = tile_order(height, width)
    dtype, pixels = impostor.mesh.vertices.dtype, height * width
    frame = Frame(
        color=np.zeros((pixels, 3), dtype),
        opacity=np.zeros(pixels, dtype),
        depth=np.zeros(pixels, dtype),
        coarsened=np.zeros(pixels, bool),
    )
    render = _Renderer(impostor, tables)
    chunk = CHUNK * render.num_devices
    for _ in range(MAX_GROWTH + 1):
        chunks, outputs = _spread(pending, chunk), []
        for chosen in chunks:
            padded = np.concatenate([chosen, np.full(chunk - len(chosen), chosen[-1])])
            part = jax.tree.map(lambda x, p=padded: x[p], (rays, entries))
            outputs.append(render(part[0], part[1], config))
        overflowed = []
        for chosen, output in zip(chunks, outputs, strict=True):
            for name, target in frame._asdict().items():
                target[order[chosen]] = np.asarray(getattr(output, name))[: len(chosen)]
            overflowed.append(chosen[np.asarray(output.overflow)[: len(chosen)]])
        pending = np.concatenate(overflowed) if overflowed else pending[:0]
        if not pending.size:
            return Frame(*(x.reshape(height, width, *x.shape[1:]) for x in frame))
        config, chunk = _grow(config), REPAIR_CHUNK * render.num_devices
        entries = None  # the larger config has more slots for them
    raise RuntimeError(
        f"{pending.size} rays need more than {config.march.max_tets_per_ray} tets or "
        f"{config.march.max_entries_per_ray} entries; raise MarchConfig's sizes"
    )


class _Renderer:
    """`render_rays` with the rays split over the local devices, compiled once for all of them."""

    def __init__(self, impostor: NeuralImpostor, tables: MarchTables):
        mesh = _device_mesh()
        self.num_devices = mesh.size
        self._replicas = jax.device_put((impostor, tables), NamedSharding(mesh, P()))
        self._rays = NamedSharding(mesh, P("rays"))

    def __call__(self, rays: Rays, entries: Entries | None, config: RenderConfig) -> RenderOutput:
        """Start rendering; the number of rays is a multiple of the number of devices."""
        return _render_sharded(*self._replicas, *jax.device_put((rays, entries), self._rays), config)


@cache
def _device_mesh() -> Mesh:
    devices = jax.local_devices()
    return jax.make_mesh((len(devices),), ("rays",), axis_types=(AxisType.Auto,), devices=devices)


@partial(jax.jit, static_argnames="config")
def _render_sharded(
    impostor: NeuralImpostor,
    tables: MarchTables,
    rays: Rays,
    entries: Entries | None,
    config: RenderConfig,
) -> RenderOutput:
    @partial(
        jax.shard_map,
        mesh=_device_mesh(),
        in_specs=(P(), P(), P("rays"), P("rays")),
        out_specs=P("rays"),
        check_vma=False,
    )
    def shard(
        impostor: NeuralImpostor, tables: MarchTables, rays: Rays, entries: Entries | None
    ) -> RenderOutput:
        return render_rays(impostor, rays, config, tables=tables, entries=entries)

    return shard(impostor, tables, rays, entries)


def _spread(rays: np.ndarray, chunk: int) -> list[np.ndarray]:
    """Chunks of rays, each of image tiles from all over the picture, so that all need about equal buffers."""
    tile = TILE * TILE
    tiles = [rays[i : i + tile] for i in range(0, len(rays), tile)]
    order = np.random.default_rng(0).permutation(len(tiles))
    per_chunk = chunk // tile
    hands = [order[i : i + per_chunk] for i in range(0, len(order), per_chunk)]
    return [np.concatenate([tiles[j] for j in hand]) for hand in hands]


def _grow(config: RenderConfig) -> RenderConfig:
    sampler = dataclasses.replace(config.sampler, capacity_per_ray=None)
    return dataclasses.replace(grow_march(config), sampler=sampler)


def to_image(frame: Frame, background: Float[np.ndarray, " 3"] | float = 1.0) -> Float[np.ndarray, "H W 3"]:
    """A frame over a background colour, clipped to [0, 1]."""
    return np.clip(frame.color + (1 - frame.opacity)[..., None] * np.asarray(background), 0, 1)
