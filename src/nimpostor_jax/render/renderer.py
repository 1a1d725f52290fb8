"""From rays to colours: traverse, sample, encode, decode, composite (Figs. 2 and 4, Eqs. 8 and 9)."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights
from nimpostor_jax.render.sampling import (
    Samples,
    from_grid,
    sample_segments,
    select_samples,
    to_grid,
)
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import Entries, MarchTables, march_tables, traverse
from nimpostor_jax.types import NeuralImpostor, Rays, RenderOutput


def render_rays(
    impostor: NeuralImpostor,
    rays: Rays,
    config: RenderConfig,
    jitter: Float[Array, " R"] | None = None,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space. Pure; jit it with `config` static.

    Differentiable in every array of the impostor (tables, decoders, vertices) and in the rays. With `jitter`
    in [0, 1) samples move within their steps (training); without, they sit in the middle. Pass `tables` to
    spare rearranging the mesh in every call; by default they are made from the mesh's current vertices. Pass
    the rays' `entries` (`traverse.find_entries`) where the same rays see the same mesh again.
    """
    local = to_local(impostor.mesh, rays)
    near = config.near / impostor.mesh.scale
    if tables is None:
        tables = march_tables(impostor.mesh)
    crossings = traverse(tables, local, config.march, entries)
    segments = locate_segments(impostor.mesh, local, crossings, near)
    samples = sample_segments(segments, config.sampler, config.density_measure, jitter)
    return _integrate(impostor, local, samples, segments.overflow, config)


def _integrate(
    impostor: NeuralImpostor, rays: Rays, samples: Samples, overflow: Array, config: RenderConfig
) -> RenderOutput:
    if config.min_weight > 0:
        samples = _visible(impostor, samples, config)
    num_used = jnp.sum(samples.counts)
    point_features = field.features(impostor, samples.tet_ids, samples.lambdas, num_used)
    directions = field.encode_directions(impostor, rays.directions)

    def decode(shared: tuple, part: tuple) -> tuple[Array, Array]:
        (decoders, directions), (tet_ids, features, rays) = shared, part
        sigmas = field.density(decoders, tet_ids, features)
        return sigmas, field.radiance(decoders, tet_ids, features, directions[rays])

    # Without tables and mesh, or `map_used` would add up gradients of their size for every chunk.
    decoders = dataclasses.replace(impostor, mesh=None, tables=None)  # type: ignore[arg-type]
    items = (samples.tet_ids, point_features, samples.rays)
    sigmas, colors = map_used(decode, (decoders, directions), items, num_used)

    weights = _weights(sigmas, samples, config)
    sums = jax.ops.segment_sum(
        weights[:, None] * jnp.column_stack([colors, jnp.ones_like(weights), samples.t]),
        samples.rays,
        num_segments=rays.origins.shape[0],
    )
    opacity, depth = sums[:, 3], sums[:, 4]
    visible = opacity > 0
    return RenderOutput(
        color=sums[:, :3],
        opacity=opacity,
        depth=jnp.where(visible, depth / jnp.where(visible, opacity, 1), 0) * impostor.mesh.scale,
        overflow=overflow | samples.overflow,
        coarsened=samples.coarsened,
    )


def _weights(sigmas: Float[Array, " M"], samples: Samples, config: RenderConfig) -> Float[Array, " M"]:
    """Share of its ray's light that each packed sample contributes."""
    optical_depth = to_grid(sigmas * samples.deltas, samples, config.sampler.max_samples_per_ray)
    return from_grid(sample_weights(optical_depth), samples)


def _visible(impostor: NeuralImpostor, samples: Samples, config: RenderConfig) -> Samples:
    """The samples that contribute at least `min_weight`, found by a pass over densities without gradient.

    Colours and gradients cost several times a density; most samples lie in empty space or behind a surface.
    """
    frozen, seen = jax.lax.stop_gradient((impostor, samples))

    def densities(frozen: NeuralImpostor, part: tuple) -> Array:
        tet_ids, lambdas = part
        return field.density(frozen, tet_ids, field.features(frozen, tet_ids, lambdas))

    sigmas = map_used(densities, frozen, (seen.tet_ids, seen.lambdas), jnp.sum(seen.counts))
    return select_samples(samples, _weights(sigmas, seen, config) >= config.min_weight)
