"""Rendering baked impostors: two texture lookups a crossed tet, one decoded colour a ray (Sec. 3.4, Eq. 10).

The first lookup, where the ray enters the tet, says how deep in the tet something is seen. That point, moved
to the face from the corner opposite, is where the second looks up what is seen: opacity and mean features.
Without the first, what lies behind the face would be smeared over the directions from which it is seen.
Opacity, not optical depth: least squares fits it, and it has a bound where things are solid.

Axes: R rays, N packed segments, C features.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used, packed_indices
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import ONE_LEVEL, face_of
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field.decoder import num_decoder_sets
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sum_by_ray, transmittance
from nimpostor_jax.render.renderer import decode_integrated, ray_output
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.render.traverse import Entries, MarchTables
from nimpostor_jax.types import BakedImpostor, HashTables, Rays, RenderOutput, TetSegments

BASIS = 4  # functions of the direction
MAX_OPACITY = 1 - 2.0**-12  # of one tet: what remains of the light is invisible, and its logarithm finite


def render_baked_rays(
    baked: BakedImpostor,
    rays: Rays,
    config: RenderConfig,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space, as `renderer.render_rays`.

    Marches from tet to tet; of the config only the march's sizes and `near` matter, since nothing is sampled.
    Textures know tets from outside only: one in which a ray starts is looked up as if the ray had entered it
    by the nearest face. Differentiable in textures, decoders, vertices and rays.
    """
    local = to_local(baked.mesh, rays)
    return shade_segments(baked, local, march_segments(baked.mesh, local, config, tables, entries))


def shade_segments(baked: BakedImpostor, rays: Rays, segments: TetSegments) -> RenderOutput:
    """Look up, composite and decode the tets that rays [R], in the mesh's own frame, cross in order."""
    segments, num_used = textured_segments(baked, segments)
    channels = tet_channels(baked, segments, num_used)
    light = transmittance(-jnp.log1p(-channels[:, -2]), segments.rays, num_used)
    num_rays, num_sets = rays.origins.shape[0], num_decoder_sets(baked.decoders)
    rows = baked.decoder_index[segments.tet_ids] * num_rays + segments.rays
    sums = sum_by_ray(light, channels, rows, num_rays * num_sets, num_used)
    directions = spherical_harmonics(rays.directions, baked.config.decoder.sh_degree)
    sums = decode_integrated(baked.decoders, sums, jnp.tile(directions, (num_sets, 1)))
    return ray_output(sums, baked.mesh.scale, segments.overflow, jnp.zeros_like(segments.overflow))


def textured_segments(
    baked: BakedImpostor, segments: TetSegments
) -> tuple[TetSegments, Int[Array, ""]]:
    """Those of the segments that lie in tets with textures, at the front, and how many."""
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    keep = (segments.tet_ids >= 0) & has_textures(baked)[tet_ids]
    chosen, count = packed_indices(keep)
    names = ("t_enter", "t_exit", "lambda_enter", "lambda_exit")
    columns = {name: getattr(segments, name) for name in names} | {"tet_ids": tet_ids}
    packed = {name: column[chosen] for name, column in columns.items()}
    # Ascending in what no slot holds, too: sums along rays ask for that.
    rays = jnp.where(jnp.arange(chosen.size) < count, segments.rays[chosen], segments.overflow.shape[0] - 1)
    return segments.replace(rays=rays, **packed), count  # type: ignore[attr-defined]


def tet_channels(
    baked: BakedImpostor, segments: TetSegments, num_used: Int[Array, ""]
) -> Float[Array, "N C+2"]:
    """What each ray gathers in each tet: features, 1 and t, times the tet's opacity."""
    share = seen_at(baked.depths, segments, num_used)
    items = (segments.lambda_enter, segments.lambda_exit, share)
    places = map_used(seen_on_face, (), items, num_used)
    texels = encode(baked.textures, ONE_LEVEL, segments.tet_ids, places, num_used)
    t = segments.t_enter + share * (segments.t_exit - segments.t_enter)
    return map_used(_channels, (), (texels, segments.lambda_exit, t), num_used)


def seen_at(depths: HashTables, segments: TetSegments, num_used: Int[Array, ""]) -> Float[Array, " N"]:
    """The share of each segment, in [0, 1], at which something is seen, by the textures of depths."""
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    texels = encode(depths, ONE_LEVEL, tet_ids, segments.lambda_enter, num_used)
    return map_used(_share, (), (texels, segments.lambda_exit), num_used)


def _share(_: tuple, part: tuple) -> Float[Array, " chunk"]:
    return jnp.clip(in_basis(*part)[:, 0], 0, 1)


def seen_on_face(_: tuple, part: tuple) -> Float[Array, "chunk 4"]:
    """The point at a share of a segment, moved to the face of entry from the corner opposite."""
    lambda_enter, lambda_exit, share = part
    point = lambda_enter + share[:, None] * (lambda_exit - lambda_enter)
    opposite = jnp.arange(4) == face_of(lambda_enter)[:, None]
    on_face = jnp.where(opposite, 0, point)
    return on_face / jnp.maximum(jnp.sum(on_face, axis=1, keepdims=True), 1e-3)


def _channels(_: tuple, part: tuple) -> Float[Array, "chunk C+2"]:
    texels, lambda_exit, t = part
    values = in_basis(texels, lambda_exit)
    opacity = jnp.clip(values[:, 0], 0, MAX_OPACITY)
    return jnp.column_stack([opacity[:, None] * values[:, 1:], opacity, opacity * t])


def has_textures(baked: BakedImpostor) -> Bool[Array, " T"]:
    """Tets that show anything."""
    return baked.textures.layout.resolutions[:, 0] > 0  # type: ignore[union-attr]


def in_basis(
    texels: Float[Array, "M 4*channels"], lambda_exit: Float[Array, "M 4"]
) -> Float[Array, "M channels"]:
    """Texels in a direction: linear in the coordinates at which the ray leaves the tet."""
    coefficients = texels.reshape(texels.shape[0], BASIS, -1)
    return jnp.sum(lambda_exit[:, :, None] * coefficients, axis=1)
