"""field.decoder."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.config import DecoderConfig, EncodingConfig, ImpostorConfig
from nimpostor_jax.field.decoder import (
    apply_layers,
    decode_appearance,
    decode_density,
    init_decoders,
    principal_channels,
    truncated_exp,
)

CONFIG = ImpostorConfig(
    encoding=EncodingConfig(num_levels=2),
    decoder=DecoderConfig(density_hidden=4, appearance_hidden=6, sh_degree=2),
)


@pytest.fixture
def inputs(rng):
    features = jnp.asarray(rng.normal(size=(20, 4)), jnp.float32)
    directions = jnp.asarray(rng.normal(size=(20, 4)), jnp.float32)
    return features, directions, jnp.asarray(np.arange(20) % 2, jnp.int32)


def randomised(parameters, rng):
    return jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape), jnp.float32), parameters)


def mlp(layers, chosen, x):
    """One decoder set in NumPy, float64."""
    x = np.asarray(x, float)
    for i, layer in enumerate(layers):
        x = x @ np.asarray(layer["weight"][chosen], float) + np.asarray(layer["bias"][chosen], float)
        if i + 1 < len(layers):
            x = np.maximum(x, 0)
    return x


def test_every_point_is_decoded_by_its_own_set(inputs, rng):
    features, directions, ids = inputs
    parameters = randomised(init_decoders(jax.random.key(0), CONFIG, num_sets=2), rng)
    sigmas = decode_density(parameters, features, ids)
    colors = decode_appearance(parameters, features, directions, ids)
    both = np.concatenate([features, directions], axis=1)
    for i in range(20):
        expected = np.exp(min(mlp(parameters["density"], ids[i], features[i])[0], 40.0))
        assert_allclose(sigmas[i], expected, rtol=1e-4)  # exp of a float32 sum of about 10
        logits = mlp(parameters["appearance"], ids[i], both[i])
        assert_allclose(colors[i], 1 / (1 + np.exp(-logits)), atol=1e-5)


def test_a_set_is_blind_to_other_sets_and_gets_no_gradient_from_their_points(inputs, rng):
    features, directions, ids = inputs
    parameters = randomised(init_decoders(jax.random.key(0), CONFIG, num_sets=2), rng)
    changed = jax.tree.map(lambda x: x.at[1].add(1.0), parameters)

    def colors(parameters):
        return decode_appearance(parameters, features, directions, ids)

    same = np.all(np.asarray(colors(parameters) == colors(changed)), axis=1)
    assert_array_equal(same, ids == 0)
    same = np.asarray(decode_density(parameters, features, ids) == decode_density(changed, features, ids))
    assert np.all(same[::2])
    assert not np.all(same[1::2])
    gradient = jax.grad(lambda p: jnp.sum(colors(p)[::2]))(parameters)  # points of set 0 only
    for leaf in jax.tree.leaves(gradient["appearance"]):
        assert np.any(leaf[0] != 0)
        assert_array_equal(leaf[1], 0)


def test_initial_density_is_thin_and_colours_are_in_range(inputs):
    features, directions, _ = inputs
    ids = jnp.zeros(20, jnp.int32)
    parameters = init_decoders(jax.random.key(1), CONFIG)
    assert_allclose(decode_density(parameters, jnp.zeros_like(features), ids), np.exp(-1), rtol=1e-6)
    colors = np.asarray(decode_appearance(parameters, 1e3 * features, directions, ids))
    assert np.all((colors >= 0) & (colors <= 1))
    shapes = [layer["weight"].shape for layer in parameters["appearance"]]
    assert shapes == [(1, 8, 6), (1, 6, 6), (1, 6, 3)]


def test_truncated_exp_is_exp_where_it_matters():
    x = jnp.linspace(-14, 14, 57)
    assert_allclose(truncated_exp(x), np.exp(x), rtol=1e-5)
    assert_allclose(jax.vmap(jax.grad(truncated_exp))(x), np.exp(x), rtol=1e-5)


@pytest.mark.parametrize("x", [-1e4, -100.0, 16.0, 100.0, 1e30])
def test_truncated_exp_and_its_gradient_are_bounded(x):
    value, gradient = jax.value_and_grad(truncated_exp)(x)
    assert 0 <= value <= 1.01 * np.exp(40)
    assert 0 < gradient <= 1.01 * np.exp(15)
    _, tangent = jax.jvp(truncated_exp, (x,), (1.0,))
    assert tangent == gradient


@pytest.mark.parametrize(("rank", "count"), [(2, 2), (4, 4), (4, 9), (4, 2)])
def test_principal_channels_keep_what_the_decoder_sees(rank, count, inputs, rng):
    """Exact where there are as many as features vary in; else the best ones."""
    _, directions, ids = inputs
    parameters = randomised(init_decoders(jax.random.key(0), CONFIG, num_sets=2), rng)
    features = jnp.asarray(rng.normal(size=(20, rank)) @ rng.normal(size=(rank, 4)), jnp.float32)
    products = np.stack([features[ids == i].T @ features[ids == i] for i in range(2)])
    fewer, layer = principal_channels(parameters, products, count)
    channels = apply_layers(layer, features, ids)
    assert channels.shape == (20, min(count, 4))
    colors = decode_appearance(parameters, features, directions, ids)
    found = decode_appearance(fewer, channels, directions, ids)
    if count >= rank:
        assert_allclose(found, colors, atol=1e-5)  # sums of float32 in another order
    else:
        for i in range(2):
            first, second = (np.asarray(p["appearance"][0]["weight"][i]) for p in (parameters, fewer))
            seen = np.asarray(features[ids == i]) @ first[:4]
            kept = np.asarray(channels[ids == i]) @ second[:count]
            left_out = np.linalg.svd(seen, compute_uv=False)[count:]
            assert_allclose(np.linalg.norm(seen - kept), np.linalg.norm(left_out), rtol=1e-3)
