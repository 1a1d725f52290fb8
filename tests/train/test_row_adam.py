"""train.row_adam: Adam where a batch touches few rows."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax import chunks
from nimpostor_jax.train.row_adam import no_row_moments, update_rows
from nimpostor_jax.train.step import make_optimizer

RATE = jnp.float32(0.1)
step = jax.jit(update_rows)


def test_is_adam_for_rows_that_every_step_touches(rng, monkeypatch):
    monkeypatch.setattr(chunks, "CPU_CHUNK", 8)
    table = jnp.asarray(rng.normal(size=(21, 3)), jnp.float32)
    optimizer = make_optimizer()
    expected, state, moments = table, optimizer.init(table), no_row_moments(table)
    for _ in range(4):
        gradient = jnp.asarray(rng.normal(size=table.shape), jnp.float32)
        updates, state = optimizer.update(gradient, state)
        expected = optax.apply_updates(expected, -RATE * updates)
        table, moments = step(table, moments, gradient, RATE)
    assert_allclose(table, expected, atol=1e-5)  # float32, in another order


def test_rows_without_gradient_stay_to_the_bit(rng):
    table = jnp.asarray(rng.normal(size=(21, 3)), jnp.float32)
    moments = no_row_moments(table)
    touched = np.zeros((21, 1), bool)
    touched[[0, 5, 20]] = True
    for _ in range(3):
        gradient = jnp.asarray(np.where(touched, rng.normal(size=table.shape), 0), jnp.float32)
        after, moments = step(table, moments, gradient, RATE)
        assert_array_equal(np.any(np.asarray(after != table), axis=1), touched[:, 0])
        table = after
    assert_array_equal(np.any(np.asarray(moments.second), axis=1), touched[:, 0])


def test_no_gradient_at_all_moves_nothing():
    table = jnp.ones((5, 2))
    after, _ = step(table, no_row_moments(table), jnp.zeros_like(table), RATE)
    assert_array_equal(after, table)
