"""How much is seen of each part of a region's new tets: that is where tables matter most.

A table has fewer entries than its finer levels have nodes. Training decides which of them an entry serves by
what the pictures show; points spread evenly over the volume would let it serve what is hidden as well.

Axes: n tets of the region, M samples.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import RenderConfig, RetrainConfig
from nimpostor_jax.edit.region import Region
from nimpostor_jax.field import impostor as field
from nimpostor_jax.geometry.barycentric import barycentric
from nimpostor_jax.geometry.locate import LocateTables, locate, locate_tables
from nimpostor_jax.geometry.tetrahedron import corners
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.occupancy import cell_index
from nimpostor_jax.render.renderer import render_samples
from nimpostor_jax.render.selection import optical_weights, sample_densities
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import PixelPool, draw_batch
from nimpostor_jax.train.sharding import device_mesh, dividing_devices, over_rays, replicated, sums_by_device
from nimpostor_jax.train.step import RayBatch
from nimpostor_jax.types import NeuralImpostor, TetMesh

RAYS = 1 << 16  # that look; a part that none of them sees is not forgotten, but only looked at less


class NewMesh(NamedTuple):
    """Where to look for points of the old one."""

    mesh: TetMesh
    tables: LocateTables


def seen_parts(
    old: NeuralImpostor,
    new: NeuralImpostor,
    region: Region,
    pool: PixelPool,
    render: RenderConfig,
    config: RetrainConfig,
) -> Float[Array, "n parts"] | None:
    """What the parts of the region's tets contribute to the pool's pixels, where the old impostor is seen.

    The parts are those of the new impostor's occupancy; None where it has none. Host loop. Rays that do not
    fit into buffers count as far as they do.
    """
    if new.occupied is None:
        return None
    key, size = jax.random.key(config.seed + 3), config.rays_per_batch
    sample = draw_batch(key, 0, pool, size, "random")
    tables = march_tables(old.mesh)
    sized = fit_capacities(old.mesh, tables, sample.rays, render, embedding=old.embedding)
    # Where places in the old mesh are known, tets may overlap, and must not be sought.
    target = None if region.sources is not None else NewMesh(new.mesh, locate_tables(new.mesh))
    tets = region.tets if region.sources is None else region.sources
    rows = np.full(len((new if region.sources is None else old).mesh.tets), region.tets.size, np.int32)
    rows[np.asarray(tets)] = np.arange(region.tets.size)
    mesh = device_mesh(dividing_devices(size))
    shared = jax.device_put((old, target, jnp.asarray(rows)), replicated(mesh))
    seen = jnp.zeros((mesh.size, region.tets.size, new.occupied.shape[1]), new.mesh.vertices.dtype)
    seen = jax.device_put(seen, over_rays(mesh))
    add = jax.jit(sums_by_device(mesh, add_seen), static_argnames="config", donate_argnums=0)
    for i in range(-(-RAYS // size)):
        batch = jax.device_put(draw_batch(key, i, pool, size, "random"), over_rays(mesh))
        seen = add(seen, *shared, batch, config=sized)
    return jnp.asarray(np.sum(np.asarray(seen), axis=0))


def add_seen(
    seen: Float[Array, "n parts"],
    old: NeuralImpostor,
    target: NewMesh | None,
    rows: Int[Array, " T"],
    batch: RayBatch,
    config: RenderConfig,
) -> Float[Array, "n parts"]:
    """`seen` and the weights of a batch's samples, in the parts of the region's tets where they lie.

    These are sought in the `target`, which has the old mesh's frame; without one, they are the old mesh's
    tets in which the samples are. `rows` are those tets' numbers in the region, n for others.
    """
    _, samples = render_samples(old, batch.rays, config, batch.jitter)
    features = field.features(old, samples.tet_ids, samples.lambdas, samples.num_used)
    sigmas = sample_densities(old, samples.tet_ids, features, samples.num_used)
    weights = optical_weights(sigmas, samples)
    local, mesh = to_local(old.mesh, batch.rays), old.mesh
    points = local.origins[samples.rays] + samples.t[:, None] * local.directions[samples.rays]
    if target is None:
        tets = samples.tet_ids if samples.mesh_tets is None else samples.mesh_tets
        lambdas = barycentric(points, corners(mesh.vertices, mesh.tets[tets]))
    else:
        tets, lambdas = locate(target.mesh, mesh.center + mesh.scale * points, target.tables)
    at = jnp.where((tets >= 0) & (samples.deltas > 0), rows[jnp.maximum(tets, 0)], len(seen))
    parts = cell_index(jnp.zeros_like(tets), lambdas, seen.shape[1])
    return seen.at[at, parts].add(weights, mode="drop")
