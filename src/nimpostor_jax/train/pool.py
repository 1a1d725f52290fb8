"""The pixels to train on: those of all views whose rays hit the cage, as one pool to draw batches from."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import Background, MarchConfig
from nimpostor_jax.render.camera import image_pixels, pixel_rays, tile_order
from nimpostor_jax.render.capacity import all_entries
from nimpostor_jax.render.traverse import Entries, march_tables
from nimpostor_jax.train.step import RayBatch
from nimpostor_jax.types import Camera, TetMesh

OPACITY_COST = 1e-3  # of an opaque pixel whose alpha is unknown, in units of squared colour


@struct.dataclass
class PackedEntries:
    """`Entries` of P rays without empty slots: most enter a cage in pieces far less often than the worst."""

    holds: Int[Array, " total"]
    firsts: Int[Array, " P+1"]  # of each ray's; the last is the total
    overflow: Bool[Array, " P"]
    slots: int = struct.field(pytree_node=False)  # that the worst ray needs

    def of(self, rays: Int[Array, " n"]) -> Entries:
        """Entries of some of the rays."""
        slots = jnp.arange(self.slots, dtype=jnp.int32)
        firsts, ends = (self.firsts[rays + i][:, None] for i in (0, 1))
        holds = self.holds[jnp.minimum(firsts + slots, self.holds.size - 1)]
        return Entries(
            holds=jnp.where(firsts + slots < ends, holds, -1),
            overflow=self.overflow[rays],
        )

    def take(self, rays: Int[np.ndarray, " n"]) -> "PackedEntries":
        """These rays alone. Host code."""
        firsts = np.asarray(self.firsts)
        counts = np.diff(firsts)[rays]
        ends = np.cumsum(counts)
        places = np.repeat(firsts[rays] - (ends - counts), counts) + np.arange(counts.sum())
        return PackedEntries(
            holds=self.holds[places],
            firsts=jnp.asarray(np.concatenate([[0], ends]), jnp.int32),
            overflow=self.overflow[rays],
            slots=self.slots,
        )


@struct.dataclass
class PixelPool:
    """P pixels of N views."""

    views: Int[Array, " P"]
    pixels: Int[Array, "P 2"]  # x, y
    colors: Float[Array, "P 4"]  # premultiplied
    entries: PackedEntries  # into the cage: pixels and cage stay, so that they are sought once
    cameras: Camera  # batched over N
    backgrounds: Float[Array, "P 3"] | None = None  # behind the object, where that is known

    def take(self, pixels: Int[np.ndarray, " n"]) -> "PixelPool":
        """These pixels alone. Host code."""
        return dataclasses.replace(
            self,
            views=self.views[pixels],
            pixels=self.pixels[pixels],
            colors=self.colors[pixels],
            entries=self.entries.take(pixels),
            backgrounds=None if self.backgrounds is None else self.backgrounds[pixels],
        )


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
    tables = march_tables(mesh)
    order = tile_order(cameras.height, cameras.width)
    grid = image_pixels(cameras.height, cameras.width).reshape(-1, 2)[order]
    cast = jax.jit(lambda camera: pixel_rays(camera, grid))
    views, indices, entries, counts, missed, foreground = [], [], [], [], 0, 0
    for view in range(len(images)):
        rays = cast(_one(cameras, view))
        found, grown = all_entries(mesh, tables, rays, march)
        march = max(march, grown, key=lambda config: config.max_entries_per_ray)
        hits = np.zeros(len(order), bool)
        hits[order] = np.asarray(found.holds)[:, 0] >= 0
        solid = images[view, ..., 3].reshape(-1) > 0.5
        missed += int(np.sum(solid & ~hits))
        foreground += int(np.sum(solid))
        indices.append(np.flatnonzero(hits).astype(np.int32))
        views.append(np.full(len(indices[-1]), view, np.int32))
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        kept = jax.tree.map(lambda x, rows=rank[indices[-1]]: np.asarray(x)[rows], found)
        filled = kept.holds >= 0
        entries.append(dataclasses.replace(kept, holds=kept.holds[filled]))
        counts.append(np.sum(filled, axis=1))
    if not sum(map(len, indices)):
        raise ValueError(
            f"no pixel of {len(images)} views hits the cage; is it in the cameras' world coordinates?"
        )
    view_ids, pixel_ids = np.concatenate(views), np.concatenate(indices)
    flat = images.reshape(len(images), -1, 4)
    behind = None if backgrounds is None else backgrounds.reshape(len(images), -1, 3)
    pool = PixelPool(
        views=jnp.asarray(view_ids),
        pixels=jnp.asarray(np.stack([pixel_ids % cameras.width, pixel_ids // cameras.width], axis=1)),
        colors=jnp.asarray(flat[view_ids, pixel_ids]),
        entries=_packed(entries, np.concatenate(counts)),
        cameras=cameras,
        backgrounds=None if behind is None else jnp.asarray(behind[view_ids, pixel_ids]),
    )
    return pool, missed / max(foreground, 1)


def _packed(parts: list[Entries], counts: Int[np.ndarray, " P"]) -> PackedEntries:
    """Entries of all views, whose `holds` have no empty slots any more."""
    joined = jax.tree.map(lambda *leaves: jnp.asarray(np.concatenate(leaves)), *parts)
    return PackedEntries(
        holds=joined.holds,
        firsts=jnp.asarray(np.concatenate([[0], np.cumsum(counts)]), jnp.int32),
        overflow=joined.overflow,
        slots=int(counts.max()),
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
        entries=pool.entries.of(chosen),
        opacity_cost=None if known is None else jnp.full((size,), OPACITY_COST, colors.dtype),
    )
