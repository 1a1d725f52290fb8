"""Rendering baked impostors: one texture lookup a crossed tet, one decoded colour a ray (Sec. 3.4, Eq. 10).

A texel has 2 + C channels: opacity, opacity times the share of the segment at which it is seen, and opacity
times features. They add up linearly in front of each other, and least squares fits them: hence opacity in the
place of optical depth, which has no bound where something is solid.

Axes: R rays, N packed segments, K basis functions, C features.
"""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.encoding.face_grid import ONE_LEVEL
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics
from nimpostor_jax.field.decoder import num_decoder_sets
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sum_by_ray, transmittance
from nimpostor_jax.render.renderer import decode_integrated
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import Entries, MarchTables, march_tables, traverse
from nimpostor_jax.types import BakedImpostor, Rays, RenderOutput, TetSegments

MAX_OPACITY = 1 - 2.0**-12  # of one tet: what remains of the light is invisible, and its logarithm finite
HEAD = 2  # channels before the features


def render_baked_rays(
    baked: BakedImpostor,
    rays: Rays,
    config: RenderConfig,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space, as `renderer.render_rays`.

    Marches from tet to tet; of the config only the march's sizes matter, since nothing is sampled. Rays that
    start within the cage see nothing of the tet in which they start. Differentiable in textures, decoders,
    vertices and rays.
    """
    local = to_local(baked.mesh, rays)
    if tables is None:
        tables = march_tables(baked.mesh)
    crossings = traverse(tables, local, config.march, entries)
    slots = config.march.capacity_per_ray or config.march.max_tets_per_ray
    near, capacity = config.near / baked.mesh.scale, slots * rays.origins.shape[0]
    segments = locate_segments(baked.mesh, local, crossings, near, capacity)
    return shade_segments(baked, local, segments)


def shade_segments(baked: BakedImpostor, rays: Rays, segments: TetSegments) -> RenderOutput:
    """Look up, composite and decode the tets that rays [R], in the mesh's own frame, cross in order."""
    num_used = _used_slots(segments)
    channels = tet_channels(baked, segments, num_used)
    light = transmittance(-jnp.log1p(-channels[:, -2]), segments.rays, num_used)
    num_rays, num_sets = rays.origins.shape[0], num_decoder_sets(baked.decoders)
    rows = segments.rays * num_sets + baked.decoder_index[jnp.maximum(segments.tet_ids, 0)]
    sums = sum_by_ray(light, channels, rows, num_rays * num_sets, num_used)
    directions = spherical_harmonics(rays.directions, baked.config.decoder.sh_degree)
    sums = decode_integrated(baked.decoders, sums, directions)
    opacity, depth = sums[:, 3], sums[:, 4]
    visible = opacity > 0
    return RenderOutput(
        color=sums[:, :3],
        opacity=opacity,
        depth=jnp.where(visible, depth / jnp.where(visible, opacity, 1), 0) * baked.mesh.scale,
        overflow=segments.overflow,
        coarsened=jnp.zeros_like(segments.overflow),
    )


def tet_channels(
    baked: BakedImpostor, segments: TetSegments, num_used: Int[Array, ""]
) -> Float[Array, "N C+2"]:
    """What each ray gathers in each tet: features, 1 and t, times the tet's opacity."""
    tet_ids = jnp.maximum(segments.tet_ids, 0)
    texels = encode(baked.textures, ONE_LEVEL, tet_ids, segments.lambda_enter, num_used)
    shown = (segments.tet_ids >= 0) & has_textures(baked)[tet_ids]
    items = (texels, shown, segments.lambda_exit, segments.t_enter, segments.t_exit)
    return map_used(partial(_channels, HEAD + baked.config.encoding.feature_dim), (), items, num_used)


def _channels(num_channels: int, _: tuple, part: tuple) -> Float[Array, "chunk C+2"]:
    texels, shown, lambda_exit, t_enter, t_exit = part
    values = in_basis(texels.reshape(texels.shape[0], -1, num_channels), lambda_exit)
    opacity = jnp.where(shown, jnp.clip(values[:, 0], 0, MAX_OPACITY), 0)
    place = jnp.clip(values[:, 1], 0, opacity) * (t_exit - t_enter) + opacity * t_enter
    features = jnp.where((opacity > 0)[:, None], values[:, HEAD:], 0)
    return jnp.column_stack([features, opacity, place])


def has_textures(baked: BakedImpostor) -> Bool[Array, " T"]:
    """Tets that show anything."""
    return baked.textures.layout.resolutions[:, 0] > 0  # type: ignore[union-attr]


def in_basis(
    coefficients: Float[Array, "M K C"], lambda_exit: Float[Array, "M 4"]
) -> Float[Array, "M C"]:
    """Sums of the K functions of the direction: 1, or the coordinates at which a ray leaves the tet."""
    if coefficients.shape[1] == 1:
        return coefficients[:, 0]
    return jnp.sum(lambda_exit[:, :, None] * coefficients, axis=1)


def _used_slots(segments: TetSegments) -> Int[Array, ""]:
    """How many slots hold all segments."""
    order = jnp.arange(segments.rays.size, dtype=jnp.int32)
    return jnp.max(jnp.where(segments.tet_ids >= 0, order + 1, 0), initial=0)
