"""Buffer sizes from the scene: the host-side answer to fixed-size buffers.

A config's capacities are upper bounds that fit most scenes. These helpers measure a scene's rays once and
return a config with just the slots that it needs; what still overflows is flagged per ray and handled by the
caller.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import MarchConfig, RenderConfig
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.sampling import plan_samples, segment_measure, step_boundaries
from nimpostor_jax.render.segments import in_cells, locate_segments
from nimpostor_jax.render.selection import present_samples, slabs_of
from nimpostor_jax.render.traverse import Entries, MarchTables, find_entries, traverse
from nimpostor_jax.types import Embedding, NeuralImpostor, Rays, TetMesh

# A chunk of a frame is 32 image tiles from all over it, whose mean varies by a tenth. Room that is not used
# costs next to nothing; rays that do not fit cost a second program.
SHARED_MARGIN = 1.4
MAX_GROWTH = 6  # doublings of a buffer before giving up


@partial(jax.jit, static_argnames="config")
def ray_entries(mesh: TetMesh, tables: MarchTables, rays: Rays, config: MarchConfig) -> Entries:
    """Where world-space rays enter the cage; those that do not have -1 in their first slot."""
    return find_entries(tables, to_local(mesh, rays), config)


def all_entries(
    mesh: TetMesh, tables: MarchTables, rays: Rays, config: MarchConfig
) -> tuple[Entries, MarchConfig]:
    """`ray_entries` in as many slots as any of these rays needs, and the config with that number.

    Raises ValueError where a ray needs more than 2**6 times the config's slots.
    """
    slots = config.max_entries_per_ray
    for _ in range(MAX_GROWTH + 1):
        config = dataclasses.replace(config, max_entries_per_ray=slots)
        entries = ray_entries(mesh, tables, rays, config)
        if not np.any(entries.overflow):
            break
        slots *= 2
    else:
        raise ValueError(
            f"a ray enters the cage more than {config.max_entries_per_ray} times; "
            "raise MarchConfig.max_entries_per_ray"
        )
    most = max(1, int(np.sum(np.asarray(entries.holds) >= 0, axis=1).max(initial=0)))
    entries = dataclasses.replace(entries, holds=entries.holds[:, :most])
    return entries, dataclasses.replace(config, max_entries_per_ray=most)


class _Demand(NamedTuple):
    tets: Int[Array, " R"]  # that each ray crosses
    overflow: Bool[Array, ""]  # some did not fit
    total: Float[Array, " R"]  # each ray's measure
    planned: Int[Array, ""] | None  # samples in slabs of occupied cells
    occupied: Int[Array, ""] | None  # and in the cells themselves


@partial(jax.jit, static_argnames="config")
def _demand(
    mesh: TetMesh,
    tables: MarchTables,
    rays: Rays,
    config: RenderConfig,
    field: NeuralImpostor | None,
    embedding: Embedding | None,
) -> _Demand:
    local = to_local(mesh, rays)
    crossings = traverse(tables, local, config.march)
    segments = in_cells(locate_segments(mesh, local, crossings, config.near / mesh.scale), embedding)
    measure = segment_measure(segments, config.sampler.measure)
    total = jax.ops.segment_sum(measure, segments.rays, rays.origins.shape[0])
    planned, occupied = None, None
    if field is not None:
        sampler = dataclasses.replace(config.sampler, capacity_per_ray=None, occupied_per_ray=None)
        slabs = slabs_of(field, config)
        plan = plan_samples(segments, sampler, config.density_measure, slabs=slabs)
        planned = plan.num_used
        _, _, occupied = present_samples(field, plan, dataclasses.replace(config, sampler=sampler))
    return _Demand(
        tets=jnp.sum(crossings.codes >= 0, axis=0),
        overflow=jnp.any(crossings.overflow),
        total=total,
        planned=planned,
        occupied=occupied,
    )


def fit_capacities(
    mesh: TetMesh,
    tables: MarchTables,
    rays: Rays,
    config: RenderConfig,
    *,
    field: NeuralImpostor | None = None,
    embedding: Embedding | None = None,
    margin: float = 1.25,
) -> RenderConfig:
    """A config whose buffers hold these sample rays (drawn like those to come), with a margin.

    Steps are measured in the cells of the `embedding`, where tets lie in those (by default in the field's).

    `margin` is that of a single ray's slots; buffers that rays share have `SHARED_MARGIN`. Slots are rounded
    up to multiples of 8; `max_samples_per_ray` of the given config stays the limit. With a `field`, for
    frames of it, the buffers behind its occupancy are fitted too, and `min_weight` is set to 0 where features
    are integrated: no sample has a colour to spare then.
    Raises ValueError where a ray crosses more tets than 2**6 times the config's slots.
    """
    of_frames = field is not None
    embedding = field.embedding if field is not None and embedding is None else embedding
    if field is not None and (field.occupied is None or not config.skip_empty) and not field.gates:
        field = None  # all samples are present
    demand = _demand(mesh, tables, rays, config, field, embedding)
    for _ in range(MAX_GROWTH):
        if not demand.overflow:
            break
        config = grow_march(config)
        demand = _demand(mesh, tables, rays, config, field, embedding)
    if demand.overflow:
        raise ValueError(
            f"a ray crosses more than {config.march.max_tets_per_ray} tets or enters the cage more than "
            f"{config.march.max_entries_per_ray} times; "
            "raise MarchConfig.max_tets_per_ray and max_entries_per_ray"
        )
    boundaries = step_boundaries(config.sampler)
    total = np.asarray(demand.total)
    wanted = np.clip(np.searchsorted(boundaries, total * (1 - 1e-5)), 0, len(boundaries) - 1)
    most = config.sampler.max_samples_per_ray
    if not of_frames:  # another view of the same config may have longer rays
        most = min(most, _round_up(margin * wanted.max()))
    tets = np.asarray(demand.tets)
    planned = wanted.sum() if demand.planned is None else demand.planned
    most_tets = _round_up(margin * int(tets.max()))
    march = dataclasses.replace(
        config.march,
        max_tets_per_ray=most_tets,
        capacity_per_ray=min(most_tets, _mean(tets.sum(), len(tets))),
    )
    sampler = dataclasses.replace(
        config.sampler,
        max_samples_per_ray=most,
        capacity_per_ray=min(most, _mean(planned, len(total))),
        occupied_per_ray=None if field is None else _mean(demand.occupied, len(total)),
    )
    config = dataclasses.replace(config, march=march, sampler=sampler)
    if of_frames and config.integrate == "features":
        config = dataclasses.replace(config, min_weight=0.0)
    return config


def grow_march(config: RenderConfig) -> RenderConfig:
    """Twice the tet slots and entries, and room for rays that need them all."""
    march = dataclasses.replace(
        config.march,
        capacity_per_ray=None,
        max_tets_per_ray=2 * config.march.max_tets_per_ray,
        max_entries_per_ray=2 * config.march.max_entries_per_ray,
    )
    return dataclasses.replace(config, march=march)


def _mean(needed: int | Array, num_rays: int) -> int:
    """Room for a mean ray, with the margin of buffers that many rays share."""
    return max(1, int(np.ceil(SHARED_MARGIN * int(needed) / num_rays)))


def _round_up(value: float) -> int:
    return max(8, int(-(-value // 8)) * 8)
