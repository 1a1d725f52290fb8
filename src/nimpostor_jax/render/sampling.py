"""Samples along rays through tets (Sec. 3.2, Eqs. 3 to 5), packed into one buffer of fixed size.

A ray's samples are spaced evenly, or with Eq. 4's cone growth, in a measure that accumulates over its tets.
Rays need different numbers of samples: they share a buffer of M slots, so that nothing is computed for
samples that a ray does not have.

Axes: K tet slots, R rays, S samples a ray at most, M packed samples.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, map_used, packed_indices, running
from nimpostor_jax.config import Measure, SamplerConfig
from nimpostor_jax.types import TetSegments

GOLDEN_RATIO = 0.6180339887498949


@struct.dataclass
class Samples:
    """Points at which the field is evaluated (Eq. 5), in packed order: by ray, then along the ray."""

    tet_ids: Int[Array, " M"]
    lambdas: Float[Array, "M 4"]
    t: Float[Array, " M"]
    deltas: Float[Array, " M"]  # length of the sample's interval in the density measure; 0 in unused slots
    rays: Int[Array, " M"]
    num_used: Int[Array, ""]
    overflow: Bool[Array, " R"]  # some of the ray's samples did not fit
    coarsened: Bool[Array, " R"]  # the ray needed more than S samples and got larger steps


def segment_measure(segments: TetSegments, measure: Measure) -> Float[Array, "K R"]:
    """Extent of each segment: L1 barycentric distance (Eq. 9), 1 a tet (Eq. 4), or length; 0 if empty."""
    if measure == "barycentric":
        return jnp.sum(jnp.abs(segments.lambda_exit - segments.lambda_enter), axis=-1)
    if measure == "alpha":
        return jnp.where(segments.tet_ids >= 0, 1.0, 0.0).astype(segments.t_exit.dtype)
    return segments.t_exit - segments.t_enter


def step_boundaries(config: SamplerConfig) -> np.ndarray:
    """Distances from the first tet's entry at which steps end, [S + 1], before fitting to a ray (Eq. 4)."""
    step, travelled = config.step, [0.0]
    for _ in range(config.max_samples_per_ray):
        travelled.append(travelled[-1] + step)
        step += config.cone_angle * travelled[-1]
    return np.asarray(travelled)


def sample_segments(
    segments: TetSegments,
    config: SamplerConfig,
    density_measure: Measure,
    jitter: Float[Array, " R"] | None = None,
    refinement: Float[Array, " R"] | None = None,
) -> Samples:
    """Place samples on each ray: at the middle of each step, or stratified within it where `jitter` is given.

    `jitter` in [0, 1) is one number a ray; its samples' places follow by golden-ratio steps, so that they
    depend neither on the batch around the ray nor on the number of devices. Steps are scaled down so that a
    whole number of them fills the ray exactly. Empty rays get no samples. `refinement` divides a ray's steps.
    """
    num_slots, num_rays = segments.tet_ids.shape
    max_samples = config.max_samples_per_ray
    capacity = num_rays * (config.capacity_per_ray or max_samples)
    capacity += -capacity % default_chunk(capacity)  # whole chunks need no padding later
    extents = segment_measure(segments, config.measure)
    ends = jnp.cumsum(extents, axis=0)
    total = ends[-1]
    boundaries = jnp.asarray(step_boundaries(config), ends.dtype)
    # The tolerance keeps a ray of exactly n steps from getting n + 1 by rounding.
    asked = jax.lax.stop_gradient(total if refinement is None else total * refinement)
    fits = jnp.searchsorted(boundaries, asked * (1 - 1e-5)).astype(jnp.int32)
    wanted = jnp.where(total > 0, jnp.clip(fits, 1, max_samples), 0)
    scale = total / boundaries[jnp.maximum(wanted, 1)]
    counts = jnp.clip(capacity - (jnp.cumsum(wanted) - wanted), 0, wanted)
    firsts = jnp.cumsum(counts) - counts

    # Each segment with samples marks its first; what it marks ascends, so that a running maximum spreads it.
    before = _samples_before(config, ends, extents, boundaries, scale, counts, jitter)
    starts = jnp.pad(before[:-1], ((1, 0), (0, 0)))
    slots = jnp.arange(num_slots, dtype=jnp.int32)[:, None]
    marks = jnp.arange(num_rays, dtype=jnp.int32) * num_slots + slots
    places = jnp.where(before > starts, firsts + starts, capacity)
    marked = jnp.zeros(capacity, jnp.int32).at[places.reshape(-1)].set(marks.reshape(-1), mode="drop")
    marked = running(jnp.maximum, marked, 0)
    rays, slot = marked // num_slots, marked % num_slots
    segment = slot * num_rays + rays
    packed, num_used = jnp.arange(capacity, dtype=jnp.int32), jnp.sum(counts)
    used = packed < num_used
    steps = jnp.clip(packed - firsts[rays], 0, max_samples - 1)
    low, high = boundaries[steps], boundaries[steps + 1]
    position = (low + _share(steps, jitter, rays) * (high - low)) * scale[rays]

    def pick(values: Float[Array, "K R *rest"]) -> Float[Array, "M *rest"]:
        return values.reshape(-1, *values.shape[2:])[segment]

    extent, end = pick(extents), pick(ends)
    inside = jnp.clip(1 - (end - position) / jnp.where(extent > 0, extent, 1), 0, 1)
    deltas = (high - low) * scale[rays]
    if density_measure != config.measure:
        density_extents = segment_measure(segments, density_measure)
        deltas *= pick(density_extents) / jnp.where(extent > 0, extent, 1)
    lambda_enter, lambda_exit = pick(segments.lambda_enter), pick(segments.lambda_exit)
    t_enter, t_exit = pick(segments.t_enter), pick(segments.t_exit)
    return Samples(
        tet_ids=jnp.maximum(pick(segments.tet_ids), 0),
        lambdas=lambda_enter + inside[:, None] * (lambda_exit - lambda_enter),
        t=t_enter + inside * (t_exit - t_enter),
        deltas=jnp.where(used, deltas, 0),
        rays=rays,
        num_used=num_used,
        overflow=counts < wanted,
        coarsened=fits > max_samples,
    )


def _share(
    steps: Int[Array, "*batch"], jitter: Float[Array, " R"] | None, rays: Int[Array, "*batch"]
) -> Float[Array, "*batch"] | float:
    """Where in its step a ray's sample is."""
    return 0.5 if jitter is None else (jitter[rays] + GOLDEN_RATIO * steps) % 1


def _samples_before(
    config: SamplerConfig,
    ends: Float[Array, "K R"],
    extents: Float[Array, "K R"],
    boundaries: Float[Array, " S+1"],
    scale: Float[Array, " R"],
    counts: Int[Array, " R"],
    jitter: Float[Array, " R"] | None,
) -> Int[Array, "K R"]:
    """How many of its ray's samples lie before the end of each segment; none lies in an empty one."""
    # A parallel sum need not repeat itself over empty slots.
    ends = jax.lax.cummax(jnp.where(extents > 0, ends, 0), axis=0)
    position = ends / jnp.where(scale > 0, scale, 1)
    if config.cone_angle == 0:
        step = (position / config.step).astype(jnp.int32)
    else:
        step = jnp.searchsorted(boundaries, position, side="right").astype(jnp.int32) - 1
    step = jnp.clip(step, 0, boundaries.size - 2)
    rays = jnp.broadcast_to(jnp.arange(ends.shape[1]), ends.shape)
    low, high = boundaries[step], boundaries[step + 1]
    before = step + (low + _share(step, jitter, rays) * (high - low) < position)
    last = ends >= ends[-1] * (1 - 2 * jnp.finfo(ends.dtype).eps)  # rounding leaves no sample behind it
    return jnp.where(last, counts, jnp.minimum(before, counts))


def select_samples(samples: Samples, keep: Bool[Array, " M"]) -> Samples:
    """Only the samples to keep, in the same order at the buffer's start."""
    capacity = samples.t.shape[0]
    keep &= samples.deltas > 0
    chosen, num_used = packed_indices(keep)
    columns = (samples.tet_ids, samples.lambdas, samples.t, samples.deltas, samples.rays)

    def gather(columns: Any, chosen: Array) -> Any:
        return jax.tree.map(lambda x: x[chosen], columns)

    tet_ids, lambdas, t, deltas, rays = map_used(gather, columns, chosen, num_used)
    return Samples(
        tet_ids=tet_ids,
        lambdas=lambdas,
        t=t,
        deltas=jnp.where(jnp.arange(capacity) < num_used, deltas, 0),
        rays=rays,
        num_used=num_used,
        overflow=samples.overflow,
        coarsened=samples.coarsened,
    )
