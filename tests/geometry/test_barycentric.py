"""geometry.barycentric and geometry.tetrahedron."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from meshes import delaunay, one_tet
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.geometry.barycentric import barycentric, interpolate
from nimpostor_jax.geometry.tetrahedron import FACES, corners, cross, num_inverted, signed_volumes


def well_shaped(seed, dtype):
    """A random tet of at least a hundredth of its bounding cube's volume, and a point near it."""
    rng = np.random.default_rng(seed)
    while True:
        tet = rng.uniform(-1, 1, (4, 3))
        if abs(np.linalg.det(tet[1:] - tet[0])) > 0.1:
            return tet.astype(dtype), rng.uniform(-2, 2, 3).astype(dtype)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_inverts_interpolation(seed):
    tet, point = well_shaped(seed, np.float32)
    weights = barycentric(jnp.asarray(point), jnp.asarray(tet))
    # float32 with coordinates up to about 40 (volume 0.1 / 6 against lengths of 3): 1e-6 times that
    assert_allclose(interpolate(weights, jnp.asarray(tet)), point, atol=1e-4)
    assert_allclose(jnp.sum(weights), 1, atol=2e-5)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_recovers_given_weights(seed):
    tet, _ = well_shaped(seed, np.float32)
    weights = np.random.default_rng(seed).dirichlet(np.ones(4)).astype(np.float32)
    point = interpolate(jnp.asarray(weights), jnp.asarray(tet))
    assert_allclose(barycentric(point, jnp.asarray(tet)), weights, atol=5e-5)  # volume of 0.1 / 6, float32


def test_agrees_with_a_linear_solve(x64, rng):
    vertices, tets = delaunay()
    points = rng.normal(size=(len(tets), 3))
    weights = np.asarray(barycentric(jnp.asarray(points), corners(jnp.asarray(vertices), jnp.asarray(tets))))
    expected = np.stack([oracles.barycentric(p, vertices[t]) for p, t in zip(points, tets, strict=True)])
    # relative to the largest coordinate: slivers have huge ones
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert_allclose(weights / scale, expected / scale, atol=1e-10)


def test_far_from_the_origin_loses_only_the_positions_digits():
    tet, weights = jnp.asarray(one_tet()[0] + 64, jnp.float32), jnp.array([0.1, 0.2, 0.3, 0.4])
    # 64 * 2^-24 = 4e-6 is how well float32 holds the point; the tet is about 1 wide
    assert_allclose(barycentric(interpolate(weights, tet), tet), weights, atol=5e-5)


def test_is_one_at_corners_and_negative_beyond_a_face():
    tet = jnp.asarray(one_tet()[0], jnp.float32)
    assert_allclose(barycentric(tet, jnp.broadcast_to(tet, (4, 4, 3))), np.eye(4), atol=1e-6)
    for i, face in enumerate(FACES):
        beyond = 2 * jnp.mean(tet[jnp.asarray(face)], axis=0) - jnp.mean(tet, axis=0)
        assert barycentric(beyond, tet)[i] < 0


@pytest.mark.parametrize(
    "tet", [np.zeros((4, 3)), np.eye(4, 3), np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])]
)
def test_degenerate_tet_is_guarded(tet):
    tet = jnp.asarray(tet, jnp.float32).at[:, 2].set(0)  # all in one plane

    def total(point, tet):
        return jnp.sum(barycentric(point, tet) * jnp.arange(4.0))

    point = jnp.array([0.25, 0.5, 0.0])
    assert_array_equal(barycentric(point, tet), np.full(4, 0.25))
    for gradient in jax.grad(total, argnums=(0, 1))(point, tet):
        assert_array_equal(gradient, np.zeros_like(gradient))


def test_gradients_match_finite_differences(x64, rng):
    point, tet, mix = rng.normal(size=3), one_tet()[0], np.array([1.0, -2.0, 0.5, 3.0])

    def of_point(p):
        return jnp.sum(barycentric(p, jnp.asarray(tet)) * mix)

    def of_corners(v):
        return jnp.sum(barycentric(jnp.asarray(point), v) * mix)

    for function, x in ((of_point, point), (of_corners, tet)):
        gradient = jax.grad(function)(jnp.asarray(x))
        for _ in range(4):
            direction = rng.normal(size=x.shape)
            expected = oracles.directional_difference(function, x, direction)
            assert_allclose(np.sum(gradient * direction), expected, rtol=1e-7)  # step^2 and 1e-16 / step


def test_faces_point_outwards():
    vertices, tets = one_tet()
    tet = vertices[tets[0]]
    assert np.linalg.det(tet[1:] - tet[0]) > 0
    for i, face in enumerate(FACES):
        a, b, c = tet[list(face)]
        assert np.dot(np.cross(b - a, c - a), tet[i] - a) < 0


def test_signed_volumes_and_inverted_count(rng):
    vertices, tets = delaunay()
    expected = np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) / 6
    volumes = signed_volumes(corners(jnp.asarray(vertices), jnp.asarray(tets)))
    assert_allclose(volumes, expected, rtol=1e-4, atol=1e-6)  # float32, slivers
    assert num_inverted(jnp.asarray(vertices), jnp.asarray(tets)) == 0
    mirrored = np.where(np.arange(len(tets))[:, None] < 3, tets[:, [1, 0, 2, 3]], tets)
    assert num_inverted(jnp.asarray(vertices), jnp.asarray(mirrored)) == 3
    assert num_inverted(jnp.zeros_like(vertices), jnp.asarray(tets)) == len(tets)  # flat counts as inverted


def test_cross(rng):
    a, b = rng.normal(size=(2, 5, 3)).astype(np.float32)
    assert_allclose(cross(jnp.asarray(a), jnp.asarray(b)), np.cross(a, b), atol=1e-6)
