"""Refining face textures, and decoders, on whole pictures (Sec. 3.4).

A batch looks up few of the texels, and fewer where light reaches. Those are taken out into small tables,
differentiated and put back, so that a step costs neither time nor memory in proportion to all of them.

Axes: N packed segments, M texels that a batch looks up.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, for_chunks, map_used, pack_where, pad_items, rows_of, take
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import texels_around
from nimpostor_jax.render.baked import lit_segments, shade_segments
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import blend_background
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.train.row_adam import RowMoments, no_row_moments, update_rows
from nimpostor_jax.train.step import RayBatch, make_optimizer
from nimpostor_jax.types import BakedImpostor, FaceLayout

TABLES = ("depths", "opacities", "textures")
Tables = dict[str, Float[Array, "texels F"]]


@struct.dataclass
class RefineState:
    """What a step of refinement changes."""

    tables: Tables
    moments: dict[str, RowMoments]
    decoders: dict[str, Any]
    decoder_moments: optax.OptState


def init_refinement(baked: BakedImpostor) -> RefineState:
    """The state before the first step, of the arrays of `baked` themselves."""
    tables = {name: getattr(baked, name).features for name in TABLES}
    return RefineState(
        tables=tables,
        moments={name: no_row_moments(table) for name, table in tables.items()},
        decoders=baked.decoders,
        decoder_moments=make_optimizer().init(baked.decoders),
    )


def with_tables(
    baked: BakedImpostor, tables: Tables, layouts: dict[str, FaceLayout] | None = None
) -> BakedImpostor:
    """The baked impostor with its tables' arrays replaced, and their layouts where these are given."""
    replaced = {name: dataclasses.replace(getattr(baked, name), features=tables[name]) for name in TABLES}
    for name, layout in (layouts or {}).items():
        replaced[name] = dataclasses.replace(replaced[name], layout=layout)
    return dataclasses.replace(baked, **replaced)


def count_lit(baked: BakedImpostor, batch: RayBatch, config: RenderConfig) -> Int[Array, ""]:
    """How many segments of a batch light reaches: what `refine_step` needs room for."""
    segments = march_segments(baked.mesh, to_local(baked.mesh, batch.rays), config, entries=batch.entries)
    return lit_segments(baked, segments, config.min_weight)[2]


def refine_step(
    state: RefineState,
    baked: BakedImpostor,
    batch: RayBatch,
    rate: Float[Array, ""],
    decoder_rate: Float[Array, ""],
    *,
    config: RenderConfig,
    lit_per_ray: int | None = None,
) -> tuple[RefineState, Float[Array, " 2"]]:
    """One step of Adam on a batch; and its photometric loss before it, and the share of rays that do not fit.

    These are left out; among them those whose segments that light reaches do not fit into `lit_per_ray` slots
    a ray. Of `baked` all counts but what the state holds. Pure.
    """
    rays = to_local(baked.mesh, batch.rays)
    segments = march_segments(baked.mesh, rays, config, entries=batch.entries)
    whole = with_tables(baked, state.tables)
    room = None if lit_per_ray is None else lit_per_ray * batch.jitter.size
    segments, places, num_segments = lit_segments(whole, segments, config.min_weight, room)
    tet_ids, num_texels = jnp.maximum(segments.tet_ids, 0), len(whole.depths.features)
    layout: FaceLayout = whole.depths.layout  # type: ignore[assignment]
    entered, seen = (
        looked_up(layout, num_texels, tet_ids, points, num_segments)
        for points in (segments.lambda_enter, places)
    )
    taken = dict(zip(TABLES, (entered, seen, seen), strict=True))
    part = {name: map_used(rows_of, state.tables[name], at.rows, at.num_used) for name, at in taken.items()}
    layouts = {name: at.layout for name, at in taken.items()}

    def loss(part: Tables, decoders: dict[str, Any]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        small = dataclasses.replace(with_tables(baked, part, layouts), decoders=decoders)
        output = shade_segments(small, rays, segments, config)
        color = blend_background(output.color, output.opacity, batch.background)
        target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
        return photometric(color, target, output.overflow), jnp.mean(output.overflow)

    found, gradients = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(part, state.decoders)
    tables, moments = {}, {}
    for name, at in taken.items():
        tables[name], moments[name] = update_rows(
            state.tables[name], state.moments[name], at.rows, gradients[0][name], at.num_used, rate
        )
    updates, decoder_moments = make_optimizer().update(gradients[1], state.decoder_moments)
    decoders = jax.tree.map(lambda p, u: p - decoder_rate * u, state.decoders, updates)
    return RefineState(tables, moments, decoders, decoder_moments), jnp.stack(found)


class LookedUp(NamedTuple):
    """Texels, each once, and the layout of a table of these alone."""

    rows: Int[Array, " M"]
    layout: FaceLayout
    num_used: Int[Array, ""]  # of the rows


def looked_up(
    layout: FaceLayout,
    num_texels: int,
    tet_ids: Int[Array, " N"],
    points: Float[Array, "N 4"],
    num_used: Int[Array, ""],
) -> LookedUp:
    """The texels around the first points, which lie on faces.

    There is room for all that could be. Work and memory follow the points, but for one number a texel: 0 for
    texels that are not there. Nobody may ask for them.
    """
    wanted = map_used(_texels_of, layout, (tet_ids, points), num_used)
    wanted, num_wanted = wanted.reshape(-1), wanted.shape[1] * num_used
    positions = jnp.arange(wanted.size, dtype=jnp.int32)
    # All write their position where they point to. One of them is found there afterwards: it stands for all.
    owners = _write(jnp.zeros(num_texels, jnp.int32), wanted, num_wanted)
    chosen, count = pack_where(_is_owner, owners, (wanted, positions), num_wanted)
    rows = map_used(rows_of, wanted, chosen[:num_texels], count)
    return LookedUp(rows, dataclasses.replace(layout, rows=_write(owners, rows, count)), count)


def _texels_of(layout: FaceLayout, part: tuple) -> Int[Array, "chunk 3"]:
    return jnp.stack(texels_around(layout, *part)[1], axis=1)


def _is_owner(owners: Int[Array, " texels"], part: tuple) -> Bool[Array, " chunk"]:
    texels, positions = part
    return owners[texels] == positions


def _write(
    into: Int[Array, " texels"], at: Int[Array, " n"], num_used: Int[Array, ""]
) -> Int[Array, " texels"]:
    """`into` with each position in `at` written where `at` points to; any of them where several do."""
    count, chunk = at.size, default_chunk(at.size)
    at, order = pad_items(at, chunk), jnp.arange(chunk, dtype=jnp.int32)

    def write(start: Int[Array, ""], into: Int[Array, " texels"]) -> Int[Array, " texels"]:
        here = jnp.where(start + order < num_used, take(at, start, chunk), into.size)
        return into.at[here].set(start + order, mode="drop")

    return for_chunks(num_used, count, chunk, write, into)
