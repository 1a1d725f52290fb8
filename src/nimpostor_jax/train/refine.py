"""Refining face textures, and decoders, on whole pictures (Sec. 3.4).

A batch looks up few of the texels, and fewer where light reaches. Those are taken out into small tables,
differentiated and put back, so that a step costs neither time nor memory in proportion to all of them.

Axes: N packed segments, M texels that a batch looks up.
"""

import dataclasses
from typing import Any

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
from nimpostor_jax.types import BakedImpostor, FaceLayout, HashTables, TetSegments

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


def with_tables(baked: BakedImpostor, tables: Tables, layout: FaceLayout | None = None) -> BakedImpostor:
    """The baked impostor with its tables' arrays replaced, and their layout where that is given."""
    changes: dict[str, Any] = {} if layout is None else {"layout": layout}
    named = {
        name: dataclasses.replace(getattr(baked, name), features=tables[name], **changes) for name in TABLES
    }
    return dataclasses.replace(baked, **named)


def refine_step(
    state: RefineState,
    baked: BakedImpostor,
    batch: RayBatch,
    rate: Float[Array, ""],
    decoder_rate: Float[Array, ""],
    *,
    config: RenderConfig,
) -> tuple[RefineState, Float[Array, " 2"]]:
    """One step of Adam on a batch; and its photometric loss before it, and the share of rays that do not fit.

    These are left out. Of `baked` all counts but what the state holds. Pure.
    """
    rays = to_local(baked.mesh, batch.rays)
    segments = march_segments(baked.mesh, rays, config, entries=batch.entries)
    whole = with_tables(baked, state.tables)
    segments, places, num_segments = lit_segments(whole, segments, config.min_weight)
    rows, layout, count = looked_up(whole.depths, segments, places, num_segments)
    part = map_used(rows_of, state.tables, rows, count)

    def loss(part: Tables, decoders: dict[str, Any]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        small = dataclasses.replace(with_tables(baked, part, layout), decoders=decoders)
        output = shade_segments(small, rays, segments, config)
        color = blend_background(output.color, output.opacity, batch.background)
        target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
        return photometric(color, target, output.overflow), jnp.mean(output.overflow)

    found, gradients = jax.value_and_grad(loss, argnums=(0, 1), has_aux=True)(part, state.decoders)
    tables, moments = {}, {}
    for name in TABLES:
        tables[name], moments[name] = update_rows(
            state.tables[name], state.moments[name], rows, gradients[0][name], count, rate
        )
    updates, decoder_moments = make_optimizer().update(gradients[1], state.decoder_moments)
    decoders = jax.tree.map(lambda p, u: p - decoder_rate * u, state.decoders, updates)
    return RefineState(tables, moments, decoders, decoder_moments), jnp.stack(found)


def looked_up(
    table: HashTables, segments: TetSegments, places: Float[Array, "N 4"], num_used: Int[Array, ""]
) -> tuple[Int[Array, " M"], FaceLayout, Int[Array, ""]]:
    """The texels of the first segments, each once; the layout of a table of these alone; and their number.

    They are those around the points of entry, and around the places to which depths lead. There is room for
    all that could be. Work and memory follow the segments, but for one number a texel, and that is 0 for
    texels that are not there: nobody may ask for them.
    """
    layout: FaceLayout = table.layout  # type: ignore[assignment]
    num_texels = table.features.shape[0]
    points = jnp.maximum(segments.tet_ids, 0), segments.lambda_enter, places
    wanted = map_used(_texels_of, layout, points, num_used)
    wanted, num_wanted = wanted.reshape(-1), wanted.shape[1] * num_used
    positions = jnp.arange(wanted.size, dtype=jnp.int32)
    # All write their position where they point to. One of them is found there afterwards: it stands for all.
    owners = _write(jnp.zeros(num_texels, jnp.int32), wanted, num_wanted)
    chosen, count = pack_where(_is_owner, owners, (wanted, positions), num_wanted)
    rows = map_used(rows_of, wanted, chosen[:num_texels], count)
    return rows, dataclasses.replace(layout, rows=_write(owners, rows, count)), count


def _texels_of(layout: FaceLayout, part: tuple) -> Int[Array, "chunk 6"]:
    """Those around the point of entry, for the depth, and around the place that it leads to."""
    tet_ids, *points = part
    return jnp.stack([texels for at in points for texels in texels_around(layout, tet_ids, at)[1]], axis=1)


def _is_owner(owners: Int[Array, " texels"], part: tuple) -> Bool[Array, " chunk"]:
    texels, positions = part
    return owners[texels] == positions


def _write(
    into: Int[Array, " texels"], at: Int[Array, " n"], num_used: Int[Array, ""]
) -> Int[Array, " texels"]:
    """`into` with each position in `at` written where `at` points to; any of them where several do."""
    chunk = default_chunk(at.size)
    at, order = pad_items(at, chunk), jnp.arange(chunk, dtype=jnp.int32)

    def write(start: Int[Array, ""], into: Int[Array, " texels"]) -> Int[Array, " texels"]:
        here = jnp.where(start + order < num_used, take(at, start, chunk), into.size)
        return into.at[here].set(start + order, mode="drop")

    return for_chunks(num_used, chunk, write, into)
