"""Meshes and rays of the stress test: whatever is hard on traversal."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial import Delaunay

from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.preprocess.validate import orient_tets
from nimpostor_jax.types import BoundaryFaces, TetMesh

Points = np.ndarray
Geometry = tuple[np.ndarray, np.ndarray]  # vertices [V, 3] and tets [T, 4], or origins and directions [R, 3]

# Small meshes are padded to one size, so that each precision compiles once for all of them.
ROOM = {"tets": 384, "vertices": 192, "faces": 256}


class Case(NamedTuple):
    """A mesh under stress."""

    geometry: Geometry  # in world units
    moved: Points | None = None  # the vertices after a deformation
    world_rays: bool = False  # rays are rounded in world units, and brought into the mesh's frame from there
    chunk: int = 2048  # rays at a time: the oracle takes rays x tets
    slots: int = 96


def build(case: Case, dtype: str) -> TetMesh:
    """The case's mesh, deformed and padded."""
    mesh = build_tet_mesh(*case.geometry, dtype=dtype)
    if case.moved is not None:
        local = (case.moved - np.asarray(mesh.center, np.float64)) / np.float64(mesh.scale)
        mesh = mesh.replace(vertices=jnp.asarray(local, dtype))
    return padded(mesh)


def padded(mesh: TetMesh) -> TetMesh:
    """With flat tets that nothing leads to, up to `ROOM`; larger meshes as they are."""
    faces = mesh.boundary.tets.reshape(-1, 1)
    counts = {"tets": len(mesh.tets), "vertices": len(mesh.vertices), "faces": len(faces)}
    if any(counts[name] > ROOM[name] for name in ROOM):
        return mesh
    more = {name: ((0, ROOM[name] - counts[name]), (0, 0)) for name in ROOM}
    corners = mesh.boundary.corners.reshape(-1, 1)
    return mesh.replace(
        vertices=jnp.pad(mesh.vertices, more["vertices"]),
        tets=jnp.pad(mesh.tets, more["tets"]),
        neighbors=jnp.pad(mesh.neighbors, more["tets"], constant_values=-1),
        object_ids=jnp.zeros(ROOM["tets"], jnp.int32),
        boundary=BoundaryFaces(
            tets=jnp.pad(faces, more["faces"], constant_values=-1),
            corners=jnp.pad(corners, more["faces"], constant_values=-1),
        ),
        tet_leaves=mesh.tet_leaves[:1],  # for point queries, of which there are none
    )


# ---- meshes ------------------------------------------------------------------------------------------------


def delaunay(points: Points) -> Geometry:
    """Positively oriented, without flat tets."""
    tets = Delaunay(points).simplices
    volumes = np.abs(np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]))
    return points, orient_tets(tets[volumes > 0], points)


def kuhn_grid(*shape: int) -> Geometry:
    """Six tets in each unit cell: every face lies in an axis-parallel or diagonal plane."""
    vertices = np.stack(np.meshgrid(*[np.arange(n + 1) for n in shape], indexing="ij"), axis=-1)
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for order in itertools.permutations(range(3)):
        steps = np.concatenate([np.zeros((1, 3), int), np.cumsum(np.eye(3, dtype=int)[list(order)], axis=0)])
        corners = cells[:, None] + steps
        tets.append(np.ravel_multi_index(np.moveaxis(corners, -1, 0), [n + 1 for n in shape]))
    points = vertices.reshape(-1, 3).astype(np.float64)
    return points, orient_tets(np.concatenate(tets), points)


def with_holes(rng: np.random.Generator) -> Geometry:
    """A grid from which a third of the tets is missing: many entries, pieces, and edges that only touch."""
    vertices, tets = kuhn_grid(3, 3, 3)
    return vertices, tets[rng.uniform(size=len(tets)) > 0.33]


def with_slivers(geometry: Geometry, aspect: float) -> Geometry:
    """In every tet a new vertex, at `aspect` of the tet's height above a face: four tets, one a sliver."""
    vertices, tets = geometry
    corners = vertices[tets]
    low = corners[:, :3].mean(axis=1)
    added = low + aspect * (corners[:, 3] - low)
    new = len(vertices) + np.arange(len(tets))
    split = np.repeat(tets[:, None], 4, axis=1)
    split[:, np.arange(4), np.arange(4)] = new[:, None]
    return np.concatenate([vertices, added]), split.reshape(-1, 4)


def scrambled_inside(rng: np.random.Generator) -> Case:
    """A grid whose vertices have moved by up to a cell: a fifth of the tets is inverted."""
    vertices, tets = kuhn_grid(3, 3, 3)
    return Case((vertices, tets), moved=vertices + rng.uniform(-0.6, 0.6, vertices.shape))


def collapsed(rng: np.random.Generator) -> Case:
    """A grid of which one layer, and an edge, have been pressed flat: zero volumes, to the last bit."""
    vertices, tets = kuhn_grid(3, 3, 3)
    moved = vertices - np.array([0, 0, 1.0]) * (vertices[:, 2:] > 1.5)
    moved[1] = moved[0]
    return Case((vertices, tets), moved=moved)


def column() -> Case:
    """A stack of 3,400 cells: lines along it cross 10,000 tets."""
    vertices, tets = kuhn_grid(1, 1, 3400)
    return Case((vertices * [50, 50, 1], tets), chunk=32, slots=10_240)


def cloud(rng: np.random.Generator, scale: Points | float = 1.0, center: float = 0.0) -> Geometry:
    """The Delaunay tets of random points."""
    return delaunay(rng.normal(size=(25, 3)) * scale + center)


def squeezed(rng: np.random.Generator, scale: Points) -> Geometry:
    """The tets of a random cloud after an affine map: its slivers, unlike Delaunay's, are not gathered."""
    vertices, tets = cloud(rng)
    return vertices * scale, tets


MESHES: dict[str, Callable[[np.random.Generator], Case]] = {
    "one_tet": lambda rng: Case(delaunay(rng.normal(size=(4, 3)))),
    "cloud": lambda rng: Case(cloud(rng)),
    "grid": lambda rng: Case(kuhn_grid(3, 3, 3)),
    "holes": lambda rng: Case(with_holes(rng)),
    "pancake": lambda rng: Case(cloud(rng, np.array([1, 1, 1e-3]))),
    "needle": lambda rng: Case(cloud(rng, np.array([1e-3, 1e-3, 1]))),
    "foil": lambda rng: Case(squeezed(rng, np.array([1, 1, 1e-6]))),
    "slivers": lambda rng: Case(with_slivers(cloud(rng), 1e-6)),
    "tiny": lambda rng: Case(cloud(rng, 1e-6), world_rays=True),
    "huge": lambda rng: Case(cloud(rng, 1e6), world_rays=True),
    "far_away": lambda rng: Case(cloud(rng, center=1e4), world_rays=True),
    "scrambled": scrambled_inside,
    "collapsed": collapsed,
    "column": lambda rng: column(),
}


# ---- rays: origins and directions [R, 3] in the mesh's frame -----------------------------------------------


def unit(vectors: Points) -> Points:
    """Vectors of length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def points_inside(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Points:
    """Random points of random tets."""
    corners = vertices[tets[rng.integers(0, len(tets), count)]]
    return np.einsum("ri,rix->rx", rng.dirichlet(np.ones(4), count), corners)


def towards(targets: Points, rng: np.random.Generator, distance: float = 3.0) -> Geometry:
    """From random sides through the targets."""
    directions = unit(rng.normal(size=targets.shape))
    return targets - distance * directions, directions


def random_face(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Points:
    """Corners [R, 3, 3] of random faces."""
    chosen = tets[rng.integers(0, len(tets), count)]
    faces = np.array(FACES)[rng.integers(0, 4, count)]
    return vertices[np.take_along_axis(chosen, faces, axis=1)]


def points_on_faces(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Points:
    """Random points of random faces."""
    weights = rng.dirichlet(np.ones(3), count)
    return np.einsum("ri,rix->rx", weights, random_face(vertices, tets, rng, count))


def along_edges(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """Along an edge, from beyond its end."""
    face = random_face(vertices, tets, rng, count)
    return _through(face[:, 0], face[:, 1], rng)


def in_faces(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """In the plane of a face, through its inside."""
    face = random_face(vertices, tets, rng, count)
    start, end = (np.einsum("ri,rix->rx", rng.dirichlet(np.ones(3), count), face) for _ in range(2))
    return _through(start, end, rng)


def _through(start: Points, end: Points, rng: np.random.Generator) -> Geometry:
    """Lines through two points, from beyond the first; any direction where the points are one."""
    same = np.all(start == end, axis=1, keepdims=True)
    directions = unit(np.where(same, rng.normal(size=start.shape), end - start))
    return start - 2 * directions, directions


def along_axes(vertices: Points, tets: np.ndarray, rng: np.random.Generator, count: int) -> Geometry:
    """Parallel to an axis, half of them through vertices; zeros in the direction have either sign."""
    points = points_inside(vertices, tets, rng, count)
    points[::2] = vertices[rng.integers(0, len(vertices), len(points[::2]))]
    signs = np.where(rng.uniform(size=(count, 3)) < 0.5, -1.0, 1.0)
    directions = np.eye(3)[rng.integers(0, 3, count)] * signs
    return points - 3 * directions, directions


RAYS: dict[str, Callable[..., Geometry]] = {
    "random": lambda v, t, rng, n: towards(points_inside(v, t, rng, n), rng),
    "from_inside": lambda v, t, rng, n: (points_inside(v, t, rng, n), unit(rng.normal(size=(n, 3)))),
    "from_faces": lambda v, t, rng, n: (points_on_faces(v, t, rng, n), unit(rng.normal(size=(n, 3)))),
    "from_afar": lambda v, t, rng, n: towards(points_inside(v, t, rng, n), rng, 100.0),
    "missing": lambda v, t, rng, n: towards(unit(rng.normal(size=(n, 3))) * 1.5, rng),
    "through_vertices": lambda v, t, rng, n: towards(v[rng.integers(0, len(v), n)], rng),
    "through_edges": lambda v, t, rng, n: towards(random_face(v, t, rng, n)[:, :2].mean(axis=1), rng),
    "along_edges": along_edges,
    "in_faces": in_faces,
    "along_axes": along_axes,
}
FROM_ORIGIN = {"from_inside", "from_faces"}  # what lies behind the origin does not count
