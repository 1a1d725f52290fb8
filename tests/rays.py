"""Rays for the tests of the renderer, as NumPy float64: (origins [R,3], directions [R,3])."""

import jax.numpy as jnp
import numpy as np

from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.types import Rays


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def as_rays(rays, dtype="float32"):
    origins, directions = rays
    return Rays(origins=jnp.asarray(origins, dtype), directions=jnp.asarray(directions, dtype))


def towards(targets, rng, distance=3.0):
    """Rays from random points around the mesh through the given targets."""
    directions = unit(rng.normal(size=targets.shape))
    return targets - distance * directions, directions


def inside_points(vertices, tets, rng, count):
    chosen = rng.integers(0, len(tets), count)
    weights = rng.dirichlet(np.ones(4), count)
    return np.einsum("ri,rix->rx", weights, vertices[tets[chosen]])


def generic(vertices, tets, rng, count):
    """Through random points of the mesh, a quarter of them starting there."""
    points = inside_points(vertices, tets, rng, count)
    origins, directions = towards(points, rng)
    starts = np.arange(count) % 4 == 0
    return np.where(starts[:, None], points, origins), directions


def missing(vertices, tets, rng, count):
    """Rays whose lines stay clear of the mesh's bounding sphere."""
    directions = unit(rng.normal(size=(count, 3)))
    side = unit(np.cross(directions, rng.normal(size=(count, 3))))
    return side * rng.uniform(1.1, 3, (count, 1)) - 2 * directions, directions


def through_vertices(vertices, tets, rng, count):
    return towards(vertices[rng.integers(0, len(vertices), count)], rng)


def through_edges(vertices, tets, rng, count):
    chosen = tets[rng.integers(0, len(tets), count)]
    share = rng.uniform(0.1, 0.9, (count, 1))
    return towards(share * vertices[chosen[:, 0]] + (1 - share) * vertices[chosen[:, 2]], rng)


def along_edges(vertices, tets, rng, count):
    chosen = tets[rng.integers(0, len(tets), count)]
    start, end = vertices[chosen[:, 1]], vertices[chosen[:, 3]]
    directions = unit(end - start)
    return start - 2 * directions, directions


def along_faces(vertices, tets, rng, count):
    """In the plane of a face, through its inside."""
    chosen = tets[rng.integers(0, len(tets), count)]
    face = vertices[chosen[np.arange(count)[:, None], np.array(FACES)[rng.integers(0, 4, count)]]]
    a, b = (np.einsum("ri,rix->rx", rng.dirichlet(np.ones(3), count), face) for _ in range(2))
    directions = unit(b - a)
    return a - 2 * directions, directions


def along_axes(vertices, tets, rng, count):
    """Parallel to an axis, through random points and through vertices."""
    points = inside_points(vertices, tets, rng, count)
    points[::2] = vertices[rng.integers(0, len(vertices), len(points[::2]))]
    directions = np.concatenate([np.eye(3), -np.eye(3)])[np.arange(count) % 6]
    return points - 3 * directions, directions


GENERIC = {"generic": generic, "missing": missing}
DEGENERATE = {
    f.__name__: f for f in (through_vertices, through_edges, along_edges, along_faces, along_axes)
}  # fmt: skip


def by_ray(segments):
    """Segments with rays as the first axis and slots as the second, empty ones last; differentiable."""
    num_rays = segments.overflow.shape[0]
    slots = segments.rays.shape[0] // max(num_rays, 1)
    counts = jnp.zeros(num_rays, int).at[segments.rays].add(1)
    slot = jnp.arange(segments.rays.shape[0]) - (jnp.cumsum(counts) - counts)[segments.rays]

    def spread(values, fill):
        empty = jnp.full((num_rays, slots, *values.shape[1:]), fill, values.dtype)
        return empty.at[segments.rays, slot].set(values, mode="drop")

    names = ("rays", "t_enter", "t_exit", "lambda_enter", "lambda_exit")
    dense = {name: spread(getattr(segments, name), 0) for name in names}
    return segments.replace(tet_ids=spread(segments.tet_ids, -1), **dense)
