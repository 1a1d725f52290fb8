"""geometry.polar: SciPy's polar decomposition is the oracle where there is one."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from nimpostor_jax.geometry.polar import nearest_rotation


def test_is_the_polar_factor(rng):
    matrices = rng.normal(size=(200, 3, 3))
    matrices = matrices[np.linalg.det(matrices) > 0.05]
    expected = np.stack([polar(matrix)[0] for matrix in matrices])
    # float32, amplified by the smallest sum of two stretches, 0.2 or so
    assert_allclose(nearest_rotation(jnp.asarray(matrices, jnp.float32)), expected, atol=2e-5)


def test_identity_is_exact():
    eye = jnp.eye(3)
    assert_array_equal(nearest_rotation(jnp.stack([eye, 2 * eye])), np.stack([eye, eye]))


def flat_and_inverted(rng):
    rotation = Rotation.random(random_state=1).as_matrix()
    stretches = [(1, 1, 0), (1, 0, 0), (2, 1, -0.5), (1, 1, -1), (0, 0, 0)]
    return np.stack([rotation @ np.diag(s) for s in stretches])


def test_flat_and_inverted_matrices_have_a_nearest_rotation(rng):
    matrices = flat_and_inverted(rng)
    found = np.asarray(nearest_rotation(jnp.asarray(matrices, jnp.float32)), np.float64)
    identity = np.broadcast_to(np.eye(3), found.shape)
    assert_allclose(found @ found.transpose(0, 2, 1), identity, atol=1e-6)
    assert_allclose(np.linalg.det(found), 1, atol=1e-6)
    others = Rotation.random(2000, random_state=2).as_matrix()
    reached = np.einsum("nij,nij->n", found, matrices)
    best = np.einsum("mij,nij->nm", others, matrices).max(axis=1)
    assert np.all(reached >= best - 1e-6)


def test_gradients_match_differences(rng, x64):
    matrices = jnp.asarray(rng.normal(size=(5, 3, 3)) + 2 * np.eye(3))
    weights = jnp.asarray(rng.normal(size=(5, 3, 3)))

    def value(x):
        return jnp.sum(weights * nearest_rotation(x))

    change = jnp.asarray(rng.normal(size=matrices.shape))
    difference = (value(matrices + 1e-5 * change) - value(matrices - 1e-5 * change)) / 2e-5
    assert_allclose(jnp.vdot(jax.grad(value)(matrices), change), difference, rtol=1e-8)  # (1e-5)**2


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_gradients_are_finite_where_the_rotation_is_not_unique(rng, dtype, x64):
    matrices = jnp.asarray(flat_and_inverted(rng), dtype)
    weights = jnp.asarray(rng.normal(size=matrices.shape), dtype)
    gradient = jax.grad(lambda x: jnp.sum(weights * nearest_rotation(x)))(matrices)
    assert np.all(np.isfinite(gradient))
