"""Deformations move vertices, and only vertices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from scenes_baked import baked

from nimpostor_jax.config import EncodingConfig, ImpostorConfig
from nimpostor_jax.edit.deform import bend, deform, deformation_report, rigid, stretch, twist
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices

POINT = np.array([[0.4, -0.3, 0.7]])


@pytest.fixture(scope="module")
def impostor():
    """Two tets about a common face, off the origin, world size about 1."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.7, 0.7, 0.7]])
    vertices += np.array([0.1, 0.2, 0.3])
    tets = np.array([[0, 1, 2, 3], [4, 1, 3, 2]])
    config = ImpostorConfig(encoding=EncodingConfig(num_levels=2, log2_tet_table=4))
    return init_impostor(jax.random.key(0), build_tet_mesh(vertices, tets), config)


def expected(name, x, y, z):
    """The formulas of the reference scenes, in plain NumPy."""
    if name == "twist":
        a = 0.9 * z
        return x * np.cos(a) - y * np.sin(a), x * np.sin(a) + y * np.cos(a), z
    if name == "bend":
        t, r = 0.5 * z, 1 / 0.5
        return r + (x - r) * np.cos(t), y, -(x - r) * np.sin(t)
    s = 1 + 0.2 * np.sin(3.0 * z)
    return s * x, s * y, 1.1 * z


MAPS = {"twist": twist(0.9), "bend": bend(0.5), "stretch": stretch(0.2, 3.0)}


@pytest.mark.parametrize("name", MAPS)
def test_families_are_the_published_maps(name, impostor):
    before = world_vertices(impostor.mesh)
    after = deform(impostor, MAPS[name])
    np.testing.assert_allclose(  # float32 vertices of size 1
        world_vertices(after.mesh), np.stack(expected(name, *before.T), axis=-1), atol=1e-6
    )
    assert after.tables is impostor.tables and after.decoders is impostor.decoders
    assert after.mesh.tets is impostor.mesh.tets and after.mesh.vertices.dtype == jnp.float32
    assert deformation_report(after).num_inverted == 0


@pytest.mark.parametrize("small", [bend(1e-4), twist(1e-4), stretch(1e-4, 1.0)])
def test_families_start_at_the_identity(small):
    moved = np.asarray(small(jnp.asarray(POINT)))
    if np.allclose(moved[:, 2], 1.1 * POINT[:, 2], atol=1e-3):  # stretch always lengthens by 1.1
        moved = moved / [1, 1, 1.1]
    np.testing.assert_allclose(moved, POINT, atol=1e-4)  # the parameter times lengths below 1


def test_bending_may_start_from_nothing():
    """Values and slopes are those of the series in c, which a division by it would lose."""
    point = jnp.asarray(POINT, jnp.float32)
    np.testing.assert_array_equal(bend(0.0)(point), point)
    x, _, z = POINT[0]
    for c in (0.0, 1e-4, 1e-3):
        value, slope = jax.jit(lambda c: jax.jvp(lambda c: bend(c)(point), (c,), (jnp.float32(1),)))(c)
        np.testing.assert_allclose(value[0], POINT[0] + c * np.array([z**2 / 2, 0, -x * z]), atol=1e-6)
        np.testing.assert_allclose(slope[0], [z**2 / 2, 0, -x * z], atol=2e-3)  # c times z^3


def test_rigid_and_numpy_maps(impostor):
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    before = world_vertices(impostor.mesh)
    after = deform(impostor, rigid(rotation, np.array([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(world_vertices(after.mesh), before @ rotation.T + [1, 2, 3], atol=1e-6)

    def numpy_map(points):
        return np.asarray(points, np.float64) * [2.0, 1.0, 1.0]

    np.testing.assert_allclose(
        world_vertices(deform(impostor, numpy_map).mesh), before * [2, 1, 1], atol=1e-6
    )
    with pytest.raises(ValueError, match="rotation matrix"):
        rigid(-np.eye(3), np.zeros(3))


def test_under_jit_and_grad(impostor):
    compiled = jax.jit(lambda impostor, c: deform(impostor, bend(c)).mesh.vertices)
    np.testing.assert_allclose(  # the same arithmetic, fused: a few ulps of 1/c = 2
        compiled(impostor, 0.5), deform(impostor, bend(0.5)).mesh.vertices, atol=2e-6
    )

    def height(k):
        return jnp.sum(deform(impostor, twist(k)).mesh.vertices[:, 0])

    step = 1e-2  # float32: the differences carry about 1e-4 of rounding, and 1e-4 of curvature
    numeric = (height(0.3 + step) - height(0.3 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(height)(0.3), numeric, atol=2e-3)


def test_inverted_tets_are_reported(impostor):
    after = deform(impostor, lambda points: points.at[4].set(jnp.array([0.0, 0.0, 0.0])))
    report = deformation_report(after)
    assert report.num_inverted == 1 and report.inverted.tolist() == [1] and report.num_tets == 2
    assert report.smallest_volume < 0
    healthy = deformation_report(impostor)
    assert healthy.num_inverted == 0
    np.testing.assert_allclose(healthy.smallest_volume, 1 / 6, rtol=1e-5)  # the corner tet, float32


def test_errors_name_the_vertex(impostor):
    with pytest.raises(ValueError, match=r"1 of 5 vertices are not finite.*vertex 3"):
        deform(impostor, lambda points: points.at[3, 0].set(jnp.nan))
    with pytest.raises(ValueError, match=r"shape \(5, 3\); got shape \(4, 3\)"):
        deform(impostor, lambda points: points[:4])
    message = r"1 of 5 vertices have c x >= 1, .* 1/c = 1; .*vertex 1 with x = 1.1"
    with pytest.raises(ValueError, match=message):
        deform(impostor, bend(1.0))
    deform(impostor, bend(-1.0))  # away from them: nothing folds


def test_a_baked_impostor_moves_as_one_that_is_not():
    made = baked("blobs")
    moved = deform(made, twist(0.9))
    assert type(moved) is type(made)
    field = scenes.impostor("blobs")
    np.testing.assert_array_equal(moved.mesh.vertices, deform(field, twist(0.9)).mesh.vertices)
    assert moved.textures is made.textures and moved.depths is made.depths
    assert deformation_report(moved).num_tets == len(made.mesh.tets)
