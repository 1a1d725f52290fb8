"""field.impostor."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import tet_mesh
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.config import DecoderConfig, EncodingConfig, ImpostorConfig
from nimpostor_jax.field import impostor as field

CONFIG = ImpostorConfig(
    encoding=EncodingConfig(num_levels=2, log2_tet_table=8),
    decoder=DecoderConfig(density_hidden=4, appearance_hidden=8),
)


@pytest.fixture
def impostor():
    return field.init_impostor(jax.random.key(0), tet_mesh("cube"), CONFIG)


def points(rng, count=24):
    ids = jnp.asarray(np.arange(count) % 6, jnp.int32)
    return ids, jnp.asarray(rng.dirichlet(np.ones(4), count), jnp.float32)


def test_shapes_and_ranges(impostor, rng):
    ids, lambdas = points(rng)
    features = field.features(impostor, ids, lambdas)
    assert features.shape == (24, CONFIG.encoding.feature_dim)
    assert np.all(np.abs(features) <= CONFIG.encoding.init_scale)
    directions = field.encode_directions(impostor, jnp.eye(3))
    assert directions.shape == (3, 16)
    colors = field.radiance(impostor, ids, features, directions[np.arange(24) % 3])
    assert colors.shape == (24, 3)
    assert np.all(field.density(impostor, ids, features) > 0)
    assert not np.any(np.asarray(impostor.tables.features) == 0)


def test_an_impostor_without_view_directions(rng):
    config = dataclasses.replace(
        CONFIG, decoder=DecoderConfig(sh_degree=0, density_hidden=4, appearance_hidden=8)
    )
    impostor = field.init_impostor(jax.random.key(0), tet_mesh("cube"), config)
    ids, lambdas = points(rng)
    features = field.features(impostor, ids, lambdas)
    directions = field.encode_directions(impostor, jnp.ones((24, 3)))
    assert directions.shape == (24, 0)
    assert field.radiance(impostor, ids, features, directions).shape == (24, 3)


def test_a_second_decoder_set_changes_only_its_own_tets(impostor, rng):
    """A local edit (Sec. 4.2): the touched tets get a copy, all others stay bit-identical."""
    ids, lambdas = points(rng)
    stacked = jax.tree.map(lambda x: jnp.concatenate([x, x + 0.3]), impostor.decoders)
    edited = impostor.replace(
        decoders=stacked, decoder_index=impostor.decoder_index.at[jnp.array([1, 4])].set(1)
    )
    features = field.features(impostor, ids, lambdas)
    before, after = field.density(impostor, ids, features), field.density(edited, ids, features)
    touched = np.isin(ids, [1, 4])
    assert_array_equal(np.asarray(after != before), touched)


def test_two_impostors_of_one_key_are_equal(impostor):
    again = field.init_impostor(jax.random.key(0), tet_mesh("cube"), CONFIG)
    for a, b in zip(jax.tree.leaves(impostor), jax.tree.leaves(again), strict=True):
        assert_array_equal(a, b)
    other = field.init_impostor(jax.random.key(1), tet_mesh("cube"), CONFIG)
    assert not np.allclose(other.tables.features, impostor.tables.features)
    assert_allclose(other.mesh.vertices, impostor.mesh.vertices)
