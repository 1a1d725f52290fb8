"""Subdivision of tets into eight, conforming: every edge is halved (Bey 1995). Host code, NumPy.

Four of a tet's children sit at its corners; the octahedron between them is cut along its shortest diagonal.
The cut lies within the tet, so that neighbours agree whatever it is.

Axes: V vertices, T tets.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
# Points of a divided tet: corners 0 to 3, then the middles of `_EDGES`, 4 to 9.
_AT_CORNERS = np.array([(0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3)])
# For each diagonal (between the middles of opposite edges) the ring of the other four middles around it.
_DIAGONALS = np.array([(4, 9), (5, 8), (6, 7)])
_RINGS = np.array([(5, 7, 8, 6), (4, 7, 9, 6), (4, 8, 9, 5)])


class Subdivision(NamedTuple):
    """A finer mesh within a mesh."""

    vertices: Float[np.ndarray, "W 3"]  # the first V are the coarse ones
    tets: Int[np.ndarray, "U 4"]
    parents: Int[np.ndarray, " U"]  # the coarse tet around each fine one
    lambdas: Float[np.ndarray, "U 4 4"]  # of the fine tets' corners, in their parents: [fine, corner, :]


def subdivide(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], times: int = 1
) -> Subdivision:
    """Halve every edge, `times` times: 8**times tets for each. Positively oriented tets stay so."""
    fine = Subdivision(
        vertices=np.asarray(vertices, np.float64),
        tets=np.asarray(tets),
        parents=np.arange(len(tets)),
        lambdas=np.broadcast_to(np.eye(4), (len(tets), 4, 4)),
    )
    for _ in range(times):
        fine = _halve(fine)
    return fine


def _halve(mesh: Subdivision) -> Subdivision:
    edges = np.sort(mesh.tets[:, _EDGES].reshape(-1, 2), axis=1)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    middles = len(mesh.vertices) + inverse.reshape(-1, 6)
    vertices = np.concatenate([mesh.vertices, mesh.vertices[unique].mean(axis=1)])
    points = np.concatenate([mesh.tets, middles], axis=1)  # [T, 10]
    lambdas = np.concatenate([mesh.lambdas, mesh.lambdas[:, _EDGES].mean(axis=2)], axis=1)  # [T, 10, 4]

    ends = vertices[points[:, _DIAGONALS]]
    shortest = np.argmin(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1), axis=1)
    diagonal, ring = _DIAGONALS[shortest], _RINGS[shortest]
    inner = [np.column_stack([diagonal, ring[:, i], ring[:, (i + 1) % 4]]) for i in range(4)]
    at_corners = np.broadcast_to(_AT_CORNERS, (len(mesh.tets), 4, 4))
    children = np.concatenate([at_corners, np.stack(inner, axis=1)], axis=1)  # [T, 8, 4] of the ten points
    rows = np.arange(len(mesh.tets))[:, None, None]
    tets, lambdas = points[rows, children].reshape(-1, 4), lambdas[rows, children].reshape(-1, 4, 4)
    corners = vertices[tets]
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    swapped = np.where(inverted[:, None], [0, 1, 3, 2], [0, 1, 2, 3])
    return Subdivision(
        vertices=vertices,
        tets=np.take_along_axis(tets, swapped, axis=1).astype(np.int32),
        parents=np.repeat(mesh.parents, 8),
        lambdas=np.take_along_axis(lambdas, swapped[:, :, None], axis=1),
    )
