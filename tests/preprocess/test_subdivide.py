"""preprocess.subdivide: eight tets for one, conforming."""

import numpy as np
import pytest
from meshes import MESHES
from numpy.testing import assert_allclose

from nimpostor_jax.preprocess.subdivide import subdivide
from nimpostor_jax.preprocess.topology import adjacency


def volumes(vertices, tets):
    corners = vertices[tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


@pytest.mark.parametrize("name", ["delaunay", "blobs"])
@pytest.mark.parametrize("times", [0, 1, 2])
def test_children_fill_their_parents(name, times):
    vertices, tets = MESHES[name]()
    fine = subdivide(vertices, tets, times)
    assert len(fine.tets) == 8**times * len(tets)
    sizes = volumes(fine.vertices, fine.tets)
    assert sizes.min() > 0
    # Red refinement: each child has an eighth of its parent's volume.
    assert_allclose(sizes, volumes(vertices, tets)[fine.parents] / 8**times, rtol=1e-9)
    places = np.einsum("ucp,upx->ucx", fine.lambdas, vertices[tets[fine.parents]])
    assert_allclose(places, fine.vertices[fine.tets], atol=1e-12)
    assert_allclose(fine.lambdas.sum(axis=2), 1)
    assert fine.lambdas.min() >= 0


@pytest.mark.parametrize("name", ["delaunay", "blobs"])
def test_faces_meet_faces(name):
    """As many boundary faces as four for each coarse one: no face hangs."""
    vertices, tets = MESHES[name]()
    fine = subdivide(vertices, tets)
    coarse, refined = (np.sum(adjacency(np.asarray(t)) < 0) for t in (tets, fine.tets))
    assert refined == 4 * coarse
    assert len(np.unique(fine.vertices, axis=0)) == len(fine.vertices)
