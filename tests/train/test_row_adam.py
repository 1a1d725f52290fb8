"""train.row_adam: Adam where a batch touches few rows."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
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
        rows = jnp.asarray(rng.permutation(21), jnp.int32)
        gradient = jnp.asarray(rng.normal(size=table.shape), jnp.float32)
        updates, state = optimizer.update(gradient, state)
        expected = optax.apply_updates(expected, -RATE * updates)
        table, moments = step(table, moments, rows, gradient[rows], jnp.int32(21), RATE)
    assert_allclose(table, expected, atol=1e-5)  # float32, in another order


@pytest.mark.parametrize("size", [3, 8])
def test_other_rows_and_rows_without_gradient_stay_to_the_bit(size, rng):
    """Row 7 has no gradient, and what stands behind the used rows is not looked at."""
    table = jnp.asarray(rng.normal(size=(21, 3)), jnp.float32)
    moments = no_row_moments(table)
    rows = jnp.asarray([20, 7, 5, 1, 2, 3, 4, 6][:size], jnp.int32)
    for _ in range(3):
        gradient = jnp.asarray(rng.normal(size=(size, 3)), jnp.float32).at[1].set(0)
        after, moments = step(table, moments, rows, gradient, jnp.int32(3), RATE)
        assert_array_equal(np.flatnonzero(np.any(np.asarray(after != table), axis=1)), [5, 20])
        table = after
    assert_array_equal(np.flatnonzero(np.any(np.asarray(moments.second), axis=1)), [5, 20])


def test_no_rows_at_all_move_nothing():
    table = jnp.ones((5, 2))
    after, _ = step(table, no_row_moments(table), jnp.zeros(4, jnp.int32), table[:4], jnp.int32(0), RATE)
    assert_array_equal(after, table)
