"""geometry.topology: which meshes are refused, and where a mesh's own frame is."""

import numpy as np
import pytest
from meshes import MESHES, oriented
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import adjacency, build_tet_mesh, world_vertices
from nimpostor_jax.preprocess.validate import check_tets

FOLDED = oriented(
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, 1], [0.3, 0.3, 0.5]]),
    np.array([[0, 1, 2, 3], [0, 1, 2, 4]]),
)


@pytest.mark.parametrize("name", MESHES)
def test_neighbours_share_the_face_between_them(name):
    _, tets = MESHES[name]()
    neighbors = adjacency(tets)
    faces = np.sort(tets[:, np.array(FACES)], axis=2)
    count = 0
    for tet, corner in np.argwhere(neighbors >= 0):
        other = neighbors[tet, corner]
        back = np.flatnonzero(neighbors[other] == tet)
        assert any(np.array_equal(faces[other, b], faces[tet, corner]) for b in back)
        count += 1
    _, counts = np.unique(faces.reshape(-1, 3), axis=0, return_counts=True)
    assert count == 2 * np.sum(counts == 2)


def test_two_tets_on_one_side_of_a_face_are_refused():
    """As an inverted tet is that was turned around: the march could not leave one for the other."""
    for check in (check_tets, build_tet_mesh):
        with pytest.raises(ValueError, match=r"tets 0 and 1 lie on the same side .*\(0, 1, 2\)"):
            check(*FOLDED)
        with pytest.raises(ValueError, match="has a tet twice"):
            check(FOLDED[0], np.array([[0, 1, 2, 3], [1, 2, 0, 3]]))


def test_a_mesh_may_fold_after_it_was_made():
    """Its tets were on both sides of the face once, and are by their orientations."""
    vertices, tets = FOLDED
    unfolded = vertices.copy()
    unfolded[4, 2] = -0.5
    tets = oriented(unfolded, tets)[1]
    neighbors = build_tet_mesh(vertices, tets, deformed=True).neighbors
    assert_array_equal(np.max(neighbors, axis=1), [1, 0])


@pytest.mark.parametrize("offset", [5e6 + 0.3, -1234.567])
def test_a_cage_stays_where_it_is_however_far(offset):
    """What float32 rounds of the centre is in the local vertices: 1e-6 is a few of their last places."""
    vertices, tets = MESHES["one_tet"]()
    mesh = build_tet_mesh(vertices + offset, tets)
    assert_allclose(world_vertices(mesh) - offset, vertices, atol=1e-6)


def test_vertices_without_tets_do_not_make_the_cage_small():
    vertices, tets = MESHES["cube"]()
    mesh = build_tet_mesh(np.concatenate([vertices, [[1e6, 0, 0]]]), tets)
    assert mesh.scale == build_tet_mesh(vertices, tets).scale
    assert_array_equal(mesh.vertices[:-1], build_tet_mesh(vertices, tets).vertices)


def test_wrong_types_and_lengths_are_refused_by_name():
    vertices, tets = MESHES["cube"]()
    with pytest.raises(ValueError, match="integers, got float64"):
        build_tet_mesh(vertices, tets.astype(float))
    with pytest.raises(ValueError, match=r"each of 6 tets, got \(5,\)"):
        build_tet_mesh(vertices, tets, np.zeros(5, int))
