"""Cages of simple shape, for comparison with envelopes (Fig. 10, NGP-Bounded). World units, float64."""

import itertools

import numpy as np
from jaxtyping import Float

from nimpostor_jax.preprocess.topology import Cage


def box_cage(bounds: Float[np.ndarray, "2 3"]) -> Cage:
    """The 6 tets around the diagonal of an axis-parallel box, from its lower and upper corner (Kuhn's)."""
    bounds = np.asarray(bounds, np.float64)
    corners = np.array(list(itertools.product((0, 1), repeat=3)))  # corner i has the binary digits of i
    vertices = bounds[0] + corners * (bounds[1] - bounds[0])
    tets = []
    for axes in itertools.permutations((4, 2, 1)):
        path = np.cumsum([0, *axes])
        edges = corners[path[1:]] - corners[0]
        tets.append(path if np.linalg.det(edges) > 0 else path[[0, 2, 1, 3]])
    return vertices, np.array(tets, np.int32)


def bounding_box(vertices: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "2 3"]:
    """Lower and upper corner."""
    return np.stack([vertices.min(axis=0), vertices.max(axis=0)])
