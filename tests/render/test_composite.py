"""render.composite."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.render.composite import blend_background, sample_weights, transmittance

weights_of = jax.jit(lambda sigmas, deltas: sample_weights(sigmas * deltas))


@settings(max_examples=50, deadline=None)
@given(
    sigmas=st.lists(st.floats(0, 1e8, width=32), min_size=8, max_size=8),
    deltas=st.lists(st.floats(0, 2, width=32), min_size=8, max_size=8),
)
def test_weights_follow_the_loop(sigmas, deltas):
    sigmas, deltas = np.array(sigmas, np.float32), np.array(deltas, np.float32)
    weights = np.asarray(weights_of(sigmas, deltas))
    # float32; the error of exp(-x) is that of x, 1e-7 x, times exp(-x): below 1e-6 everywhere
    assert_allclose(weights, oracles.composite(sigmas.astype(float), deltas.astype(float)), atol=2e-6)
    assert np.all(weights >= 0)
    assert weights.sum() <= 1 + 1e-6


def test_leading_axes_are_a_batch(rng):
    sigmas, deltas = rng.uniform(0, 3, (2, 3, 4, 5)).astype(np.float32)
    weights = weights_of(sigmas, deltas)
    for index in np.ndindex(3, 4):
        assert_allclose(weights[index], oracles.composite(sigmas[index], deltas[index]), atol=1e-6)


def test_transmittance_excludes_the_samples_own_interval():
    depth = jnp.array([1.0, 2.0, 3.0])
    assert_allclose(transmittance(depth), np.exp([0, -1, -3]), rtol=1e-6)


@pytest.mark.parametrize("sigma", [0.0, 1e-30, 1e8, float(np.exp(40))])
def test_extreme_densities_stay_finite(sigma):
    sigmas, deltas = jnp.full(6, sigma, jnp.float32), jnp.array([0, 1e-30, 1e-3, 2, 0, 2], jnp.float32)
    mix = jnp.arange(6.0)
    weights = weights_of(sigmas, deltas)
    gradients = jax.grad(lambda s, d: jnp.sum(mix * weights_of(s, d)), argnums=(0, 1))(sigmas, deltas)
    for value in (weights, *gradients):
        assert np.all(np.isfinite(value))
    assert_allclose(weights.sum(), float(sigma > 1), atol=1e-6)


@pytest.mark.parametrize("sigma", [0.1, 1.0, 30.0])
def test_a_constant_slab_has_the_analytic_opacity(sigma, rng):
    """1 - exp(-sigma * total), however the slab is cut."""
    deltas = rng.dirichlet(np.ones(20)).astype(np.float32) * 1.7
    opacity = jnp.sum(sample_weights(sigma * deltas))
    assert_allclose(opacity, -np.expm1(-sigma * 1.7), rtol=3e-6)  # a sum of 20 float32 terms


def test_gradients_match_finite_differences(x64, rng):
    x, mix = rng.uniform(0.1, 2, (2, 6)), rng.normal(size=6)

    def function(x):
        return jnp.sum(mix * sample_weights(x[0] * x[1]))

    gradient = jax.grad(function)(jnp.asarray(x))
    direction = rng.normal(size=x.shape)
    expected = oracles.directional_difference(function, x, direction)
    assert_allclose(np.sum(gradient * direction), expected, rtol=1e-7)  # step^2 and 1e-16 / step


def test_background_fills_what_is_left():
    color, opacity = jnp.array([[0.2, 0.1, 0.0], [0, 0, 0]]), jnp.array([0.75, 0.0])
    blended = blend_background(color, opacity, jnp.array([1.0, 0.5, 0.0]))
    assert_allclose(blended, [[0.45, 0.225, 0], [1, 0.5, 0]], atol=1e-6)
    assert_array_equal(blend_background(color, jnp.ones(2), jnp.ones(3)), color)
