"""Whole images, in chunks of rays that hit the cage: host code around the jitted renderer."""

import dataclasses
import math
from functools import cache, partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Bool, Float, Int

from nimpostor_jax.config import MarchConfig, RenderConfig
from nimpostor_jax.field.impostor import merge_levels
from nimpostor_jax.render.baked import render_baked_rays
from nimpostor_jax.render.camera import TILE, image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.capacity import MAX_GROWTH, all_entries, fit_capacities, grow_march, ray_entries
from nimpostor_jax.render.occupancy import Slabs
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.sampling import known_step, with_step
from nimpostor_jax.render.selection import slabs_of
from nimpostor_jax.render.traverse import Entries, MarchTables, march_tables
from nimpostor_jax.types import BakedImpostor, Camera, NeuralImpostor, Rays, RenderOutput, TetMesh

CHUNK = 8192  # rays a call
MAX_REFINEMENT = 32  # of the steps, to meet a tolerance
REPAIR_CHUNK = 1024  # rays a call with buffers of the largest size

Rendered = TypeVar("Rendered", NeuralImpostor, BakedImpostor)
Tree = TypeVar("Tree")


class Frame(NamedTuple):
    """A rendered image on the host, fields as in `RenderOutput`."""

    color: Float[np.ndarray, "H W 3"]
    opacity: Float[np.ndarray, "H W"]
    depth: Float[np.ndarray, "H W"]
    coarsened: Bool[np.ndarray, "H W"]
    error: Float[np.ndarray, "H W"] | None = None  # estimated, where a tolerance was given


_slabs_of = jax.jit(slabs_of, static_argnames="config")


@partial(jax.jit, static_argnames=("height", "width"))
def _tiled_rays(camera: Camera, height: int, width: int) -> Rays:
    return pixel_rays(camera, _tiled_pixels(height, width))


def _tiled_pixels(height: int, width: int) -> jax.Array:
    return image_pixels(height, width).reshape(-1, 2)[tile_order(height, width)]


def for_frames(impostor: Rendered, max_megabytes: float = 512) -> Rendered:
    """The same impostor as many frames want it: levels merged (`field.merge_levels`), on all local devices.

    For rendering only, whether levels could be merged or not; it can be deformed. Merging takes about as long
    as half a frame of 800 x 800, so it pays for animations and large images. The memory is that of all
    devices together, each of which has a copy; a CPU with `use_all_cores` has a device a core. A baked
    impostor, which has no levels, is only copied.
    """
    if isinstance(impostor, BakedImpostor):
        return on_all_devices(impostor)
    return on_all_devices(merge_levels(impostor, max_megabytes / device_mesh().size))


def on_all_devices(arrays: Tree) -> Tree:
    """A pytree copied to all local devices now, and not again for each frame."""
    return jax.device_put(arrays, NamedSharding(device_mesh(), P()))


def frame_config(
    impostor: NeuralImpostor | BakedImpostor, camera: Camera, config: RenderConfig
) -> RenderConfig:
    """`config` with a frame's steps and buffers that fit this camera's view; use it for a whole animation.

    Sizes are measured on pixels spread over those that hit the cage. What overflows nevertheless,
    `render_frame` renders again. Where features are integrated, `min_weight` becomes 0
    (`capacity.fit_capacities`). Raises ValueError as `sampling.with_step`.
    """
    config = refined(with_step(config, impostor.config.encoding))
    tables = march_tables(impostor.mesh)
    rays = _tiled_rays(camera, camera.height, camera.width)
    entries, march = all_entries(impostor.mesh, tables, rays, config.march)
    hits = np.flatnonzero(np.asarray(entries.holds)[:, 0] >= 0)
    if not hits.size:
        return config
    config = dataclasses.replace(config, march=march)
    chosen = hits[np.linspace(0, hits.size - 1, CHUNK).round().astype(int)]
    probe = jax.tree.map(lambda x: x[chosen], rays)
    field = None if isinstance(impostor, BakedImpostor) else impostor
    return fit_capacities(impostor.mesh, tables, probe, config, field=field)


def refined(config: RenderConfig) -> RenderConfig:
    """A config that has a step with the steps of frames; once is enough."""
    factor, sampler = config.frame_refinement, config.sampler
    most = math.ceil(factor * sampler.max_samples_per_ray)
    mean = sampler.capacity_per_ray and math.ceil(factor * sampler.capacity_per_ray)
    sampler = dataclasses.replace(
        sampler,
        step=known_step(sampler) / factor,
        cone_angle=sampler.cone_angle / factor**2,  # growth a step: of smaller steps, and of more of them
        max_samples_per_ray=most,
        capacity_per_ray=mean,
        occupied_per_ray=sampler.occupied_per_ray and math.ceil(factor * sampler.occupied_per_ray),
    )
    # A sample's weight is in proportion to its step.
    return dataclasses.replace(
        config, sampler=sampler, min_weight=config.min_weight / factor, frame_refinement=1.0
    )


def render_frame(
    impostor: NeuralImpostor | BakedImpostor,
    camera: Camera,
    config: RenderConfig,
    tolerance: float | None = None,
) -> Frame:
    """Render one camera, of a baked impostor by marching through its tets.

    Only pixels whose rays hit the cage are shaded, `CHUNK` at a time, so memory does not grow with the image
    beyond its rays and output; a chunk's rays are split over all local devices. Rays whose buffers overflow
    are rendered again, fewer at a time, in larger ones; raises RuntimeError where 2**6 times the given sizes
    do not suffice.

    With a `tolerance`, each pixel's steps are halved until that hardly changes its colour and opacity: by a
    32nd of the tolerance, or by half of it after a change within it. The last change is returned as `error`;
    it is larger where 1 / `MAX_REFINEMENT` of the steps did not suffice. One small change is no proof: two
    coarse quadratures may miss the same detail. Samples below a 32nd of the tolerance are left out, and those
    below `min_weight`. Raises ValueError for a tolerance that is not positive.
    """
    height, width = camera.height, camera.width
    config = refined(with_step(config, impostor.config.encoding))
    if tolerance is not None:
        if not tolerance > 0:
            raise ValueError(f"tolerance must be > 0, got {tolerance}")
        most = MAX_REFINEMENT * config.sampler.max_samples_per_ray
        sampler = dataclasses.replace(config.sampler, max_samples_per_ray=most)
        least = min(config.min_weight, tolerance / 32)
        config = dataclasses.replace(config, sampler=sampler, min_weight=least)
    view = View(impostor, camera, config)
    pixels, order = view.hits, tile_order(height, width)
    output = view.render(pixels)
    frame = {name: np.zeros((height * width, *x.shape[1:]), x.dtype) for name, x in output.items()}
    frame["error"] = np.zeros(height * width, output["opacity"].dtype)

    def write(pixels: np.ndarray, values: dict[str, np.ndarray]) -> None:
        for name, value in values.items():
            frame[name][order[pixels]] = value

    write(pixels, output)
    refinement, before = 2, np.full(len(pixels), np.inf)  # the change by the halving before
    while tolerance is not None and pixels.size and refinement <= MAX_REFINEMENT:
        finer = view.render(pixels, refinement)
        change = np.abs(np.column_stack([finer[name] - output[name] for name in ("color", "opacity")]))
        change = change.max(axis=1)
        write(pixels, finer | {"error": change})
        done = (change <= tolerance / 32) | ((change <= tolerance / 2) & (before <= tolerance))
        pixels, before = pixels[~done], change[~done]
        output = {name: value[~done] for name, value in finer.items()}
        refinement *= 2
    if tolerance is None:
        del frame["error"]
    return Frame(**{name: x.reshape(height, width, *x.shape[1:]) for name, x in frame.items()})


class View:
    """A camera's rays, and `render_rays` of any of them on all local devices, compiled once."""

    def __init__(self, impostor: NeuralImpostor | BakedImpostor, camera: Camera, config: RenderConfig):
        self._impostor, self._config = impostor, config
        self._tables = march_tables(impostor.mesh)
        # On the host, where chunks are picked without a program for each pick.
        self._rays = jax.tree.map(np.asarray, _tiled_rays(camera, camera.height, camera.width))
        mesh = device_mesh()
        self._num_devices = mesh.size
        slabs = None if isinstance(impostor, BakedImpostor) else _slabs_of(impostor, config)
        self._replicas = jax.device_put((impostor, self._tables, slabs), NamedSharding(mesh, P()))
        self._by_ray = NamedSharding(mesh, P("rays"))
        self._entries = self._all_entries()
        self.hits = np.flatnonzero(self._entries.holds[:, 0] >= 0)

    def _all_entries(self) -> Entries:
        """Entries of all of the camera's rays, on the host; whole tiles of them go to each device."""
        count = self._rays.origins.shape[0]
        padding = (0, -count % (TILE * TILE * self._num_devices))
        rays = jax.tree.map(lambda x: np.pad(x, (padding, (0, 0)), mode="edge"), self._rays)
        impostor, tables, _ = self._replicas
        placed = jax.device_put(rays, self._by_ray)
        entries = _entries_sharded(impostor.mesh, tables, placed, self._config.march)
        return jax.tree.map(lambda x: np.asarray(x)[:count], entries)

    def render(self, pixels: np.ndarray, refinement: int = 1) -> dict[str, np.ndarray]:
        """Outputs [len(pixels), ...] by name, with steps divided by `refinement`."""
        config, chunk, first = self._config, CHUNK * self._num_devices, True
        results = empty_outputs(len(pixels), self._impostor.mesh.vertices.dtype)
        pending = np.arange(len(pixels))
        for _ in range(MAX_GROWTH + 1):
            # Finer steps need more room: fewer rays share the buffers, so that nothing compiles again.
            share = chunk if refinement == 1 else chunk // (2 * refinement)
            parts = _spread(pending, share)
            outputs = [self._render_chunk(pixels[part], chunk, config, refinement, first) for part in parts]
            overflowed = [pending[:0]]
            for part, output in zip(parts, outputs, strict=True):
                slots = dealt(len(part), chunk, self._num_devices, TILE * TILE)
                for name, target in results.items():
                    target[part] = np.asarray(getattr(output, name))[slots]
                overflowed.append(part[np.asarray(output.overflow)[slots]])
            pending = np.concatenate(overflowed)
            if not pending.size:
                return results
            tried, config = config, _grow(config)
            chunk, first = REPAIR_CHUNK * self._num_devices, False
        raise RuntimeError(
            f"{pending.size} rays need more than {tried.march.max_tets_per_ray} tets or "
            f"{tried.march.max_entries_per_ray} entries; raise MarchConfig's sizes"
        )

    def _render_chunk(
        self, pixels: np.ndarray, chunk: int, config: RenderConfig, refinement: int, known_entries: bool
    ) -> RenderOutput:
        """Start rendering a chunk; rays that fill it up enter nothing and cost nothing."""
        slots = dealt(len(pixels), chunk, self._num_devices, TILE * TILE)
        padded, used = np.full(chunk, pixels[-1]), np.zeros(chunk, bool)
        padded[slots], used[slots] = pixels, True
        rays = jax.tree.map(lambda x: x[padded], self._rays)
        if known_entries:
            entries = jax.tree.map(lambda x: x[padded], self._entries)
        else:
            entries = ray_entries(self._impostor.mesh, self._tables, rays, config.march)
            entries = jax.tree.map(np.asarray, entries)
        holds = np.where(used[:, None], entries.holds, -1)
        entries = dataclasses.replace(entries, holds=holds, overflow=entries.overflow & used)
        refinements = np.full(chunk, refinement, rays.origins.dtype)
        placed = jax.device_put((rays, entries, refinements), self._by_ray)
        return _render_sharded(*self._replicas, *placed, config)


def dealt(count: int, chunk: int, num_devices: int, size: int) -> Int[np.ndarray, " count"]:
    """Slots of a chunk for `count` items, dealt `size` at a time to devices that have equal blocks of it.

    Where items do not fill a chunk, all devices have about as many, and room for as many more.
    """
    blocks = np.arange(chunk).reshape(num_devices, -1, size)
    return blocks.transpose(1, 0, 2).reshape(-1)[:count]


def empty_outputs(count: int, dtype: np.dtype) -> dict[str, np.ndarray]:
    """What rays that hit nothing see, [count, ...] by the name of `RenderOutput`'s fields."""
    return {
        "color": np.zeros((count, 3), dtype),
        "opacity": np.zeros(count, dtype),
        "depth": np.zeros(count, dtype),
        "coarsened": np.zeros(count, bool),
    }


@cache
def device_mesh() -> Mesh:
    """All local devices in a row, over which rays are split."""
    devices = jax.local_devices()
    return jax.make_mesh((len(devices),), ("rays",), axis_types=(AxisType.Auto,), devices=devices)


@partial(jax.jit, static_argnames="config")
def _entries_sharded(mesh: TetMesh, tables: MarchTables, rays: Rays, config: MarchConfig) -> Entries:
    specs = (P(), P(), P("rays"))

    @partial(jax.shard_map, mesh=device_mesh(), in_specs=specs, out_specs=P("rays"), check_vma=False)
    def shard(mesh: TetMesh, tables: MarchTables, rays: Rays) -> Entries:
        return ray_entries(mesh, tables, rays, config)

    return shard(mesh, tables, rays)


@partial(jax.jit, static_argnames="config")
def _render_sharded(
    impostor: NeuralImpostor | BakedImpostor,
    tables: MarchTables,
    slabs: Slabs | None,
    rays: Rays,
    entries: Entries,
    refinement: Float[jax.Array, " R"],
    config: RenderConfig,
) -> RenderOutput:
    specs = (P(), P(), P(), P("rays"), P("rays"), P("rays"))

    @partial(jax.shard_map, mesh=device_mesh(), in_specs=specs, out_specs=P("rays"), check_vma=False)
    def shard(
        impostor: NeuralImpostor | BakedImpostor,
        tables: MarchTables,
        slabs: Slabs | None,
        rays: Rays,
        entries: Entries,
        refinement: Float[jax.Array, " R"],
    ) -> RenderOutput:
        if isinstance(impostor, BakedImpostor):
            return render_baked_rays(impostor, rays, config, tables, entries)
        return render_rays(
            impostor, rays, config, tables=tables, entries=entries, refinement=refinement, slabs=slabs
        )

    return shard(impostor, tables, slabs, rays, entries, refinement)


def _spread(rays: np.ndarray, chunk: int) -> list[np.ndarray]:
    """Chunks of rays, each of image tiles from all over the picture, so that all need about equal buffers."""
    tile = TILE * TILE
    tiles = [rays[i : i + tile] for i in range(0, len(rays), tile)]
    order = np.random.default_rng(0).permutation(len(tiles))
    per_chunk = max(1, chunk // tile)
    hands = [order[i : i + per_chunk] for i in range(0, len(order), per_chunk)]
    return [np.concatenate([tiles[j] for j in hand]) for hand in hands]


def _grow(config: RenderConfig) -> RenderConfig:
    sampler = dataclasses.replace(config.sampler, capacity_per_ray=None, occupied_per_ray=None)
    return dataclasses.replace(grow_march(config), sampler=sampler)


def to_image(
    frame: Frame, background: Float[np.ndarray, "*#pixels 3"] | float = 1.0
) -> Float[np.ndarray, "H W 3"]:
    """A frame over a background colour or picture, clipped to [0, 1]."""
    return np.clip(frame.color + (1 - frame.opacity)[..., None] * np.asarray(background), 0, 1)
