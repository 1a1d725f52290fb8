"""encoding.spherical_harmonics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import sph_harm_y

from nimpostor_jax.encoding.spherical_harmonics import spherical_harmonics


def sphere_quadrature(n=16):
    """Directions and weights that integrate polynomials up to degree 2n - 1 over the sphere exactly."""
    z, wz = np.polynomial.legendre.leggauss(n)
    phi = 2 * np.pi * (np.arange(2 * n) + 0.5) / (2 * n)
    z, phi = (a.ravel() for a in np.meshgrid(z, phi, indexing="ij"))
    s = np.sqrt(1 - z**2)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=1), np.repeat(wz, 2 * n) * np.pi / n


def test_basis_is_orthonormal(x64):
    directions, weights = sphere_quadrature()
    basis = np.asarray(spherical_harmonics(jnp.asarray(directions), 4))
    assert_allclose(basis.T @ (weights[:, None] * basis), np.eye(16), atol=1e-12)


def test_each_band_spans_scipys(x64):
    """Orthonormal bands are unique up to rotation: projecting scipy's complex functions loses nothing."""
    directions, weights = sphere_quadrature()
    theta, phi = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    basis = np.asarray(spherical_harmonics(jnp.asarray(directions), 4))
    for band in range(4):
        ours = basis[:, band**2 : (band + 1) ** 2]
        for m in range(-band, band + 1):
            reference = sph_harm_y(band, m, theta, phi)
            assert_allclose(ours @ (ours.T @ (weights * reference)), reference, atol=1e-12)


@pytest.mark.parametrize("degree", range(5))
def test_lower_degrees_are_prefixes(degree, rng):
    directions = rng.normal(size=(3, 7, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    whole = spherical_harmonics(jnp.asarray(directions), 4)
    part = spherical_harmonics(jnp.asarray(directions), degree)
    assert part.shape == (3, 7, degree**2)
    assert_allclose(part, whole[..., : degree**2])


def test_gradient_is_finite_at_poles_and_axes():
    axes = jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    gradient = jax.jacfwd(lambda d: spherical_harmonics(d, 4))(axes)
    assert np.all(np.isfinite(gradient))


@pytest.mark.parametrize("degree", [-1, 5])
def test_other_degrees_are_refused(degree):
    with pytest.raises(ValueError, match="degree"):
        spherical_harmonics(jnp.ones((1, 3)), degree)
