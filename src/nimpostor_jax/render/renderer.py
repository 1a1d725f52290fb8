"""From rays to colours: traverse, sample, encode, decode, composite (Figs. 2 and 4, Eqs. 8 and 9)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used, pack_where
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.decoder import Parameters, decode_appearance, num_decoder_sets
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import sample_weights, sum_by_ray
from nimpostor_jax.render.occupancy import in_occupied_cells
from nimpostor_jax.render.sampling import SamplePlan, Samples, place, place_samples, plan_samples
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
    `refinement` divides the steps of each ray, and `min_weight`.
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
    slots = config.march.capacity_per_ray or config.march.max_tets_per_ray
    capacity = slots * rays.origins.shape[0]
    segments = locate_segments(impostor.mesh, local, crossings, near, capacity)
    plan = plan_samples(segments, config.sampler, config.density_measure, jitter, refinement)
    chosen, num_used = occupied_samples(impostor, plan, config)
    features = None
    if config.min_weight > 0:
        chosen, features, num_used = visible_samples(impostor, plan, chosen, num_used, config, refinement)
    samples = place_samples(plan, chosen, num_used)
    return integrate_samples(impostor, local, samples, features, segments.overflow, config), samples


def occupied_samples(
    impostor: NeuralImpostor, plan: SamplePlan, config: RenderConfig
) -> tuple[Int[Array, " M"], Int[Array, ""]]:
    """Numbers of the samples in cells that may be seen, and how many; rays that look everywhere keep all."""
    everything = jnp.arange(plan.owners.size, dtype=jnp.int32)
    if not config.skip_empty or impostor.occupied is None:
        return everything, plan.num_used

    def test(shared: tuple, part: tuple) -> Bool[Array, " chunk"]:
        occupied, arrays = shared
        tet_ids, lambdas, _, _, rays = place(arrays, part)
        keep = in_occupied_cells(occupied, tet_ids, lambdas)
        return keep if arrays.jitter is None else keep | _explores(arrays.jitter, config.explore)[rays]

    frozen = jax.lax.stop_gradient(plan)
    return pack_where(test, (impostor.occupied, frozen), (everything, plan.owners), plan.num_used)


def _explores(jitter: Float[Array, " R"], share: float) -> Bool[Array, " R"]:
    """A share of the rays, by digits of their jitter that hardly move their samples: cells fill up."""
    return (jitter * 1024) % 1 < share


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
    num_used = samples.num_used
    point_features = field.features(impostor, samples.tet_ids, samples.lambdas, num_used, known_features)
    directions = field.encode_directions(impostor, rays.directions)
    decoders, num_rays = _only_decoders(impostor), rays.origins.shape[0]
    if config.integrate == "features":
        sigmas = sample_densities(impostor, samples.tet_ids, point_features, num_used)
        values = point_features
    else:
        items = (samples.tet_ids, point_features, samples.rays)
        sigmas, values = map_used(_decode, (decoders, directions), items, num_used)
    weights = _weights(sigmas, samples)
    values = jnp.column_stack([values, jnp.ones_like(weights), samples.t])
    if config.integrate == "features":
        num_sets = num_decoder_sets(impostor.decoders)
        rows = samples.rays * num_sets + impostor.decoder_index[samples.tet_ids]
        sums = sum_by_ray(weights, values, rows, num_rays * num_sets, num_used)
        sums = decode_integrated(impostor.decoders, sums, directions)
    else:
        sums = sum_by_ray(weights, values, samples.rays, num_rays, num_used)
    return ray_output(sums, impostor.mesh.scale, overflow | samples.overflow, samples.coarsened)


def ray_output(
    sums: Float[Array, "R 5"],
    scale: Float[Array, ""],
    overflow: Bool[Array, " R"],
    coarsened: Bool[Array, " R"],
) -> RenderOutput:
    """What rays see, from their sums by weight of colour, 1, and t, which `scale` takes to world units."""
    opacity, depth = sums[:, 3], sums[:, 4]
    visible = opacity > 0
    return RenderOutput(
        color=sums[:, :3],
        opacity=opacity,
        depth=jnp.where(visible, depth / jnp.where(visible, opacity, 1), 0) * scale,
        overflow=overflow,
        coarsened=coarsened,
    )


def decode_integrated(
    decoders: Parameters, sums: Float[Array, "R*D C+2"], directions: Float[Array, "R E"]
) -> Float[Array, "R 5"]:
    """Colours, opacity and depth of rays, from sums by weight for each of D decoder sets (Eq. 10).

    Summed are features, 1, and t. The decoder sees the weighted mean; what several sets see adds up.
    """
    weights = sums[:, -2]
    visible = weights > 0
    mean = jnp.where(visible, 1 / jnp.where(visible, weights, 1), 0)[:, None] * sums[:, :-2]
    num_sets, num_rays = num_decoder_sets(decoders), directions.shape[0]
    order = jnp.arange(num_rays * num_sets, dtype=jnp.int32)
    colors = map_used(_decode_mean, (decoders, directions), (mean, order), jnp.int32(order.size))
    values = jnp.column_stack([weights[:, None] * colors, sums[:, -2:]])
    return jnp.sum(values.reshape(num_rays, num_sets, 5), axis=1)


def _decode_mean(shared: tuple, part: tuple) -> Float[Array, "chunk 3"]:
    (decoders, directions), (features, order) = shared, part
    num_sets = num_decoder_sets(decoders)
    return decode_appearance(decoders, features, directions[order // num_sets], order % num_sets)


def _only_decoders(impostor: NeuralImpostor) -> NeuralImpostor:
    """Without tables and mesh, or `map_used` would add up gradients of their size for every chunk."""
    return dataclasses.replace(impostor, mesh=None, tables=None, occupied=None)  # type: ignore[arg-type]


def sample_densities(
    impostor: NeuralImpostor,
    tet_ids: Int[Array, " M"],
    features: Float[Array, "M C"],
    num_used: Int[Array, ""],
) -> Float[Array, " M"]:
    """Densities of the first `num_used` points (Eq. 7)."""
    return map_used(_density, _only_decoders(impostor), (tet_ids, features), num_used)


def _density(decoders: NeuralImpostor, part: tuple) -> Float[Array, " chunk"]:
    return field.density(decoders, *part)


def _decode(shared: tuple, part: tuple) -> tuple[Array, Array]:
    """Densities and colours."""
    (decoders, directions), (tet_ids, features, rays) = shared, part
    sigmas = field.density(decoders, tet_ids, features)
    return sigmas, field.radiance(decoders, tet_ids, features, directions[rays])


def _weights(sigmas: Float[Array, " M"], samples: Samples) -> Float[Array, " M"]:
    """Share of its ray's light that each packed sample contributes."""
    return sample_weights(sigmas * samples.deltas, samples.rays, samples.num_used)


def visible_samples(
    impostor: NeuralImpostor,
    plan: SamplePlan,
    chosen: Int[Array, " M"],
    num_used: Int[Array, ""],
    config: RenderConfig,
    refinement: Float[Array, " R"] | None,
) -> tuple[Int[Array, " M"], Float[Array, "M C"], Int[Array, ""]]:
    """Those of the chosen samples that contribute at least `min_weight`, their features, and how many.

    A pass without gradient: colours and gradients cost several times a density, and most samples lie in empty
    space or behind a surface. With finer steps, samples that contribute less in proportion are kept.
    """
    frozen, plan = jax.lax.stop_gradient((impostor, plan))
    samples = place_samples(plan, chosen, num_used)
    features = field.features(frozen, samples.tet_ids, samples.lambdas, num_used)
    sigmas = sample_densities(frozen, samples.tet_ids, features, num_used)
    least, weights = config.min_weight, _weights(sigmas, samples)
    if refinement is not None:
        weights *= refinement[samples.rays]
    visible, num_visible = pack_where(lambda _, weight: weight >= least, None, weights, num_used)
    chosen, features = map_used(_rows, (chosen, features), visible, num_visible)
    return chosen, features, num_visible


def _rows(arrays: Any, indices: Int[Array, " M"]) -> Any:
    return jax.tree.map(lambda x: x[indices], arrays)
