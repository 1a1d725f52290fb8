"""geometry.subdivide: eight tets for one, conforming."""

import numpy as np
import pytest
from meshes import MESHES
from numpy.testing import assert_allclose

from nimpostor_jax.geometry.subdivide import subdivide
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import adjacency


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


@pytest.mark.parametrize("name", ["delaunay", "blobs"])
@pytest.mark.parametrize("times", [1, 2])
def test_a_region_is_cut_and_its_neighbours_follow(name, times):
    vertices, tets = MESHES[name]()
    region = np.random.default_rng(1).uniform(size=len(tets)) < 0.15
    fine = subdivide(vertices, tets, times, region)
    sizes = volumes(fine.vertices, fine.tets)
    assert sizes.min() > 0
    filled = np.bincount(fine.parents, sizes, len(tets))
    assert_allclose(filled, volumes(vertices, tets), rtol=1e-9)
    assert np.all(np.bincount(fine.parents)[region] >= 8**times)
    places = np.einsum("ucp,upx->ucx", fine.lambdas, vertices[np.asarray(tets)[fine.parents]])
    assert_allclose(places, fine.vertices[fine.tets], atol=1e-12)
    # Faces that hang would be boundary faces within the mesh: the boundary's area would grow.
    assert_allclose(boundary_area(fine.vertices, fine.tets), boundary_area(vertices, np.asarray(tets)))
    values = np.column_stack([vertices[:, 0] * 2 + 1, vertices[:, 1]])
    carried = fine.vertices_of(values, tets)
    assert_allclose(carried, np.column_stack([fine.vertices[:, 0] * 2 + 1, fine.vertices[:, 1]]))


def boundary_area(vertices, tets):
    outer = np.argwhere(adjacency(tets) < 0)
    a, b, c = (vertices[tets[outer[:, 0], np.array(FACES)[outer[:, 1], i]]] for i in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


def test_a_region_of_another_size_is_refused():
    vertices, tets = MESHES["cube"]()
    with pytest.raises(ValueError, match="got shape"):
        subdivide(vertices, tets, 1, np.ones(2, bool))
