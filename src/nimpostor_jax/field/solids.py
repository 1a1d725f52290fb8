"""What is inside a solid; which points gates let through (Eqs. 13 and 14), and what colour paints give them.

Axes: M points, T tets of the mesh.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.field import impostor as field
from nimpostor_jax.geometry.locate import locate
from nimpostor_jax.types import (
    Embedding,
    FunctionSolid,
    Gate,
    GridSolid,
    ImpostorSolid,
    NeuralImpostor,
    Paint,
    Solid,
)

OPEN, CLOSED, MIXED = 0, 1, 2  # states of a tet for a gate


def is_inside(solid: Solid, points: Float[Array, "M 3"]) -> Bool[Array, " M"]:
    """Whether each world point is inside the solid."""
    if isinstance(solid, FunctionSolid):
        values = solid.function(points)
        if jnp.shape(values) != points.shape[:-1]:
            raise ValueError(f"a solid's function must return {points.shape[:-1]}, got {jnp.shape(values)}")
        return values > 0
    if isinstance(solid, GridSolid):
        return grid_value(solid, points) > 0
    return _fills(solid, points)


def grid_value(solid: GridSolid, points: Float[Array, "M 3"]) -> Float[Array, " M"]:
    """The grid's values at world points, trilinear; minus infinity outside."""
    to_grid = solid.world_to_grid
    places = [jnp.sum(points * to_grid[i, :3], axis=-1) + to_grid[i, 3] for i in range(3)]
    known = jnp.ones(points.shape[:-1], bool)
    for place, size in zip(places, solid.values.shape, strict=True):
        known &= (place >= -0.5) & (place <= size - 0.5)
    values = jax.scipy.ndimage.map_coordinates(solid.values, places, order=1, mode="nearest")
    return jnp.where(known, values, -jnp.inf)


def _fills(solid: ImpostorSolid, points: Float[Array, "M 3"]) -> Bool[Array, " M"]:
    impostor = solid.impostor
    filled = jnp.zeros(points.shape[:-1], bool)
    for mesh, tet_ids in zip(solid.objects, solid.tet_ids, strict=True):
        found, lambdas = locate(mesh, points)
        tets = tet_ids[jnp.maximum(found, 0)]
        cells, places = to_cells(impostor.embedding, tets, lambdas)
        features = field.features(impostor, cells, places)
        dense = field.density(impostor, cells, features) > solid.threshold
        filled |= (found >= 0) & dense & is_kept(impostor, tets, places)
    return filled


def to_cells(
    embedding: Embedding | None, tets: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> tuple[Int[Array, " M"], Float[Array, "M 4"]]:
    """Points of the mesh in the cells and coordinates of its field."""
    if embedding is None:
        return tets, lambdas
    return embedding.cells[tets], jnp.sum(lambdas[:, :, None] * embedding.lambdas[tets], axis=1)


def is_kept(
    impostor: NeuralImpostor, mesh_tets: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> Bool[Array, " M"]:
    """Whether all gates let points through, given by tet of the mesh and coordinates in its cell."""
    kept = jnp.ones(mesh_tets.shape, bool)
    for gate in impostor.gates:
        points, states = _as_made(gate, mesh_tets, lambdas)
        passes = is_inside(gate.solid, points) == gate.inside
        kept &= (states == OPEN) | ((states == MIXED) & passes)
    return kept


def painted(
    paints: tuple[Paint, ...],
    mesh_tets: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    directions: Float[Array, "M 3"],
    colors: Float[Array, "M 3"],
) -> Float[Array, "M 3"]:
    """Colours after all paints; directions are the views' in the world."""
    for paint in paints:
        points, states = _as_made(paint, mesh_tets, lambdas)
        inside = (states == CLOSED) | ((states == MIXED) & is_inside(paint.solid, points))
        new = colors * paint.color
        if paint.source is not None:
            material = colors_at(paint.source, points, directions)
            new += paint.share * (material - new)
        colors = jnp.where(inside[:, None], new, colors)
    return colors


def colors_at(
    impostor: NeuralImpostor, points: Float[Array, "M 3"], directions: Float[Array, "M 3"]
) -> Float[Array, "M 3"]:
    """An impostor's colours at world points, seen in world directions; black where there is nothing of it."""
    tets, lambdas = locate(impostor.mesh, points)
    held = jnp.maximum(tets, 0)
    cells, places = to_cells(impostor.embedding, held, lambdas)
    features = field.features(impostor, cells, places)
    colors = field.radiance(impostor, cells, features, field.encode_directions(impostor, directions))
    colors = painted(impostor.paints, held, places, directions, colors)
    return jnp.where(((tets >= 0) & is_kept(impostor, held, places))[:, None], colors, 0)


def _as_made(
    part: Gate | Paint, mesh_tets: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> tuple[Float[Array, "M 3"], Int[Array, " M"]]:
    """Where points were in the world when a gate or paint was made, and the states of their tets."""
    points = jnp.sum(lambdas[:, :, None] * part.corners[mesh_tets], axis=1)
    return points, part.states[mesh_tets]
