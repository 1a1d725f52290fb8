"""pipeline.ray_bending: samples of a deformed cage, mapped back to its rest pose."""

import jax
import numpy as np
import oracles
import pytest
import scenes
from meshes import MESHES
from numpy.testing import assert_allclose
from scenes import constant_density

from nimpostor_jax.config import EncodingConfig, ImpostorConfig
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.pipeline.ray_bending import BentField
from nimpostor_jax.preprocess.tetrahedralize import box_tets


@pytest.fixture(scope="module")
def bent():
    """A cage turned and stretched, around a field in its rest pose's bounding box."""
    vertices, tets = MESHES["delaunay"]()
    box = box_tets(np.stack([vertices.min(axis=0), vertices.max(axis=0)]))
    encoding = EncodingConfig(layout="box", interpolation="grid", num_levels=2, base_resolution=4)
    field = init_impostor(jax.random.key(0), build_tet_mesh(*box), ImpostorConfig(encoding=encoding))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.3]])
    return BentField(field, vertices, vertices @ turn.T, tets), vertices, vertices @ turn.T, tets


def test_points_are_found_in_their_tets(bent, rng):
    field, _, moved, tets = bent
    ids, lambdas = rng.integers(0, len(tets), 300), rng.dirichlet(np.ones(4), 300)
    points = np.einsum("mi,mix->mx", lambdas, moved[tets[ids]])
    found, there = field.locate(points)
    # A tet may have none of the 8 nearest vertices: such points are lost, as in the method itself.
    assert np.mean(found == ids) > 0.9
    hit = found == ids
    assert_allclose(there[hit], lambdas[hit], atol=1e-9)
    for point, tet, coordinates in zip(points[hit][:20], found[hit][:20], there[hit][:20], strict=True):
        assert_allclose(coordinates, oracles.barycentric(point, moved[tets[tet]]), atol=1e-9)
    outside, _ = field.locate(points + 100)
    assert np.all(outside == -1)


def test_the_field_is_asked_at_rest(bent, rng):
    """Equal points of the rest pose have equal density and colour, whichever way the cage has moved."""
    field, vertices, moved, tets = bent
    still = BentField(field._impostor, vertices, vertices, tets)
    ids, lambdas = rng.integers(0, len(tets), 50), rng.dirichlet(np.ones(4), 50)
    directions = np.tile([0.0, 0.0, 1.0], (50, 1))
    values, both = [], np.ones(len(ids), bool)
    for each, cage in ((field, moved), (still, vertices)):
        points = np.einsum("mi,mix->mx", lambdas, cage[tets[ids]])
        values.append(np.column_stack(each.evaluate(points, directions)))
        both &= each.locate(points)[0] == ids
    assert both.sum() > 40
    assert_allclose(values[0][both], values[1][both], rtol=1e-4)  # float32 coordinates


@pytest.mark.parametrize("stretched", [1.0, 1.6])
def test_a_constant_field_has_the_analytic_opacity(stretched):
    """exp(b) a unit of the box's frame, whichever way the cage is stretched; straight through the middle."""
    vertices, tets = MESHES["cube"]()
    encoding = EncodingConfig(layout="box", interpolation="grid", num_levels=2, base_resolution=4)
    box = build_tet_mesh(*box_tets(np.array([[0.0] * 3, [1.0] * 3])))
    field = constant_density(init_impostor(jax.random.key(0), box, ImpostorConfig(encoding=encoding)), 0.3)
    vertices = np.concatenate([vertices, [[50.0, 50, 50]]])  # of no tet: samples stay where the cage is
    moved = vertices * [1, 1, stretched]
    camera = scenes.camera(8, 8, (0.5, 0.51, 6.0), (0.5, 0.5, 0.5))
    pixels = np.array([27, 28, 35, 36])  # the middle ones
    color, opacity = BentField(field, vertices, moved, tets).render(camera, pixels=pixels)
    bias = float(field.decoders["density"][-1]["bias"][0, 0])
    # Rays are within half a pixel of upright: 1 % longer. The ends are met within a coarse interval.
    expected = -np.expm1(-np.exp(bias) * stretched / float(box.scale))
    assert_allclose(opacity, expected, rtol=0.02)
    assert np.all((color > 0) & (color < opacity[:, None]))
    away = scenes.camera(4, 4, (0.5, 0.5, 6.0), (30.0, 0.5, 6.0))
    assert np.all(BentField(field, vertices, moved, tets).render(away)[1] == 0)


def test_what_cannot_be_bent_is_refused(bent):
    field, vertices, _, tets = bent
    mesh = build_tet_mesh(vertices, tets)
    other = init_impostor(jax.random.key(0), mesh, ImpostorConfig(encoding=EncodingConfig(num_levels=2)))
    with pytest.raises(ValueError, match=r"needs a Cartesian field .*layout = 'box'.*per_simplex"):
        BentField(other, vertices, vertices, tets)
    with pytest.raises(ValueError, match="not the same cage"):
        BentField(field._impostor, vertices, vertices[:-1], tets)
    crushed = vertices.copy()
    crushed[tets[2]] = 0.5
    with pytest.raises(ValueError, match=r"tets of the moved cage are flat \(first: \d+\); move it less"):
        BentField(field._impostor, vertices, crushed, tets)
