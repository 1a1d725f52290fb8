"""Whole images of baked impostors by rasterization, tile by tile: host code around `rasterize`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.geometry.tetrahedron import corners, signed_volumes
from nimpostor_jax.render.baked import shade_segments
from nimpostor_jax.render.camera import TILE, to_local
from nimpostor_jax.render.capacity import MAX_GROWTH, grow_march
from nimpostor_jax.render.frame import Frame, dealt, device_mesh, empty_outputs
from nimpostor_jax.render.rasterize import (
    Screen,
    TileLists,
    bin_tets,
    rasterize,
    tile_rays,
    tiles_of,
    to_screen,
)
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.types import BakedImpostor, Camera, RenderOutput

CHUNK = 32  # tiles a call
FLAT = 1e-6  # volume, of the cube around a tet, that rounding may give a sliver
MAX_TETS_PER_TILE = 1 << 15  # a device needs some 30 kB for each: a few numbers for each pixel and edge

_to_screen = jax.jit(to_screen)
_bin_tets = jax.jit(bin_tets, static_argnames="capacity")


def rasterize_frame(baked: BakedImpostor, camera: Camera, config: RenderConfig) -> Frame:
    """Render one camera by rasterization; with a config of `frame_config`, `render_frame`'s picture.

    Of that only the march's sizes, `near` and `min_weight` matter. Tiles with pixels that see more tets than
    there are layers are done again with more. Raises ValueError where a tet's vertex is not in front of the
    camera, where tets are inverted (a walk passes what they cover once, a rasterizer three times), or where
    more than `MAX_TETS_PER_TILE` meet in one tile of pixels; RuntimeError where 2**6 times the given sizes do
    not suffice.
    """
    positions = corners(baked.mesh.vertices, baked.mesh.tets)
    extents = np.max(np.ptp(np.asarray(positions), axis=1), axis=1)
    inverted = np.flatnonzero(np.asarray(signed_volumes(positions)) < -FLAT * extents**3)
    if inverted.size:
        raise ValueError(f"{inverted.size} tets are inverted; first: {inverted[0]}; use render_frame")
    screen, depth = _to_screen(baked.mesh, camera)
    used = np.unique(np.asarray(baked.mesh.tets))
    behind = used[~(np.asarray(depth)[used] > 0)]
    if behind.size:
        raise ValueError(
            f"{behind.size} vertices of the cage are not in front of the camera; first: {behind[0]}; "
            "move the camera back, or use render_frame"
        )
    lists = _all_lists(baked, screen, camera)
    lengths = np.diff(np.asarray(lists.starts))
    if lengths.max() > MAX_TETS_PER_TILE:
        raise ValueError(
            f"{lengths.max()} tets meet in one tile of {TILE} x {TILE} pixels, more than "
            f"{MAX_TETS_PER_TILE}; render more pixels, or use render_frame"
        )
    tets_per_tile = _rounded(int(lengths.max()))
    pending = np.random.default_rng(0).permutation(np.flatnonzero(lengths))
    rows, columns = tiles_of(camera)
    results = {
        name: np.zeros((rows * columns, TILE * TILE, *x.shape[1:]), x.dtype)
        for name, x in empty_outputs(1, baked.mesh.vertices.dtype).items()
    }
    mesh = device_mesh()
    chunk = CHUNK * mesh.size
    replicas = jax.device_put((baked, camera, screen, lists), NamedSharding(mesh, P()))
    for _ in range(MAX_GROWTH + 1):
        parts = [pending[i : i + chunk] for i in range(0, len(pending), chunk)]
        outputs, slots = [], [dealt(len(part), chunk, mesh.size, 1) for part in parts]
        for part, places in zip(parts, slots, strict=True):
            tiles = np.full(chunk, -1, np.int32)
            tiles[places] = part
            placed = jax.device_put(tiles, NamedSharding(mesh, P("rays")))
            outputs.append(_render_tiles(*replicas, placed, config, tets_per_tile))
        again = [pending[:0]]
        for part, places, output in zip(parts, slots, outputs, strict=True):
            for name, target in results.items():
                value = np.asarray(getattr(output, name))
                target[part] = value.reshape(chunk, TILE * TILE, *value.shape[1:])[places]
            again.append(part[np.asarray(output.overflow).reshape(chunk, -1)[places].any(axis=1)])
        pending = np.concatenate(again)
        if not pending.size:
            return Frame(**{name: _image(x, camera) for name, x in results.items()})
        tried, config = config, grow_march(config)
    raise RuntimeError(
        f"pixels in {pending.size} tiles see more than {tried.march.max_tets_per_ray} tets; "
        "raise MarchConfig.max_tets_per_ray"
    )


def _all_lists(baked: BakedImpostor, screen: Screen, camera: Camera) -> TileLists:
    """The tets of all tiles, in as large a buffer as they need."""
    capacity = _rounded(4 * len(baked.mesh.tets))
    while True:
        lists = _bin_tets(baked.mesh, screen, camera, capacity)
        if lists.num_pairs <= capacity:
            return lists
        capacity = _rounded(int(lists.num_pairs))


def _rounded(count: int) -> int:
    """Up to a power of two or one and a half of it: few different programs."""
    size = 16
    while size < count:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def _image(tiled: np.ndarray, camera: Camera) -> np.ndarray:
    """[tiles, pixels, ...] as [H, W, ...]."""
    rows, columns = tiles_of(camera)
    grid = tiled.reshape(rows, columns, TILE, TILE, *tiled.shape[2:])
    image = np.moveaxis(grid, 2, 1).reshape(rows * TILE, columns * TILE, *tiled.shape[2:])
    return image[: camera.height, : camera.width]


@partial(jax.jit, static_argnames=("config", "tets_per_tile"))
def _render_tiles(
    baked: BakedImpostor,
    camera: Camera,
    screen: Screen,
    lists: TileLists,
    tiles: Int[Array, " n"],
    config: RenderConfig,
    tets_per_tile: int,
) -> RenderOutput:
    """Outputs of the tiles' pixels; a tile -1 sees nothing."""

    @partial(
        jax.shard_map,
        mesh=device_mesh(),
        in_specs=(P(), P(), P(), P(), P("rays")),
        out_specs=P("rays"),
        check_vma=False,
    )
    def shard(
        baked: BakedImpostor, camera: Camera, screen: Screen, lists: TileLists, tiles: Int[Array, " n"]
    ) -> RenderOutput:
        layers = config.march.max_tets_per_ray
        crossings = rasterize(
            baked.mesh, camera, screen, lists, tiles, tets_per_tile=tets_per_tile, layers=layers
        )
        rays = to_local(baked.mesh, tile_rays(camera, jnp.maximum(tiles, 0)))
        capacity = (config.march.capacity_per_ray or layers) * rays.origins.shape[0]
        near = config.near / baked.mesh.scale
        segments = locate_segments(baked.mesh, rays, crossings, near, capacity)
        return shade_segments(baked, rays, segments, config)

    return shard(baked, camera, screen, lists, tiles)
