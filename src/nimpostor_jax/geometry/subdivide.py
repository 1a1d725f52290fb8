"""Subdivision of tets into eight (red), and of their neighbours so that the mesh stays conforming (green).

After Bey (1995). Four of a red tet's children sit at its corners; the octahedron between them is cut along
its shortest diagonal. The cut lies within the tet, so that neighbours agree whatever it is. A tet with one
halved edge is cut in two, one with all of a face in four; other patterns are completed to one of these.

Axes: V vertices, T tets. Host code, NumPy.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from nimpostor_jax.geometry.tetrahedron import FACES

_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
# Points of a divided tet: corners 0 to 3, then the middles of `_EDGES`, 4 to 9.
_AT_CORNERS = np.array([(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3)])
# For each diagonal (between the middles of opposite edges) the ring of the other four middles around it.
_DIAGONALS = np.array([(4, 9), (5, 8), (6, 7)])
_RINGS = np.array([(5, 7, 8, 6), (4, 7, 9, 6), (4, 8, 9, 5)])
# The edges of the face opposite each corner, as bits.
_FACE_EDGES = np.array(
    [sum(1 << i for i, edge in enumerate(_EDGES) if set(edge) <= set(face)) for face in FACES]
)


def _closures() -> np.ndarray:
    """For each set of halved edges the smallest that holds it and has a pattern."""
    allowed = [0, *(1 << i for i in range(6)), *_FACE_EDGES.tolist(), 63]
    return np.array([min((a for a in allowed if a & s == s), key=int.bit_count) for s in range(64)])


def _green_children() -> dict[int, np.ndarray]:
    """The children, of the ten points, for each set of halved edges that has a pattern but the red one."""
    children = {0: np.array([(0, 1, 2, 3)])}
    for i, (a, b) in enumerate(_EDGES):
        halves = np.array([(0, 1, 2, 3)] * 2)
        halves[0, b] = halves[1, a] = 4 + i
        children[1 << i] = halves
    middle = {tuple(edge): 4 + i for i, edge in enumerate(_EDGES.tolist())}
    for apex, bits in enumerate(_FACE_EDGES.tolist()):
        a, b, c = sorted(set(range(4)) - {apex})
        ab, ac, bc = middle[a, b], middle[a, c], middle[b, c]
        triangles = [(a, ab, ac), (ab, b, bc), (ac, bc, c), (ab, bc, ac)]
        children[bits] = np.array([(*triangle, apex) for triangle in triangles])
    return children


_CLOSURES, _GREEN = _closures(), _green_children()


class Subdivision(NamedTuple):
    """A finer mesh within a mesh."""

    vertices: Float[np.ndarray, "W 3"]  # the first V are the coarse ones
    tets: Int[np.ndarray, "U 4"]  # tets that are whole come first, in their order, as they were
    parents: Int[np.ndarray, " U"]  # the coarse tet around each fine one
    lambdas: Float[np.ndarray, "U 4 4"]  # of the fine tets' corners, in their parents: [fine, corner, :]

    def vertices_of(self, values: Float[np.ndarray, "V n"], tets: Int[np.ndarray, "T 4"]) -> np.ndarray:
        """Values at the fine vertices [W, n], from some at the coarse ones (the first are the same)."""
        result = np.empty((len(self.vertices), values.shape[1]), values.dtype)
        corners = values[np.asarray(tets)[self.parents]]  # [U, 4, n]
        result[self.tets.reshape(-1)] = (self.lambdas @ corners).reshape(-1, values.shape[1])
        result[: len(values)] = values
        return result


def subdivide(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    times: int = 1,
    region: Bool[np.ndarray, " T"] | None = None,
) -> Subdivision:
    """Halve every edge of the tets in a region (None: of all), `times` times, and what it takes to conform.

    8**times tets for each in the region. Children are oriented as their parents. Raises ValueError where the
    region is not one flag for each tet.
    """
    if region is not None and np.shape(region) != (len(tets),):
        raise ValueError(f"the region must flag each of {len(tets)} tets, got shape {np.shape(region)}")
    fine = Subdivision(
        vertices=np.asarray(vertices, np.float64),
        tets=np.asarray(tets),
        parents=np.arange(len(tets)),
        lambdas=np.broadcast_to(np.eye(4), (len(tets), 4, 4)),
    )
    for _ in range(times):
        chosen = np.ones(len(fine.tets), bool) if region is None else np.asarray(region)[fine.parents]
        fine = _halve(fine, chosen)
    return fine


def _halve(mesh: Subdivision, chosen: Bool[np.ndarray, " T"]) -> Subdivision:
    edges = np.sort(mesh.tets[:, _EDGES].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    edge_ids = inverse.reshape(-1, 6)
    halved = np.zeros(len(unique), bool)
    halved[edge_ids[chosen]] = True
    bits = 1 << np.arange(6)
    while True:  # a tet is completed to a pattern, and so its neighbours may have to be
        pattern = halved[edge_ids] @ bits
        closed = _CLOSURES[pattern]
        if np.array_equal(closed, pattern):
            break
        halved[edge_ids[(closed[:, None] & bits) > 0]] = True
    ranks = np.cumsum(halved) - 1
    middles = np.where(halved[edge_ids], len(mesh.vertices) + ranks[edge_ids], -1)
    vertices = np.concatenate([mesh.vertices, mesh.vertices[unique[halved]].mean(axis=1)])
    points = np.concatenate([mesh.tets, middles], axis=1)  # [T, 10]
    lambdas = np.concatenate([mesh.lambdas, mesh.lambdas[:, _EDGES].mean(axis=2)], axis=1)  # [T, 10, 4]

    parts = []
    for kind in np.unique(pattern):
        rows = np.flatnonzero(pattern == kind)
        if kind == 63:
            children = _red_children(vertices, points[rows])
        else:
            children = np.broadcast_to(_GREEN[int(kind)], (len(rows), *_GREEN[int(kind)].shape))
        at = rows[:, None, None]
        owners = np.repeat(rows, children.shape[1])
        parts.append((points[at, children].reshape(-1, 4), lambdas[at, children].reshape(-1, 4, 4), owners))
    tets, lambdas, owners = (np.concatenate(part) for part in zip(*parts, strict=True))
    # As their parents are turned, also where a deformation has inverted these.
    swapped = np.where((np.linalg.det(lambdas) < 0)[:, None], [0, 1, 3, 2], [0, 1, 2, 3])
    return Subdivision(
        vertices=vertices,
        tets=np.take_along_axis(tets, swapped, axis=1).astype(np.int32),
        parents=mesh.parents[owners],
        lambdas=np.take_along_axis(lambdas, swapped[:, :, None], axis=1),
    )


def _red_children(
    vertices: Float[np.ndarray, "V 3"], points: Int[np.ndarray, "T 10"]
) -> Int[np.ndarray, "T 8 4"]:
    """Eight children of each tet, of its ten points."""
    ends = vertices[points[:, _DIAGONALS]]
    shortest = np.argmin(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1), axis=1)
    diagonal, ring = _DIAGONALS[shortest], _RINGS[shortest]
    inner = [np.column_stack([diagonal, ring[:, i], ring[:, (i + 1) % 4]]) for i in range(4)]
    at_corners = np.broadcast_to(_AT_CORNERS, (len(points), 4, 4))
    return np.concatenate([at_corners, np.stack(inner, axis=1)], axis=1)
