"""From rays to colours: traverse, sample, encode, decode, composite (Figs. 2 and 4, Eqs. 8 and 9)."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights
from nimpostor_jax.render.occupancy import in_occupied_cells
from nimpostor_jax.render.sampling import Samples, sample_segments, select_samples
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
    refinement: Float[Array, " R"] | None = None,
) -> RenderOutput:
    """Colour, opacity and depth of rays [R] given in world space. Pure; jit it with `config` static.

    Differentiable in every array of the impostor (tables, decoders, vertices) and in the rays. With `jitter`
    in [0, 1) samples move within their steps (training); without, they sit in the middle. Pass `tables` to
    spare rearranging the mesh in every call; by default they are made from the mesh's current vertices. Pass
    the rays' `entries` (`traverse.find_entries`) where the same rays see the same mesh again.
    `refinement` divides the steps of each ray.
    """
    return render_samples(impostor, rays, config, jitter, tables, entries, refinement)[0]


def render_samples(
    impostor: NeuralImpostor,
    rays: Rays,
    config: RenderConfig,
    jitter: Float[Array, " R"] | None = None,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
    refinement: Float[Array, " R"] | None = None,
) -> tuple[RenderOutput, Samples]:
    """`render_rays`, and the samples of which the colours are made."""
    local = to_local(impostor.mesh, rays)
    near = config.near / impostor.mesh.scale
    if tables is None:
        tables = march_tables(impostor.mesh)
    crossings = traverse(tables, local, config.march, entries)
    segments = locate_segments(impostor.mesh, local, crossings, near)
    samples = sample_segments(segments, config.sampler, config.density_measure, jitter, refinement)
    if config.skip_empty and impostor.occupied is not None:
        keep = in_occupied_cells(impostor.occupied, samples.tet_ids, samples.lambdas)
        if jitter is not None:
            keep |= _looks_everywhere(jitter)[samples.rays]
        samples = select_samples(samples, keep)
    if config.min_weight > 0:
        samples = _visible(impostor, samples, config)
    return _integrate(impostor, local, samples, segments.overflow, config), samples


def _looks_everywhere(jitter: Float[Array, " R"]) -> Bool[Array, " R"]:
    """One ray in sixteen, by digits of its jitter that hardly move its samples: cells fill up."""
    return (jitter * 1024) % 1 < 1 / 16


def _integrate(
    impostor: NeuralImpostor,
    rays: Rays,
    samples: Samples,
    overflow: Array,
    config: RenderConfig,
) -> RenderOutput:
    num_used = samples.num_used
    point_features = field.features(impostor, samples.tet_ids, samples.lambdas, num_used)
    directions = field.encode_directions(impostor, rays.directions)

    def decode(shared: tuple, part: tuple) -> tuple[Array, Array]:
        (decoders, directions), (tet_ids, features, rays) = shared, part
        sigmas = field.density(decoders, tet_ids, features)
        return sigmas, field.radiance(decoders, tet_ids, features, directions[rays])

    # Without tables and mesh, or `map_used` would add up gradients of their size for every chunk.
    decoders = dataclasses.replace(impostor, mesh=None, tables=None, occupied=None)  # type: ignore[arg-type]
    items = (samples.tet_ids, point_features, samples.rays)
    sigmas, colors = map_used(decode, (decoders, directions), items, num_used)

    weights = _weights(sigmas, samples)
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


def _weights(sigmas: Float[Array, " M"], samples: Samples) -> Float[Array, " M"]:
    """Share of its ray's light that each packed sample contributes."""
    return sample_weights(sigmas * samples.deltas, samples.rays)


def _visible(impostor: NeuralImpostor, samples: Samples, config: RenderConfig) -> Samples:
    """The samples that contribute at least `min_weight`, found by a pass over densities without gradient.

    Colours and gradients cost several times a density; most samples lie in empty space or behind a surface.
    """
    frozen, seen = jax.lax.stop_gradient((impostor, samples))

    def densities(frozen: NeuralImpostor, part: tuple) -> Array:
        tet_ids, lambdas = part
        return field.density(frozen, tet_ids, field.features(frozen, tet_ids, lambdas))

    sigmas = map_used(densities, frozen, (seen.tet_ids, seen.lambdas), seen.num_used)
    return select_samples(samples, _weights(sigmas, seen) >= config.min_weight)
