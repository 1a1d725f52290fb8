"""render.composite."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax import chunks
from nimpostor_jax.chunks import ROW
from nimpostor_jax.render.composite import (
    blend_background,
    sample_weights,
    sum_before,
    sum_by_ray,
    transmittance,
)


@jax.jit
def weights_of(sigmas, deltas):
    """Of one ray."""
    return sample_weights(sigmas * deltas, jnp.zeros(len(sigmas), jnp.int32))


def packed_rays(counts):
    """The ray of each sample."""
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)


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


def test_packed_rays_do_not_see_each_other(rng):
    counts = [3, 0, 1, 7]
    rays = packed_rays(counts)
    sigmas, deltas = rng.uniform(0, 3, (2, len(rays))).astype(np.float32)
    weights = sample_weights(jnp.asarray(sigmas * deltas), jnp.asarray(rays))
    for ray in range(len(counts)):
        mine = rays == ray
        assert_allclose(weights[mine], oracles.composite(sigmas[mine], deltas[mine]), atol=1e-6)


@pytest.mark.parametrize(
    "counts",
    [[], [1], [ROW], [ROW + 1], [5 * ROW + 3], [3, 4 * ROW, 2, 0, ROW], [1] * (3 * ROW), [50] * 9],
)
def test_sums_before_follow_the_loop_across_rows(counts, rng):
    """Forward and, as the transpose, backward."""
    rays = packed_rays(counts)
    values, mix = rng.uniform(0, 1, (2, len(rays))).astype(np.float32)
    sums = jax.jit(sum_before)(values, rays)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(mix * sum_before(v, rays))))(values)
    for ray in range(len(counts)):
        mine = rays == ray
        before = np.cumsum(values[mine], dtype=np.float64) - values[mine]
        after = np.cumsum(mix[mine][::-1], dtype=np.float64)[::-1] - mix[mine]
        assert_allclose(sums[mine], before, rtol=1e-5, atol=1e-6)  # up to 300 float32 additions
        assert_allclose(gradient[mine], after, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("counts", [[], [1], [2, 1], [3, 4 * ROW, 2, 0, ROW], [1] * 9, [50] * 9])
def test_sums_before_follow_the_loop_on_accelerators(counts, rng, on_accelerators):
    test_sums_before_follow_the_loop_across_rows(counts, rng)


@pytest.mark.parametrize("backend, chunk", [("cpu", 2 * ROW), ("cpu", 100 * ROW), ("gpu", None)])
@pytest.mark.parametrize("used", [0, 1, 2 * ROW, 5 * ROW + 7])
def test_sums_before_follow_the_loop_over_what_is_used(used, backend, chunk, rng, monkeypatch):
    """In several chunks, in one, and as accelerators take them."""
    monkeypatch.setattr(chunks, "CPU_CHUNK", chunk)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    rays = packed_rays([40, 3 * ROW, 1, 2 * ROW, 200])[: 5 * ROW + 7]
    values, mix = rng.uniform(0, 1, (2, len(rays))).astype(np.float32)
    sums = jax.jit(lambda v: sum_before(v, rays, jnp.int32(used)))(values)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(mix * sum_before(v, rays, jnp.int32(used)))))(values)
    for ray in range(5):
        mine = np.flatnonzero(rays[:used] == ray)
        before = np.cumsum(values[mine], dtype=np.float64) - values[mine]
        after = np.cumsum(mix[mine][::-1], dtype=np.float64)[::-1] - mix[mine]
        assert_allclose(sums[mine], before, rtol=1e-5, atol=1e-6)
        assert_allclose(gradient[mine], after, rtol=1e-5, atol=1e-6)
    assert_array_equal(gradient[used:], 0)


def test_sums_by_ray_and_their_gradients(rng, x64, monkeypatch):
    """The first `used` samples only, whatever stands behind them."""
    monkeypatch.setattr(chunks, "CPU_CHUNK", 4)
    rays, used = packed_rays([3, 0, 5, 4]), 10
    weights, values = jnp.asarray(rng.normal(size=12)), jnp.asarray(rng.normal(size=(12, 2)))
    mix = rng.normal(size=(4, 2))

    def plain(weights, values):
        return jax.ops.segment_sum((weights[:, None] * values)[:used], rays[:used], 4)

    def ours(weights, values):
        return sum_by_ray(weights, values, jnp.asarray(rays), 4, jnp.int32(used))

    assert_allclose(ours(weights, values), plain(weights, values), rtol=1e-12)
    assert_array_equal(ours(weights, values.at[used:].set(jnp.nan)), ours(weights, values))
    of = (jax.grad(lambda *a, f=f: jnp.sum(mix * f(*a)), (0, 1)) for f in (ours, plain))
    for mine, theirs in zip(*(gradient(weights, values) for gradient in of), strict=True):
        assert_allclose(mine, theirs, rtol=1e-12)


def test_a_thin_ray_behind_a_dense_one_keeps_its_digits():
    """Differences of a sum over all rays would be lost beside 1e8."""
    values = jnp.asarray(np.r_[np.full(100, 1e8), 1e-3, 2e-3, 3e-3], jnp.float32)
    sums = sum_before(values, jnp.asarray(packed_rays([100, 3])))
    assert_allclose(sums[100:], [0, 1e-3, 3e-3], rtol=1e-6)


def test_transmittance_excludes_the_samples_own_interval():
    depth = jnp.array([1.0, 2.0, 3.0])
    assert_allclose(transmittance(depth, jnp.zeros(3, jnp.int32)), np.exp([0, -1, -3]), rtol=1e-6)


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
    opacity = jnp.sum(weights_of(np.full(20, sigma, np.float32), deltas))
    assert_allclose(opacity, -np.expm1(-sigma * 1.7), rtol=3e-6)  # a sum of 20 float32 terms


def test_gradients_match_finite_differences(x64, rng):
    x, mix = rng.uniform(0.1, 2, (2, 6)), rng.normal(size=6)

    def function(x):
        return jnp.sum(mix * sample_weights(jnp.ravel(x[0] * x[1]), jnp.array([0, 0, 0, 1, 1, 1])))

    gradient = jax.grad(function)(jnp.asarray(x))
    direction = rng.normal(size=x.shape)
    expected = oracles.directional_difference(function, x, direction)
    assert_allclose(np.sum(gradient * direction), expected, rtol=1e-7)  # step^2 and 1e-16 / step


def test_background_fills_what_is_left():
    color, opacity = jnp.array([[0.2, 0.1, 0.0], [0, 0, 0]]), jnp.array([0.75, 0.0])
    blended = blend_background(color, opacity, jnp.array([1.0, 0.5, 0.0]))
    assert_allclose(blended, [[0.45, 0.225, 0], [1, 0.5, 0]], atol=1e-6)
    assert_array_equal(blend_background(color, jnp.ones(2), jnp.ones(3)), color)
