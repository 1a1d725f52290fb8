"""edit.remesh.overlay: which new tets lie within old ones, where these are thin, far off, or overlap."""

import jax
import numpy as np
import scenes
from meshes import grid
from numpy.testing import assert_array_equal

from nimpostor_jax.edit.remesh import overlay
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh


def test_the_same_tets_are_kept_where_the_cage_overlaps_itself():
    """And others are not, there: nothing says in which of the old ones they lie."""
    made = scenes.pushed_together(scenes.impostor("blobs"))
    vertices, tets = np.asarray(made.mesh.vertices, np.float64), np.asarray(made.mesh.tets)
    turned = tets[:, [1, 2, 0, 3]]
    over = overlay(made, vertices, turned)
    assert_array_equal(over.tets, np.arange(len(tets)))
    assert_array_equal(over.lambdas, np.broadcast_to(np.eye(4)[[1, 2, 0, 3]], (len(tets), 4, 4)))
    fine = subdivide(made)
    over = overlay(made, np.asarray(fine.mesh.vertices, np.float64), np.asarray(fine.mesh.tets))
    kept = over.tets >= 0
    assert 0.2 < kept.mean() < 0.9
    assert_array_equal(over.tets[kept], np.asarray(fine.embedding.cells)[kept])


def test_slivers_and_far_off_cages_do_not_seem_folded():
    """Thin tets, about which float32 may err, and a cage whose world coordinates have no digits to spare."""
    vertices, tets = grid(np.ones((6, 6, 6), bool))
    flattened = vertices * [1, 1, 1e-4]
    for cage in (flattened, 1e5 + vertices):
        made = init_impostor(jax.random.key(0), build_tet_mesh(cage, tets), scenes.FIELD)
        fine = subdivide(made)
        over = overlay(made, np.asarray(fine.mesh.vertices, np.float64), np.asarray(fine.mesh.tets))
        assert_array_equal(over.tets, fine.embedding.cells)
