"""What an old field has at points of a new impostor's region: features, colours, and which parts are empty.

Axes: M points, C features.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import RetrainConfig
from nimpostor_jax.edit.region import Region
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import is_kept, painted, to_cells
from nimpostor_jax.geometry.locate import LocateTables, locate
from nimpostor_jax.geometry.tetrahedron import corners, signed_volumes
from nimpostor_jax.render.occupancy import in_occupied_cells, random_points
from nimpostor_jax.types import NeuralImpostor, TetMesh

EMPTY_SHARE = 0.1  # of the points in occupied parts, as many in others of the same volume
SEEN_SHARE = 0.8  # of the points that go where something is seen
OCCUPANCY_POINTS = 16  # in each part of a new cell, to find out what is occupied
INWARD = 1e-3  # of the way to the tet's middle


@struct.dataclass
class Points:
    """Points in a region's tets, and what the old field has there."""

    tets: Int[Array, " M"]  # of the new mesh
    lambdas: Float[Array, "M 4"]
    features: Float[Array, "M C"]  # 0 where there is no old field
    densities: Float[Array, " M"]  # per unit of the new tets' barycentric measure
    directions: Float[Array, "M 3"]  # from all sides
    colors: Float[Array, "M 3"]  # seen from there
    present: Bool[Array, " M"]  # in the old mesh, and let through by its gates


@partial(jax.jit, static_argnames=("count", "measure"))
def draw_points(
    key: Array,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    *,
    count: int,
    measure: str,
) -> Points:
    """Points in the region's tets, and what the old field has there (Eq. 12, stage 1).

    Most lie where something is seen, as far as that is known (`visibility.seen_parts`), the others even over
    the volume; where occupancy is known, ten times as dense in occupied parts. `measure` is that of
    densities: barycentric ones change with the size of tets.
    """
    point_key, side_key = jax.random.split(key)
    mesh = new.mesh
    chosen, lambdas = _random_places(point_key, new, region, count)
    found, cells, places = _in_old(old, source, new, region, chosen, lambdas)
    inside, tets = found >= 0, jnp.maximum(found, 0)
    present = inside & is_kept(old, tets, places)
    features = jnp.where(inside[:, None], field.features(old, cells, places), 0)
    densities = field.density(old, cells, features)
    if measure == "barycentric":
        densities *= _size(mesh, region.tets[chosen]) / _cell_size(old, tets)
    directions = _unit(jax.random.normal(side_key, (count, 3), lambdas.dtype))
    colors = field.radiance(old, cells, features, field.encode_directions(old, directions))
    return Points(
        tets=region.tets[chosen],
        lambdas=lambdas,
        features=features,
        densities=jnp.where(present, densities, 0),
        directions=directions,
        colors=painted(old.paints, tets, places, directions, colors),
        present=present,
    )


def _size(mesh: TetMesh, tets: Int[Array, " M"]) -> Float[Array, " M"]:
    """Edge of a cube of each tet's volume; of flat tets next to nothing, but not nothing."""
    volumes = jnp.abs(signed_volumes(corners(mesh.vertices, mesh.tets[tets])))
    return jnp.cbrt(jnp.maximum(volumes, jnp.finfo(volumes.dtype).tiny))


def _cell_size(impostor: NeuralImpostor, tets: Int[Array, " M"]) -> Float[Array, " M"]:
    """The size that the cells around tets have where these are."""
    size = _size(impostor.mesh, tets)
    if impostor.embedding is None:
        return size
    shares = jnp.abs(jnp.linalg.det(impostor.embedding.lambdas))
    return size / jnp.cbrt(jnp.maximum(shares, jnp.finfo(shares.dtype).tiny))[tets]


def _unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def _random_places(
    key: Array, new: NeuralImpostor, region: Region, count: int
) -> tuple[Int[Array, " M"], Float[Array, "M 4"]]:
    """Which of the region's tets, and where in it."""
    choice_key, place_key = jax.random.split(key)
    volumes = jnp.maximum(signed_volumes(corners(new.mesh.vertices, new.mesh.tets[region.tets])), 0)
    if new.occupied is None:
        chosen = jax.random.choice(choice_key, volumes.size, (count,), p=volumes / jnp.sum(volumes))
        shares = jax.random.exponential(place_key, (count, 4), volumes.dtype)
        return chosen, shares / jnp.sum(shares, axis=1, keepdims=True)
    occupied = new.occupied[_cells_of_region(new, region)]
    weights = volumes[:, None] * jnp.where(occupied, 1.0, EMPTY_SHARE)
    weights /= jnp.sum(weights)
    if region.seen is not None:
        total = jnp.sum(region.seen)
        share = jnp.where(total > 0, SEEN_SHARE / jnp.where(total > 0, total, 1), 0)
        weights = (1 - SEEN_SHARE) * weights + share * region.seen
    parts = jax.random.choice(choice_key, weights.size, (count,), p=weights.reshape(-1) / jnp.sum(weights))
    chosen, lambdas = random_points(place_key, parts, occupied.shape[1])
    return chosen, lambdas.astype(volumes.dtype)


def _cells_of_region(new: NeuralImpostor, region: Region) -> Int[Array, " n"]:
    return region.tets if new.embedding is None else new.embedding.cells[region.tets]


def occupancy_of(
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    config: RetrainConfig,
) -> Bool[Array, "C parts"] | None:
    """The new impostor's occupancy, with that of the old one in the region's cells. Host loop.

    Every part of every cell is looked into at as many points: what is missed here is never rendered again.
    """
    if new.occupied is None or old.occupied is None:
        return new.occupied
    cells, num_parts = np.asarray(_cells_of_region(new, region)), new.occupied.shape[1]
    everything = np.arange(len(cells) * num_parts)
    found, batch = np.zeros(everything.size, bool), config.points_per_batch
    key = jax.random.key(config.seed + 2)
    for _ in range(OCCUPANCY_POINTS):
        for start in range(0, everything.size, batch):
            key, point_key = jax.random.split(key)
            parts = np.resize(everything[start : start + batch], batch).astype(np.int32)
            found[parts] |= np.asarray(_occupied_at(point_key, old, source, new, region, parts))
    return new.occupied.at[cells].set(jnp.asarray(found.reshape(len(cells), num_parts)))


@jax.jit
def _occupied_at(
    key: Array,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    parts: Int[Array, " M"],
) -> Bool[Array, " M"]:
    """Whether the old impostor is occupied at a random point of each part, numbered over the region."""
    assert new.occupied is not None and old.occupied is not None
    chosen, lambdas = random_points(key, parts, new.occupied.shape[1])
    lambdas += INWARD * (0.25 - lambdas)  # many lie on faces, where the tet beyond would be found
    tets, cells, places = _in_old(old, source, new, region, chosen, lambdas.astype(new.mesh.vertices.dtype))
    held = jnp.maximum(tets, 0)
    return (tets >= 0) & in_occupied_cells(old.occupied, cells, places) & is_kept(old, held, places)


def _in_old(
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    chosen: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
) -> tuple[Int[Array, " M"], Int[Array, " M"], Float[Array, "M 4"]]:
    """Points in the region's tets, by number, in the old mesh: tets (-1 outside), cells, coordinates."""
    mesh = new.mesh
    if region.sources is None:
        positions = corners(mesh.vertices, mesh.tets[region.tets[chosen]])
        world = mesh.center + mesh.scale * jnp.sum(lambdas[:, :, None] * positions, axis=1)
        found, places = locate(old.mesh, world, source)
    else:
        found, places = region.sources[chosen], lambdas
    return found, *to_cells(old.embedding, jnp.maximum(found, 0), places)
