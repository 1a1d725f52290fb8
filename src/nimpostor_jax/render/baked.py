"""Rendering baked impostors: textures of the tets that a ray crosses, one decoded colour (Sec. 3.4, Eq. 10).

The first lookup, where the ray enters the tet, says how deep in the tet something is seen. That point, moved
to the face from the corner opposite, is where the others look up what is seen: opacity, and mean features.
Without the first, what lies behind the face would be smeared over the directions from which it is seen.
Opacity, not optical depth: least squares fits it, and it has a bound where things are solid.

Axes: R rays, N packed segments, K channels.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import map_used, pack_where, rows_of
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import ONE_LEVEL, face_of
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field.decoder import num_decoder_sets
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights, sum_by_ray, transmittance
from nimpostor_jax.render.renderer import decode_integrated, ray_output
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.render.traverse import Entries, MarchTables
from nimpostor_jax.types import BakedImpostor, HashTables, Rays, RenderOutput, TetSegments

BASIS = 4  # functions of the direction
ENDS = ("t_enter", "t_exit", "lambda_enter", "lambda_exit")
MAX_OPACITY = 1 - 2.0**-12  # of one tet: what remains of the light is invisible, and its logarithm finite


def render_baked_rays(
    baked: BakedImpostor,
    rays: Rays,
    config: RenderConfig,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space, as `renderer.render_rays`.

    Marches from tet to tet; of the config only the march's sizes, `near` and `min_weight` matter, since
    nothing is sampled. Textures know tets from outside only: one in which a ray starts is looked up as if the
    ray had entered it by the nearest face. Differentiable in textures, decoders, vertices and rays.
    """
    local = to_local(baked.mesh, rays)
    return shade_segments(baked, local, march_segments(baked.mesh, local, config, tables, entries), config)


def shade_segments(
    baked: BakedImpostor, rays: Rays, segments: TetSegments, config: RenderConfig
) -> RenderOutput:
    """Look up, composite and decode the tets that rays [R], in the mesh's own frame, cross.

    Opacities come first, and what is seen only where it contributes `min_weight` or more of a ray's light.
    Where tets overlap, what is seen first comes first.
    """
    found = _look_along(baked, segments)
    num_used = found.num_used
    weights = sample_weights(found.optical_depth, segments.rays, num_used)
    least, frozen = config.min_weight, jax.lax.stop_gradient(weights)
    visible, num_visible = pack_where(lambda _, weight: weight >= least, None, frozen, num_used)
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    columns = (tet_ids, segments.rays, segments.lambda_exit, found.places, found.t)
    seen, weights = map_used(rows_of, (found.order, weights), visible, num_visible)
    tet_ids, owners, lambda_exit, places, t = map_used(rows_of, columns, seen, num_visible)
    texels = encode(baked.textures, ONE_LEVEL, tet_ids, places, num_visible)
    channels = map_used(_channels, (), (texels, lambda_exit, t), num_visible)

    num_rays, num_sets = rays.origins.shape[0], num_decoder_sets(baked.decoders)
    rows = baked.decoder_index[tet_ids] * num_rays + owners
    sums = sum_by_ray(weights, channels, rows, num_rays * num_sets, num_visible)
    directions = spherical_harmonics(rays.directions, baked.config.decoder.sh_degree)
    sums = decode_integrated(baked.decoders, sums, jnp.tile(directions, (num_sets, 1)))
    return ray_output(sums, baked.mesh.scale, segments.overflow, jnp.zeros_like(segments.overflow))


def lit_segments(
    baked: BakedImpostor, segments: TetSegments, least: float, capacity: int | None = None
) -> tuple[TetSegments, Float[Array, "M 4"], Int[Array, ""]]:
    """The segments that at least the share `least` of their rays' light reaches, packed; and their number.

    And the places on faces at which they look up what is seen. The others contribute less, and so does all
    that they hide: in `shade_segments` with that `min_weight` they change nothing, nor have they gradients.
    Where they do not fit into `capacity` slots, by default as many as there were, the rays from the first
    that is cut off on are flagged.
    """
    found = _look_along(baked, segments)
    light = transmittance(found.optical_depth, segments.rays, found.num_used)
    items = light, segments.tet_ids[found.order]
    lit, count = pack_where(lambda _, part: (part[0] >= least) & (part[1] >= 0), None, items, found.num_used)
    size = light.size if capacity is None else min(capacity, light.size)
    overflow = segments.overflow
    if size < light.size:
        first_lost = jnp.where(count > size, segments.rays[found.order[lit[size]]], overflow.size)
        overflow |= jnp.arange(overflow.size) >= first_lost
        lit, count = lit[:size], jnp.minimum(count, size)
    columns = {name: getattr(segments, name) for name in ("rays", "tet_ids", *ENDS)}
    chosen = map_used(rows_of, found.order, lit, count)
    packed, places = map_used(rows_of, (columns, found.places), chosen, count)
    packed["tet_ids"] = jnp.where(jnp.arange(size) < count, packed["tet_ids"], -1)
    return dataclasses.replace(segments, **packed, overflow=overflow), places, count


class _Along(NamedTuple):
    """What rays meet of opacity in their tets."""

    order: Int[Array, " N"]  # of segments: that of what is seen in them
    optical_depth: Float[Array, " N"]  # in that order
    places: Float[Array, "N 4"]
    t: Float[Array, " N"]
    num_used: Int[Array, ""]


def _look_along(baked: BakedImpostor, segments: TetSegments) -> _Along:
    used = segments.tet_ids >= 0  # the last used slot ends what is looked at, and few before it are empty
    num_used = jnp.max(jnp.where(used, jnp.arange(1, used.size + 1, dtype=jnp.int32), 0), initial=0)
    segments = dataclasses.replace(segments, tet_ids=jnp.maximum(segments.tet_ids, 0))
    places, t = places_seen(baked.depths, segments, num_used)
    opacity = jnp.where(used, opacities_at(baked.opacities, segments, places, num_used), 0)
    order = _along_rays(segments, jax.lax.stop_gradient(t), num_used)
    return _Along(order, -jnp.log1p(-opacity[order]), places, t, num_used)


def _along_rays(
    segments: TetSegments, t: Float[Array, " N"], num_used: Int[Array, ""]
) -> Int[Array, " N"]:
    """The segments in the order of what is seen in them: their own, but where tets overlap."""
    order = jnp.arange(t.size, dtype=jnp.int32)

    def sort() -> Int[Array, " N"]:
        rays = jnp.where(order < num_used, segments.rays, jnp.iinfo(segments.rays.dtype).max)
        return jax.lax.sort((rays, t, order), num_keys=2)[2]

    return jax.lax.cond(jnp.any(segments.disordered), sort, lambda: order)


def places_seen(
    depths: HashTables, segments: TetSegments, num_used: Int[Array, ""]
) -> tuple[Float[Array, "N 4"], Float[Array, " N"]]:
    """Where each ray sees something in each tet: the point on the face of entry to look it up at, and t."""
    texels = encode(depths, ONE_LEVEL, segments.tet_ids, segments.lambda_enter, num_used)
    items = (texels, segments.lambda_enter, segments.lambda_exit, segments.t_enter, segments.t_exit)
    return map_used(_place_seen, (), items, num_used)


def _place_seen(_: tuple, part: tuple) -> tuple[Float[Array, "chunk 4"], Float[Array, " chunk"]]:
    """The point at a share of a segment, moved to the face of entry from the corner opposite.

    That corner's coordinate is -1 instead of 0, since the point may lie on another face as well: on the edge
    between those of entry and exit, where all is seen at the exit. Lookups on a face do not read it.
    """
    texels, lambda_enter, lambda_exit, t_enter, t_exit = part
    share = jnp.clip(in_basis(texels, lambda_exit)[:, 0], 0, 1)
    point = lambda_enter + share[:, None] * (lambda_exit - lambda_enter)
    opposite = jnp.arange(4) == face_of(lambda_enter)[:, None]
    on_face = jnp.where(opposite, 0, point)
    on_face /= jnp.maximum(jnp.sum(on_face, axis=1, keepdims=True), 1e-3)
    return jnp.where(opposite, -1, on_face), t_enter + share * (t_exit - t_enter)


def opacities_at(
    opacities: HashTables, segments: TetSegments, places: Float[Array, "N 4"], num_used: Int[Array, ""]
) -> Float[Array, " N"]:
    """Of each segment, below 1."""
    texels = encode(opacities, ONE_LEVEL, segments.tet_ids, places, num_used)
    return map_used(_opacity, (), (texels, segments.lambda_exit), num_used)


def _opacity(_: tuple, part: tuple) -> Float[Array, " chunk"]:
    return jnp.clip(in_basis(*part)[:, 0], 0, MAX_OPACITY)


def _channels(_: tuple, part: tuple) -> Float[Array, "chunk K+2"]:
    """What the ray gathers by weight: channels, 1 and t."""
    texels, lambda_exit, t = part
    return jnp.column_stack([in_basis(texels, lambda_exit), jnp.ones_like(t), t])


def in_basis(
    texels: Float[Array, "M 4*channels"], lambda_exit: Float[Array, "M 4"]
) -> Float[Array, "M channels"]:
    """Texels in a direction: linear in the coordinates at which the ray leaves the tet."""
    coefficients = enumerate(jnp.split(texels, BASIS, axis=1))
    first, *others = (lambda_exit[:, i, None] * part for i, part in coefficients)
    return sum(others, first)
