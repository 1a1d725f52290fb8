"""Samples along rays through tets (Sec. 3.2, Eqs. 3 to 5), packed into one buffer of fixed size.

A ray's samples are spaced evenly, or with Eq. 4's cone growth, in a measure that accumulates over its tets.
Rays need different numbers of samples: they share a buffer of M slots, so that nothing is computed for
samples that a ray does not have. `to_grid` and `from_grid` change between the packed order and [R, S].

Axes: R rays, K tet slots, S samples a ray at most, M packed samples.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

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
    slots: Int[Array, " M"]  # position along the ray
    starts: Int[Array, " R"]  # packed index of the ray's first sample
    counts: Int[Array, " R"]  # samples of the ray that fit into the buffer
    overflow: Bool[Array, " R"]  # some of the ray's samples did not fit
    coarsened: Bool[Array, " R"]  # the ray needed more than S samples and got larger steps


def segment_measure(segments: TetSegments, measure: Measure) -> Float[Array, "R K"]:
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
) -> Samples:
    """Place samples on each ray: at the middle of each step, or stratified within it where `jitter` is given.

    `jitter` in [0, 1) is one number a ray; its samples' places follow by golden-ratio steps, so that they
    depend neither on the batch around the ray nor on the number of devices. Steps are scaled down so that a
    whole number of them fills the ray exactly. Empty rays get no samples.
    """
    num_rays, max_samples = segments.tet_ids.shape[0], config.max_samples_per_ray
    capacity = num_rays * (config.capacity_per_ray or max_samples)
    extents = segment_measure(segments, config.measure)
    ends = jnp.cumsum(extents, axis=1)
    total = ends[:, -1]
    boundaries = jnp.asarray(step_boundaries(config), ends.dtype)
    # The tolerance keeps a ray of exactly n steps from getting n + 1 by rounding.
    fits = jnp.searchsorted(boundaries, jax.lax.stop_gradient(total) * (1 - 1e-5)).astype(jnp.int32)
    wanted = jnp.where(total > 0, jnp.clip(fits, 1, max_samples), 0)
    scale = total / boundaries[jnp.maximum(wanted, 1)]

    firsts = jnp.cumsum(wanted) - wanted
    counts = jnp.clip(capacity - firsts, 0, wanted)
    rays = jnp.repeat(jnp.arange(num_rays, dtype=jnp.int32), counts, total_repeat_length=capacity)
    slots = jnp.arange(capacity, dtype=jnp.int32) - firsts[rays]
    used = slots < counts[rays]
    slots = jnp.where(used, slots, 0)

    low, high = boundaries[slots], boundaries[slots + 1]
    share = 0.5 if jitter is None else (jitter[rays] + GOLDEN_RATIO * slots) % 1
    position = (low + share * (high - low)) * scale[rays]
    segment = _find_segment(ends, extents, rays, position)

    def pick(values: Float[Array, "R K *rest"]) -> Float[Array, "M *rest"]:
        return values[rays, segment]

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
        slots=slots,
        starts=jnp.minimum(firsts, capacity - 1),
        counts=counts,
        overflow=counts < wanted,
        coarsened=fits > max_samples,
    )


def _find_segment(
    ends: Float[Array, "R K"],
    extents: Float[Array, "R K"],
    rays: Int[Array, " M"],
    position: Float[Array, " M"],
) -> Int[Array, " M"]:
    """The first segment of the ray that ends beyond each position, by bisection; never an empty one."""
    num_slots = ends.shape[1]
    ends, extents, position = jax.lax.stop_gradient((ends, extents, position))
    # A parallel sum need not repeat itself over empty slots; the last position may round to the ray's end.
    ends = jax.lax.cummax(jnp.where(extents > 0, ends, 0), axis=1)
    position = jnp.minimum(position, ends[rays, -1] * (1 - 2 * jnp.finfo(ends.dtype).eps))
    flat, base = ends.reshape(-1), rays * num_slots
    low = jnp.zeros_like(rays)
    width = 1 << max(0, (num_slots - 1).bit_length())
    while width > 1:
        width //= 2
        probe = jnp.minimum(low + width, num_slots) - 1
        low = jnp.where(flat[base + probe] <= position, probe + 1, low)
    return jnp.minimum(low, num_slots - 1)


def select_samples(samples: Samples, keep: Bool[Array, " M"]) -> Samples:
    """Only the samples to keep, packed at the buffer's start in the same order."""
    num_rays, capacity = samples.counts.shape[0], samples.t.shape[0]
    keep &= samples.deltas > 0
    counts = jnp.zeros(num_rays, jnp.int32).at[samples.rays].add(keep.astype(jnp.int32))
    firsts = jnp.cumsum(counts) - counts
    chosen = jnp.nonzero(keep, size=capacity, fill_value=0)[0]
    packed = jnp.arange(capacity, dtype=jnp.int32)
    used = packed < jnp.sum(counts)
    rays = samples.rays[chosen]
    return Samples(
        tet_ids=samples.tet_ids[chosen],
        lambdas=samples.lambdas[chosen],
        t=samples.t[chosen],
        deltas=jnp.where(used, samples.deltas[chosen], 0),
        rays=rays,
        slots=jnp.where(used, packed - firsts[rays], 0),
        starts=jnp.minimum(firsts, capacity - 1),
        counts=counts,
        overflow=samples.overflow,
        coarsened=samples.coarsened,
    )


def to_grid(values: Float[Array, "M *rest"], samples: Samples, max_samples: int) -> Float[Array, "R S *rest"]:
    """Packed values as [R, S]; zero where a ray has no sample. Linear; its transpose is `from_grid`."""
    slots = jnp.arange(max_samples, dtype=jnp.int32)
    used = slots < samples.counts[:, None]
    index = jnp.where(used, samples.starts[:, None] + slots, 0)
    return _to_grid(values, index, used, samples.rays * max_samples + samples.slots, samples.deltas > 0)


def from_grid(values: Float[Array, "R S"], samples: Samples) -> Float[Array, " M"]:
    """Values on [R, S] in packed order; zero in unused slots."""
    return jnp.where(samples.deltas > 0, values[samples.rays, samples.slots], 0)


@jax.custom_vjp
def _to_grid(values, index, used, back_index, back_used):  # type: ignore[no-untyped-def]
    return jnp.where(used.reshape(used.shape + (1,) * (values.ndim - 1)), values[index], 0)


def _to_grid_forward(values, index, used, back_index, back_used):  # type: ignore[no-untyped-def]
    return _to_grid(values, index, used, back_index, back_used), (back_index, back_used)


def _to_grid_backward(residuals, cotangent):  # type: ignore[no-untyped-def]
    # Packed and gridded samples correspond one to one: the transpose of this gather is a gather.
    back_index, back_used = residuals
    flat = cotangent.reshape(-1, *cotangent.shape[2:])[back_index]
    return (
        jnp.where(back_used.reshape(-1, *(1,) * (flat.ndim - 1)), flat, 0),
        None,
        None,
        None,
        None,
    )


_to_grid.defvjp(_to_grid_forward, _to_grid_backward)
