"""chunks: the used part of a buffer, chunk by chunk."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax import chunks
from nimpostor_jax.chunks import map_used, pack_where, running


def scale_and_pick(shared, items):
    factor, table = shared
    values, index = items
    return jnp.sin(values) * factor, values[:, 0] * table[index]


def scene(rng, count):
    shared = (jnp.asarray(rng.normal(size=3)), jnp.asarray(rng.normal(size=5)))
    items = (jnp.asarray(rng.normal(size=(count, 3))), jnp.asarray(rng.integers(0, 5, count), jnp.int32))
    return shared, items


@pytest.mark.parametrize("count, used, chunk", [(10, 10, 4), (10, 7, 4), (8, 0, 4), (3, 3, 8), (12, 4, 4)])
def test_equals_the_plain_function_on_the_used_items(count, used, chunk, x64, rng):
    shared, items = scene(rng, count)
    mapped = jax.jit(lambda s, i, n: map_used(scale_and_pick, s, i, n, chunk))(shared, items, used)
    computed = min(count, -(-used // chunk) * chunk)
    for ours, plain in zip(mapped, scale_and_pick(shared, items), strict=True):
        assert_array_equal(ours[:used], plain[:used])
        assert_array_equal(ours[computed:], 0)  # nothing is done for the chunks beyond


def test_gradients_equal_those_of_the_plain_function(x64, rng):
    shared, items = scene(rng, 10)
    used, mix = 7, jnp.asarray(rng.normal(size=(10, 3)))

    def total(function):
        def of(shared, values):
            first, second = function(shared, (values, items[1]))
            return jnp.sum((mix * first)[:used]) + jnp.sum((second**2)[:used])

        return jax.jit(jax.grad(of, argnums=(0, 1)))(shared, items[0])

    ours = total(lambda s, i: map_used(scale_and_pick, s, i, jnp.int32(used), 4))
    plain = total(scale_and_pick)
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(plain), strict=True):
        assert_allclose(a, b, atol=1e-14)  # sums in another order


def test_the_number_used_does_not_recompile(rng):
    traces = []

    @jax.jit
    def mapped(items, used):
        traces.append(1)
        return map_used(lambda _, x: x + 1, None, items, used, 4)

    results = [np.asarray(mapped(jnp.zeros(12), used)) for used in (0, 3, 12)]
    assert [int(r.sum()) for r in results] == [0, 4, 12]
    assert len(traces) == 1


@pytest.mark.parametrize("count", [1, 63, 64, 65, 64 * 64 + 1, 20_000])
def test_running_folds_follow_numpy(count, rng):
    values = rng.integers(-50, 50, count).astype(np.int32)
    assert_array_equal(running(jnp.add, values, 0), np.cumsum(values))
    assert_array_equal(running(jnp.maximum, values, -100), np.maximum.accumulate(values))


@pytest.mark.parametrize("count", [0, 1, 2, 3, 1000])
def test_running_folds_follow_numpy_on_accelerators(count, rng, on_accelerators):
    test_running_folds_follow_numpy(count, rng)
    assert "scan" not in str(jax.make_jaxpr(lambda v: running(jnp.add, v, 0))(jnp.zeros(1000)))


@pytest.mark.parametrize("used", [0, 7, 10])
def test_one_chunk_is_no_loop_on_accelerators(used, rng, on_accelerators):
    """Which they would stop for."""
    shared, items = scene(rng, 10)
    program = jax.make_jaxpr(lambda s, i, n: map_used(scale_and_pick, s, i, n, 16))(shared, items, used)
    assert "while" not in str(program)
    mapped = map_used(scale_and_pick, shared, items, jnp.int32(used), 16)
    for ours, plain in zip(mapped, scale_and_pick(shared, items), strict=True):
        assert_allclose(ours[:used], plain[:used], rtol=1e-6)  # float32, compiled and not

    def total(values, function):
        return jnp.sum(function(shared, (values, items[1]))[0][:used])

    mapped_too = partial(map_used, scale_and_pick, num_used=jnp.int32(used), chunk=16)
    ours, plain = (jax.grad(total)(items[0], function) for function in (mapped_too, scale_and_pick))
    assert_allclose(ours, plain, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("count, used", [(0, 0), (10, 10), (10, 7), (10, 0), (9, 9), (3, 2)])
def test_items_are_packed_across_chunks(count, used, rng, monkeypatch):
    monkeypatch.setattr(chunks, "CPU_CHUNK", 4)
    values = jnp.asarray(rng.normal(size=count), jnp.float32)
    for least in (-9.0, 0.0, 9.0):
        found, kept = pack_where(lambda bound, x: x >= bound, jnp.float32(least), values, jnp.int32(used))
        assert_array_equal(found[:kept], np.flatnonzero(np.asarray(values)[:used] >= least))
        assert found.shape == (count,)
        assert np.all((np.asarray(found) >= 0) & (np.asarray(found) < max(count, 1)))
