"""Which of the planned samples are worth a colour and a gradient, and in which order they come.

Axes: R rays, M packed samples. Nothing here is differentiable: it chooses numbers of a `SamplePlan`.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, map_used, pack_where, padded_size, rows_of
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import CLOSED, MIXED, OPEN, is_kept
from nimpostor_jax.render.composite import sample_weights
from nimpostor_jax.render.occupancy import Slabs, in_occupied_cells, occupied_slabs
from nimpostor_jax.render.sampling import SamplePlan, Samples, place, place_samples
from nimpostor_jax.types import NeuralImpostor

Chosen = tuple[Int[Array, " M"], Int[Array, ""]]  # numbers of samples, by ray, and how many are meant


def present_samples(
    impostor: NeuralImpostor, plan: SamplePlan, config: RenderConfig
) -> tuple[SamplePlan, Int[Array, " M"], Int[Array, ""]]:
    """Samples in parts of cells that may be seen, and that gates let through, in order along each ray.

    Later buffers have room for `SamplerConfig.occupied_per_ray`; the plan flags rays that lose some.
    """
    chosen, num_used = gated_samples(impostor, plan, *occupied_samples(impostor, plan, config))
    plan, chosen, num_used = _limited(plan, chosen, num_used, config.sampler.occupied_per_ray)
    return plan, in_order(plan, chosen, num_used, config), num_used


def _limited(
    plan: SamplePlan, chosen: Int[Array, " M"], num_used: Int[Array, ""], per_ray: int | None
) -> tuple[SamplePlan, Int[Array, " M"], Int[Array, ""]]:
    """As many of the first samples as `per_ray` makes room for."""
    num_rays = plan.scale.shape[0]
    wanted = num_rays * (per_ray or 0)
    room = padded_size(wanted, default_chunk(wanted))  # whole chunks, as in the plan
    if per_ray is None or room >= chosen.size:
        return plan, chosen, num_used
    first_lost = plan.segments.rays[plan.owners[chosen[room]]]
    lost = (num_used > room) & (jnp.arange(num_rays) >= first_lost)
    plan = dataclasses.replace(plan, overflow=plan.overflow | lost)
    return plan, chosen[:room], jnp.minimum(num_used, room)


def slabs_of(impostor: NeuralImpostor, config: RenderConfig) -> Slabs | None:
    """Slabs around what may be seen of each tet, for `plan_samples`; None where nothing is left out."""
    if not config.skip_empty or impostor.occupied is None:
        return None
    return occupied_slabs(impostor.occupied)


def occupied_samples(impostor: NeuralImpostor, plan: SamplePlan, config: RenderConfig) -> Chosen:
    """Samples in parts of cells that may be seen; rays that look everywhere keep all."""
    everything = jnp.arange(plan.owners.size, dtype=jnp.int32)
    if not config.skip_empty or impostor.occupied is None:
        return everything, plan.num_used

    def test(shared: tuple, part: tuple) -> Bool[Array, " chunk"]:
        occupied, arrays = shared
        tet_ids, lambdas, _, _, rays, _ = place(arrays, part)
        keep = in_occupied_cells(occupied, tet_ids, lambdas)
        return keep if arrays.jitter is None else keep | _explores(arrays.jitter, config.explore)[rays]

    frozen = jax.lax.stop_gradient(plan)
    return pack_where(test, (impostor.occupied, frozen), (everything, plan.owners), plan.num_used)


def _explores(jitter: Float[Array, " R"], share: float) -> Bool[Array, " R"]:
    """A share of the rays, by digits of their jitter that hardly move their samples: cells fill up."""
    return (jitter * 1024) % 1 < share


def gated_samples(
    impostor: NeuralImpostor, plan: SamplePlan, chosen: Int[Array, " M"], num_used: Int[Array, ""]
) -> Chosen:
    """Those of the chosen samples that the impostor's gates let through: first by tet, then by point."""
    if not impostor.gates:
        return chosen, num_used
    impostor, plan = jax.lax.stop_gradient((impostor, plan))
    states = jnp.stack([gate.states for gate in impostor.gates])
    # The strictest of all gates' states says whether single points must be tested.
    strictest = jnp.where(jnp.any(states == CLOSED, axis=0), CLOSED, jnp.max(states, axis=0))
    segments = plan.segments
    segment_tets = segments.tet_ids if segments.mesh_tets is None else segments.mesh_tets
    by_segment = strictest[jnp.maximum(segment_tets, 0)]

    def has_state(state: int) -> Any:
        return lambda by_segment, owners: by_segment[owners] == state

    owners = plan.owners[chosen]
    doubtful, count = pack_where(has_state(MIXED), by_segment, owners, num_used)
    places, tets = map_used(_cell_places, _arrays(plan), (chosen[doubtful], owners[doubtful]), count)
    passes = map_used(_passes, impostor, (tets, places), count)
    order = jnp.arange(chosen.size)
    kept = (by_segment[owners] == OPEN) & (order < num_used)
    kept = kept.at[jnp.where(order < count, doubtful, chosen.size)].set(passes, mode="drop")
    indices, count = pack_where(lambda _, keep: keep, None, kept, num_used)
    return chosen[indices], count


def _cell_places(plan: SamplePlan, items: tuple) -> tuple[Float[Array, "chunk 4"], Int[Array, " chunk"]]:
    tet_ids, lambdas, _, _, _, mesh_tets = place(plan, items)
    return lambdas, tet_ids if mesh_tets is None else mesh_tets


def _passes(impostor: NeuralImpostor, part: tuple) -> Bool[Array, " chunk"]:
    return is_kept(impostor, *part)


def in_order(
    plan: SamplePlan, chosen: Int[Array, " M"], num_used: Int[Array, ""], config: RenderConfig
) -> Int[Array, " M"]:
    """The chosen samples along each ray, also where tets overlap (Fig. 4, intersecting).

    Each entry into a cage starts a walk of its own, so that only samples of different walks can be out of
    order. Where no two segments overlap, nothing is sorted, unless the config says so.
    """
    frozen = jax.lax.stop_gradient(plan)

    def sort() -> Int[Array, " M"]:
        order = jnp.arange(chosen.size, dtype=jnp.int32)
        t, rays = map_used(_t_and_ray, _arrays(frozen), (chosen, frozen.owners[chosen]), num_used)
        rays = jnp.where(order < num_used, rays, jnp.iinfo(rays.dtype).max)
        return jax.lax.sort((rays, t, chosen), num_keys=2)[2]  # stable: of equals, the first walk's

    disordered = jnp.any(frozen.segments.disordered) | (not config.skip_sorting)
    return jax.lax.cond(disordered, sort, lambda: chosen)


def _t_and_ray(plan: SamplePlan, items: tuple) -> tuple[Float[Array, " chunk"], Int[Array, " chunk"]]:
    _, _, t, _, rays, _ = place(plan, items)
    return t, rays


def _arrays(plan: SamplePlan) -> SamplePlan:
    """What `place` reads: the rest has no chunks."""
    return dataclasses.replace(plan, owners=None, overflow=None, coarsened=None)  # type: ignore[arg-type]


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
    least, weights = config.min_weight, optical_weights(sigmas, samples)
    if refinement is not None:
        weights *= refinement[samples.rays]
    visible, num_visible = pack_where(lambda _, weight: weight >= least, None, weights, num_used)
    chosen, features = map_used(rows_of, (chosen, features), visible, num_visible)
    return chosen, features, num_visible


def sample_densities(
    impostor: NeuralImpostor,
    tet_ids: Int[Array, " M"],
    features: Float[Array, "M C"],
    num_used: Int[Array, ""],
) -> Float[Array, " M"]:
    """Densities of the first `num_used` points (Eq. 7)."""
    return map_used(_density, field.only_decoders(impostor), (tet_ids, features), num_used)


def _density(decoders: NeuralImpostor, part: tuple) -> Float[Array, " chunk"]:
    return field.density(decoders, *part)


def optical_weights(sigmas: Float[Array, " M"], samples: Samples) -> Float[Array, " M"]:
    """Share of its ray's light that each packed sample contributes."""
    return sample_weights(sigmas * samples.deltas, samples.rays, samples.num_used)
