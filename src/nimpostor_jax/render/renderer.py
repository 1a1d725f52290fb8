"""From rays to colours: traverse, sample, encode, decode, composite (Figs. 2 and 4, Eqs. 8 and 9)."""

import dataclasses

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.decoder import Parameters, decode_appearance, num_decoder_sets
from nimpostor_jax.field.solids import painted
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sum_by_ray
from nimpostor_jax.render.occupancy import Slabs
from nimpostor_jax.render.sampling import Samples, place_samples, plan_samples, with_step
from nimpostor_jax.render.segments import in_cells, march_segments
from nimpostor_jax.render.selection import (
    optical_weights,
    present_samples,
    sample_densities,
    slabs_of,
    visible_samples,
)
from nimpostor_jax.render.traverse import Entries, MarchTables
from nimpostor_jax.types import NeuralImpostor, Rays, RenderOutput


def render_rays(
    impostor: NeuralImpostor,
    rays: Rays,
    config: RenderConfig,
    jitter: Float[Array, " R"] | None = None,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
    refinement: Float[Array, " R"] | None = None,
    slabs: Slabs | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space. Pure; jit it with `config` static.

    Differentiable in every array of the impostor (tables, decoders, vertices) and in the rays. With `jitter`
    in [0, 1) samples move within their steps (training); without, they sit in the middle. Pass `tables` to
    spare rearranging the mesh in every call; by default they are made from the mesh's current vertices. Pass
    the rays' `entries` (`traverse.find_entries`) where the same rays see the same mesh again.
    `refinement` divides the steps of each ray, and `min_weight`. Without jitter rays keep to the impostor's
    `slabs` (`selection.slabs_of`), found here where they are not given. Where tets overlap, after a
    deformation or because there are several objects, their samples are merged: one transmittance for all
    (Eq. 16).
    """
    return render_samples(impostor, rays, config, jitter, tables, entries, refinement, slabs)[0]


def render_samples(
    impostor: NeuralImpostor,
    rays: Rays,
    config: RenderConfig,
    jitter: Float[Array, " R"] | None = None,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
    refinement: Float[Array, " R"] | None = None,
    slabs: Slabs | None = None,
) -> tuple[RenderOutput, Samples]:
    """`render_rays`, and the samples of which the colours are made."""
    config = with_step(config, impostor.config.encoding)
    local = to_local(impostor.mesh, rays)
    segments = march_segments(impostor.mesh, local, config, tables, entries)
    segments = in_cells(segments, impostor.embedding)
    if slabs is None and jitter is None:
        slabs = slabs_of(impostor, config)
    plan = plan_samples(segments, config.sampler, config.density_measure, jitter, refinement, slabs)
    plan, chosen, num_used = present_samples(impostor, plan, config)
    features = None
    if config.min_weight > 0:
        chosen, features, num_used = visible_samples(impostor, plan, chosen, num_used, config, refinement)
    samples = place_samples(plan, chosen, num_used)
    return integrate_samples(impostor, local, samples, features, segments.overflow, config), samples


def integrate_samples(
    impostor: NeuralImpostor,
    rays: Rays,
    samples: Samples,
    known_features: Float[Array, "M C"] | None,
    overflow: Bool[Array, " R"],
    config: RenderConfig,
) -> RenderOutput:
    """Decode and composite samples of rays [R] in the mesh's own frame (Eqs. 7, 9 and 10).

    Features from `visible_samples` are not computed again. `overflow` is that of the segments.
    """
    num_used, tets = samples.num_used, samples.tet_ids
    point_features = field.features(impostor, tets, samples.lambdas, num_used, known_features)
    decoders, num_rays = field.only_decoders(impostor), rays.origins.shape[0]
    turns = field.rest_rotations(impostor) if config.directions == "rest" else None
    views = Views(directions=rays.directions, turns=turns)
    mesh_tets = tets if samples.mesh_tets is None else samples.mesh_tets
    if config.integrate == "features":
        if impostor.paints:
            raise ValueError("paints change the colour of points: RenderConfig.integrate must be 'color'")
        num_sets = num_decoder_sets(impostor.decoders)
        rows = impostor.decoder_index[tets] * num_rays + samples.rays  # neighbours use the same decoders
        sigmas = sample_densities(impostor, tets, point_features, num_used)
        weights = optical_weights(sigmas, samples)
        values = jnp.column_stack([point_features, jnp.ones_like(weights), samples.t])
        sums = sum_by_ray(weights, values, rows, num_rays * num_sets, num_used)
        directions = jnp.tile(rays.directions, (num_sets, 1))
        if turns is not None:
            seen = map_used(_directions_of, views, (samples.rays, mesh_tets), num_used)
            directions = _unit(sum_by_ray(weights, seen, rows, num_rays * num_sets, num_used), directions)
        sums = decode_integrated(impostor.decoders, sums, field.encode_directions(impostor, directions))
    else:
        if turns is None:  # as many as rays, not as many as samples
            views = dataclasses.replace(views, directions=field.encode_directions(impostor, rays.directions))
        items = (tets, point_features, samples.rays, mesh_tets)
        sigmas, colors = map_used(_decode, (decoders, views), items, num_used)
        if impostor.paints:
            items = (mesh_tets, samples.lambdas, samples.rays, colors)
            colors = map_used(_paint, (impostor.paints, rays.directions), items, num_used)
        weights = optical_weights(sigmas, samples)
        values = jnp.column_stack([colors, jnp.ones_like(weights), samples.t])
        sums = sum_by_ray(weights, values, samples.rays, num_rays, num_used)
    return ray_output(sums, impostor.mesh.scale, overflow | samples.overflow, samples.coarsened)


@struct.dataclass
class Views:
    """From where the field is seen: by ray, and where tets have turned, by tet."""

    directions: Float[Array, "R E"]  # encoded, where there are no turns
    turns: Float[Array, "T 3 3"] | None  # of the mesh's tets, since they were at rest


def _directions_of(views: Views, part: tuple) -> Float[Array, "chunk 3"]:
    """View directions in the rest frames of tets."""
    rays, mesh_tets = part
    directions, turns = views.directions[rays], views.turns[mesh_tets]  # type: ignore[index]
    return jnp.sum(turns * directions[:, :, None], axis=1)


def _paint(shared: tuple, part: tuple) -> Float[Array, "chunk 3"]:
    (paints, directions), (mesh_tets, lambdas, rays, colors) = shared, part
    return painted(paints, mesh_tets, lambdas, directions[rays], colors)


def _unit(sums: Float[Array, "N 3"], otherwise: Float[Array, "N 3"]) -> Float[Array, "N 3"]:
    """Sums of directions with length 1; where they are none, or cancel, the others."""
    squared = jnp.sum(sums * sums, axis=1, keepdims=True)
    some = squared > jnp.finfo(sums.dtype).tiny
    return jnp.where(some, sums / jnp.sqrt(jnp.where(some, squared, 1)), otherwise)


def ray_output(
    sums: Float[Array, "R 5"],
    scale: Float[Array, ""],
    overflow: Bool[Array, " R"],
    coarsened: Bool[Array, " R"],
) -> RenderOutput:
    """What rays see, from their sums by weight of colour, 1, and t, which `scale` takes to world units."""
    opacity, depth = sums[:, 3], sums[:, 4]
    visible = _divides(opacity)
    return RenderOutput(
        color=sums[:, :3],
        opacity=opacity,
        depth=jnp.where(visible, depth / jnp.where(visible, opacity, 1), 0) * scale,
        overflow=overflow,
        coarsened=coarsened,
    )


def decode_integrated(
    decoders: Parameters, sums: Float[Array, "D*R C+2"], directions: Float[Array, "D*R E"]
) -> Float[Array, "R 5"]:
    """Colours, opacity and depth of rays, from sums by weight for each of D decoder sets (Eq. 10).

    Summed are features, 1, and t; directions are encoded. The decoder sees the weighted mean; what several
    sets see adds up.
    """
    weights = sums[:, -2]
    visible = _divides(weights)
    mean = jnp.where(visible, 1 / jnp.where(visible, weights, 1), 0)[:, None] * sums[:, :-2]
    num_sets, count = num_decoder_sets(decoders), directions.shape[0]
    sets = jnp.arange(count, dtype=jnp.int32) // max(count // num_sets, 1)
    colors = map_used(_decode_mean, decoders, (mean, directions, sets), jnp.int32(count))
    values = jnp.column_stack([weights[:, None] * colors, sums[:, -2:]])
    return jnp.sum(values.reshape(num_sets, count // num_sets, 5), axis=0)


def _divides(weights: Float[Array, " N"]) -> Bool[Array, " N"]:
    """Where sums may be divided by their weight: the slope is 1 / weight^2, which overflows for less."""
    return weights > jnp.finfo(weights.dtype).tiny ** 0.25  # 3e-10 in float32


def _decode_mean(decoders: Parameters, part: tuple) -> Float[Array, "chunk 3"]:
    return decode_appearance(decoders, *part)


def _decode(shared: tuple, part: tuple) -> tuple[Array, Array]:
    """Densities and colours."""
    (decoders, views), (tet_ids, features, rays, mesh_tets) = shared, part
    if views.turns is None:
        directions = views.directions[rays]
    else:
        directions = field.encode_directions(decoders, _directions_of(views, (rays, mesh_tets)))
    sigmas = field.density(decoders, tet_ids, features)
    return sigmas, field.radiance(decoders, tet_ids, features, directions)
