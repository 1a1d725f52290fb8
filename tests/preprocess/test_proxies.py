"""preprocess.proxies: cages of simple shape."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nimpostor_jax.preprocess.proxies import bounding_box, box_cage
from nimpostor_jax.preprocess.topology import build_tet_mesh
from nimpostor_jax.preprocess.validate import check_tets


def test_a_box_is_filled_by_six_tets():
    bounds = np.array([[-1.0, 2.0, 0.5], [3.0, 2.5, 4.0]])
    vertices, tets = box_cage(bounds)
    check_tets(vertices, tets, "box")
    corners = vertices[tets]
    edges = corners[:, 1:] - corners[:, :1]
    volumes = np.linalg.det(edges) / 6
    assert len(tets) == 6 and volumes.min() > 0
    assert volumes.sum() == pytest.approx(np.prod(bounds[1] - bounds[0]))
    assert_allclose(bounding_box(vertices), bounds)
    mesh = build_tet_mesh(vertices, tets)
    assert np.sum(np.asarray(mesh.neighbors) < 0) == 12  # two triangles a side
