"""Samples along rays through tets (Sec. 3.2, Eqs. 3 to 5), packed into one buffer of fixed size.

A ray's samples are spaced evenly, or with Eq. 4's cone growth, in a measure that accumulates over its tets.
Rays need different numbers of samples: they share a buffer of M slots, so that nothing is computed for
samples that a ray does not have.

Axes: N packed segments, R rays, S samples a ray at most, M packed samples.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, map_used, running
from nimpostor_jax.config import EncodingConfig, Measure, RenderConfig, SamplerConfig
from nimpostor_jax.render.composite import sum_before
from nimpostor_jax.render.occupancy import Slabs
from nimpostor_jax.types import TetSegments

GOLDEN_RATIO = 0.6180339887498949
STEP_CELLS = 2.0  # of the field's finest level that a step crosses
MAX_STEP = 0.5  # at least four samples across a tet


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
    mesh_tets: Int[Array, " M"] | None = None  # the mesh's tets, where `tet_ids` are a field's cells


@struct.dataclass
class SamplePlan:
    """The samples of all rays, numbered by ray and along the ray: where they are, but not yet what."""

    segments: TetSegments
    starts: Float[Array, " N"]  # measure of the ray before each segment
    extents: Float[Array, " N"]
    density: Float[Array, " N"]  # of the density measure in one unit of the step measure
    boundaries: Float[Array, " S+1"]
    scale: Float[Array, " R"]  # of the ray's steps
    offsets: Int[Array, " N"]  # from steps on the ray to numbers of samples, in each segment
    jitter: Float[Array, " R"] | None
    owners: Int[Array, " M"]  # the segment of each sample
    num_used: Int[Array, ""]
    overflow: Bool[Array, " R"]
    coarsened: Bool[Array, " R"]


def segment_measure(segments: TetSegments, measure: Measure) -> Float[Array, " N"]:
    """Extent of each segment: L1 barycentric distance (Eq. 9), 1 a tet (Eq. 4), or length; 0 if empty."""
    if measure == "barycentric":
        return jnp.sum(jnp.abs(segments.lambda_exit - segments.lambda_enter), axis=-1)
    if measure == "alpha":
        return jnp.where(segments.tet_ids >= 0, 1.0, 0.0).astype(segments.t_exit.dtype)
    return segments.t_exit - segments.t_enter


def with_step(config: RenderConfig, field: EncodingConfig) -> RenderConfig:
    """The config with a step: its own, or one that crosses `STEP_CELLS` cells of the field's finest level.

    A field cannot show more than its finest cells do, which training fits to its pixels. Raises ValueError
    where the field's cells do not say how long a step is in the sampler's measure.
    """
    sampler = config.sampler
    if sampler.step is not None:
        return config
    if sampler.measure == "euclidean" or field.layout == "box":
        raise ValueError(
            "SamplerConfig.step must be given for measure 'euclidean' and for EncodingConfig.layout 'box'"
        )
    tet = 2.0 if sampler.measure == "barycentric" else 1.0  # measure of a whole crossing
    step = tet * min(STEP_CELLS / max(field.resolutions), MAX_STEP / 2)
    return dataclasses.replace(config, sampler=dataclasses.replace(sampler, step=step))


def known_step(config: SamplerConfig) -> float:
    """The config's step, in its measure. Raises ValueError where it has none (`with_step`)."""
    if config.step is None:
        raise ValueError("SamplerConfig.step is not known without a field; see render.sampling.with_step")
    return config.step


def step_boundaries(config: SamplerConfig) -> np.ndarray:
    """Distances from the first tet's entry at which steps end, [S + 1], before fitting to a ray (Eq. 4).

    Raises ValueError as `known_step`.
    """
    step, travelled = known_step(config), [0.0]
    for _ in range(config.max_samples_per_ray):
        travelled.append(travelled[-1] + step)
        step += config.cone_angle * travelled[-1]
    return np.asarray(travelled)


def plan_samples(
    segments: TetSegments,
    config: SamplerConfig,
    density_measure: Measure,
    jitter: Float[Array, " R"] | None = None,
    refinement: Float[Array, " R"] | None = None,
    slabs: Slabs | None = None,
) -> SamplePlan:
    """Count each ray's samples: at the middle of each step, or stratified within it where `jitter` is given.

    `jitter` in [0, 1) is one number a ray; its samples' places follow by golden-ratio steps, so that they
    depend neither on the batch around the ray nor on the number of devices. Steps are scaled down so that a
    whole number of them fills the ray exactly. Empty rays get no samples. `refinement` divides a ray's steps
    (with cone growth, later ones by less). Samples outside the `slabs` of their tets are left out.
    """
    num_rays, owners = segments.overflow.shape[0], segments.rays
    max_samples = config.max_samples_per_ray
    capacity = num_rays * (config.capacity_per_ray or max_samples)
    capacity += -capacity % default_chunk(capacity)  # whole chunks need no padding later
    extents = segment_measure(segments, config.measure)
    starts = sum_before(extents, owners)
    total = jax.ops.segment_sum(extents, owners, num_rays, indices_are_sorted=True)
    # Cones open exponentially: steps that no ray is long enough for must stay finite, too.
    most = math.sqrt(jnp.finfo(extents.dtype).max)
    boundaries = jnp.asarray(np.minimum(step_boundaries(config), most), extents.dtype)
    # The tolerance keeps a ray of exactly n steps from getting n + 1 by rounding.
    asked = jax.lax.stop_gradient(total if refinement is None else total * refinement)
    fits = jnp.searchsorted(boundaries, asked * (1 - 1e-5)).astype(jnp.int32)
    counts = jnp.where(total > 0, jnp.clip(fits, 1, max_samples), 0)
    scale = total / boundaries[jnp.maximum(counts, 1)]
    if density_measure == config.measure:
        density = jnp.ones_like(extents)
    else:
        density = segment_measure(segments, density_measure) / jnp.where(extents > 0, extents, 1)

    grid = _Steps(boundaries, scale, counts, total, jitter)
    before = grid.before(config, owners, starts)
    same_ray = jnp.pad(owners[1:] == owners[:-1], (0, min(1, owners.size)))
    until = jnp.where(same_ray, jnp.roll(before, -1), counts[owners])
    if slabs is not None:
        enter, leave = _shares_inside(segments, slabs)
        until = jnp.minimum(until, grid.before(config, owners, starts + leave * extents))
        before = jnp.maximum(before, grid.before(config, owners, starts + enter * extents))
    wanted = jnp.where(extents > 0, jnp.maximum(until - before, 0), 0)
    firsts = running(jnp.add, wanted, 0) - wanted
    lost = firsts + wanted > capacity
    # Each segment with samples marks its first; the marks ascend, so that a running maximum spreads them.
    places = jnp.where(wanted > 0, firsts, capacity)
    order = jnp.arange(owners.size, dtype=jnp.int32)
    marks = jnp.zeros(capacity, jnp.int32).at[places].set(order, mode="drop")
    return SamplePlan(
        segments=segments,
        starts=starts,
        extents=extents,
        density=density,
        boundaries=boundaries,
        scale=scale,
        offsets=firsts - before,
        jitter=jitter,
        owners=running(jnp.maximum, marks, 0),
        num_used=jnp.minimum(jnp.sum(wanted), capacity),
        overflow=jnp.zeros(num_rays, bool).at[owners].max(lost & (wanted > 0)),
        coarsened=fits > max_samples,
    )


def _shares_inside(segments: TetSegments, slabs: Slabs) -> tuple[Float[Array, " N"], Float[Array, " N"]]:
    """The share of each segment before it enters its tet's slabs, and until it leaves them."""
    first, last, tets = jax.lax.stop_gradient(
        (segments.lambda_enter, segments.lambda_exit, jnp.maximum(segments.tet_ids, 0))
    )
    change = last - first
    change = jnp.where(change == 0, jnp.finfo(change.dtype).tiny, change)  # inside or outside all along
    to_low, to_high = (slabs.low[tets] - first) / change, (slabs.high[tets] - first) / change
    enter = jnp.max(jnp.where(change > 0, to_low, to_high), axis=1)
    leave = jnp.min(jnp.where(change > 0, to_high, to_low), axis=1)
    return jnp.clip(enter, 0, 1), jnp.clip(leave, 0, 1)


def place_samples(plan: SamplePlan, chosen: Int[Array, " M"], num_used: Int[Array, ""]) -> Samples:
    """The first `num_used` of the chosen samples, by ray; differentiable in the plan's segments."""
    arrays = dataclasses.replace(plan, owners=None, overflow=None, coarsened=None)  # type: ignore[arg-type]
    columns = map_used(place, arrays, (chosen, plan.owners[chosen]), num_used)
    tet_ids, lambdas, t, deltas, rays, mesh_tets = columns
    return Samples(
        tet_ids=tet_ids,
        lambdas=lambdas,
        t=t,
        deltas=jnp.where(jnp.arange(chosen.size) < num_used, deltas, 0),
        rays=rays,
        num_used=num_used,
        overflow=plan.overflow,
        coarsened=plan.coarsened,
        mesh_tets=mesh_tets,
    )


def place(plan: SamplePlan, items: tuple[Int[Array, " M"], Int[Array, " M"]]) -> tuple:
    """Tets [M], coordinates [M, 4], t, interval lengths, rays and (or None) mesh tets [M] of samples (Eq. 5).

    Samples are given by their numbers and segments. Reads neither `owners` nor the plan's flags.
    """
    numbers, owners = items
    segments = plan.segments
    rays = segments.rays[owners]
    steps = jnp.clip(numbers - plan.offsets[owners], 0, plan.boundaries.size - 2)
    low, high, scale = plan.boundaries[steps], plan.boundaries[steps + 1], plan.scale[rays]
    position = (low + _share(steps, plan.jitter, rays) * (high - low)) * scale
    extent = plan.extents[owners]
    end = plan.starts[owners] + extent
    inside = jnp.clip(1 - (end - position) / jnp.where(extent > 0, extent, 1), 0, 1)
    lambda_enter, t_enter = segments.lambda_enter[owners], segments.t_enter[owners]
    return (
        jnp.maximum(segments.tet_ids[owners], 0),
        lambda_enter + inside[:, None] * (segments.lambda_exit[owners] - lambda_enter),
        t_enter + inside * (segments.t_exit[owners] - t_enter),
        (high - low) * scale * plan.density[owners],
        rays,
        None if segments.mesh_tets is None else jnp.maximum(segments.mesh_tets[owners], 0),
    )


def _share(
    steps: Int[Array, " n"], jitter: Float[Array, " R"] | None, rays: Int[Array, " n"]
) -> Float[Array, " n"] | float:
    """Where in its step a ray's sample is."""
    return 0.5 if jitter is None else (jitter[rays] + GOLDEN_RATIO * steps) % 1


class _Steps(NamedTuple):
    """The steps of all rays."""

    boundaries: Float[Array, " S+1"]
    scale: Float[Array, " R"]
    counts: Int[Array, " R"]
    total: Float[Array, " R"]
    jitter: Float[Array, " R"] | None

    def before(
        self, config: SamplerConfig, rays: Int[Array, " N"], measure: Float[Array, " N"]
    ) -> Int[Array, " N"]:
        """How many of a ray's samples lie before places on it."""
        boundaries, scale, counts = self.boundaries, self.scale[rays], self.counts[rays]
        position = measure / jnp.where(scale > 0, scale, 1)
        if config.cone_angle == 0:
            step = (position / boundaries[1]).astype(jnp.int32)
        else:
            step = jnp.searchsorted(boundaries, position, side="right").astype(jnp.int32) - 1
        step = jnp.clip(step, 0, boundaries.size - 2)
        low, high = boundaries[step], boundaries[step + 1]
        found = step + (low + _share(step, self.jitter, rays) * (high - low) < position)
        # Rounding leaves no sample behind the last segment.
        done = measure >= self.total[rays] * (1 - 2 * jnp.finfo(measure.dtype).eps)
        return jnp.where(done, counts, jnp.minimum(found, counts))
