"""The pixels to train on: those of all views whose rays hit the cage, as one pool to draw batches from."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import Background, MarchConfig
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.capacity import all_entries
from nimpostor_jax.render.traverse import Entries, march_tables
from nimpostor_jax.train.step import RayBatch
from nimpostor_jax.types import Camera, TetMesh

OPACITY_COST = 1e-3  # of an opaque pixel whose alpha is unknown, in units of squared colour


@struct.dataclass
class PixelPool:
    """P pixels of N views."""

    views: Int[Array, " P"]
    pixels: Int[Array, "P 2"]  # x, y
    colors: Float[Array, "P 4"]  # premultiplied
    entries: Entries  # into the cage: pixels and cage stay, so that they are sought once
    cameras: Camera  # batched over N
    backgrounds: Float[Array, "P 3"] | None = None  # behind the object, where that is known


def build_pool(
    mesh: TetMesh,
    cameras: Camera,
    images: Float[np.ndarray, "N H W 4"],
    march: MarchConfig,
    backgrounds: Float[np.ndarray, "N H W 3"] | None = None,
) -> tuple[PixelPool, float]:
    """Pixels whose rays hit the cage, and the share of foreground pixels (alpha > 0.5) that do not.

    Raises ValueError where no pixel hits the cage.
    """
    tables = jax.jit(march_tables)(mesh)
    order = tile_order(cameras.height, cameras.width)
    grid = image_pixels(cameras.height, cameras.width).reshape(-1, 2)[order]
    cast = jax.jit(lambda camera: pixel_rays(camera, grid))
    views, indices, entries, missed, foreground = [], [], [], 0, 0
    for view in range(len(images)):
        rays = cast(_one(cameras, view))
        found, grown = all_entries(mesh, tables, rays, march)
        march = max(march, grown, key=lambda config: config.max_entries_per_ray)
        hits = np.zeros(len(order), bool)
        hits[order] = np.asarray(found.holds)[:, 0] >= 0
        solid = images[view, ..., 3].reshape(-1) > 0.5
        missed += int(np.sum(solid & ~hits))
        foreground += int(np.sum(solid))
        indices.append(np.flatnonzero(hits))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        entries.append(jax.tree.map(lambda x, kept=rank[indices[-1]]: np.asarray(x)[kept], found))
        views.append(np.full(len(indices[-1]), view))
    if not sum(map(len, indices)):
        raise ValueError(
            f"no pixel of {len(images)} views hits the cage; is it in the cameras' world coordinates?"
        )
    view_ids, pixel_ids = np.concatenate(views), np.concatenate(indices)
    flat = images.reshape(len(images), -1, 4)
    behind = None if backgrounds is None else backgrounds.reshape(len(images), -1, 3)
    pool = PixelPool(
        views=jnp.asarray(view_ids, jnp.int32),
        pixels=jnp.asarray(
            np.stack([pixel_ids % cameras.width, pixel_ids // cameras.width], axis=1), jnp.int32
        ),
        colors=jnp.asarray(flat[view_ids, pixel_ids]),
        entries=_concatenated(entries),
        cameras=cameras,
        backgrounds=None if behind is None else jnp.asarray(behind[view_ids, pixel_ids]),
    )
    return pool, missed / max(foreground, 1)


def _concatenated(parts: list[Entries]) -> Entries:
    """Entries of all views, in the slots that the fullest needs; on the host, since shapes differ by view."""
    slots = max(part.holds.shape[1] for part in parts)
    holds = [np.pad(p.holds, ((0, 0), (0, slots - p.holds.shape[1])), constant_values=-1) for p in parts]
    return Entries(
        holds=jnp.asarray(np.concatenate(holds)),
        overflow=jnp.asarray(np.concatenate([part.overflow for part in parts])),
        unsure=jnp.asarray(np.concatenate([part.unsure for part in parts])),
    )


def _one(cameras: Camera, view: int) -> Camera:
    return jax.tree.map(lambda x: x[view], cameras)


@partial(jax.jit, static_argnames=("size", "background"))
def draw_batch(
    key: Array, step: Int[Array, ""] | int, pool: PixelPool, size: int, background: Background
) -> RayBatch:
    """A batch of pixels drawn uniformly with replacement; a function of key and step alone.

    What is known to be behind a pixel stands in the place of `background`. Its alpha is unknown then, so
    opacity has a cost: a field of the background's own colours would explain empty space as well.
    """
    choice_key, background_key, jitter_key = jax.random.split(jax.random.fold_in(key, step), 3)
    chosen = jax.random.randint(choice_key, (size,), 0, pool.views.shape[0])
    cameras = jax.tree.map(lambda x: x[pool.views[chosen]], pool.cameras)
    rays = pixel_rays(cameras, pool.pixels[chosen] + 0.5)
    known = pool.backgrounds
    if known is not None:
        colors = known[chosen]
    elif background == "random":
        colors = jax.random.uniform(background_key, (size, 3))
    else:
        colors = jnp.full((size, 3), 1.0 if background == "white" else 0.0)
    return RayBatch(
        rays=rays,
        target=pool.colors[chosen],
        background=colors,
        jitter=jax.random.uniform(jitter_key, (size,)),
        entries=jax.tree.map(lambda x: x[chosen], pool.entries),
        opacity_cost=None if known is None else jnp.full((size,), OPACITY_COST, colors.dtype),
    )
