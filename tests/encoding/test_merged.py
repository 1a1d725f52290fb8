"""encoding.merged: the same features as level by level."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import MESHES
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.encoding.layout import build_layout, join_layouts
from nimpostor_jax.encoding.merged import (
    encode_merged,
    feature_order,
    merge_levels,
    node_coordinates,
    node_number,
)
from nimpostor_jax.types import HashTables, MergedTables

CONFIG = EncodingConfig(num_levels=6, log2_tet_table=5)  # 1, 2, 3, 4, 6, 8: dense and hashed
encode_jit = jax.jit(encode, static_argnames="config")
merged_jit = jax.jit(encode_merged, static_argnames="config")


def tables_of(config, dtype, mesh="delaunay", layout=None):
    layout = build_layout(*MESHES[mesh](), config) if layout is None else layout
    features = np.random.default_rng(0).normal(size=(int(layout.starts[-1]), config.features_per_level))
    return HashTables(features=jnp.asarray(features, dtype), layout=layout)


def points_of(tables, dtype, count=500):
    """Within tets, on their faces and edges, and at their corners."""
    rng = np.random.default_rng(1)
    lambdas = rng.dirichlet(np.ones(4), count)
    lambdas[:200] *= rng.integers(0, 2, (200, 4))
    lambdas[:200, 0] += lambdas[:200].sum(axis=1) == 0
    lambdas[200:204] = np.eye(4)
    lambdas /= lambdas.sum(axis=1, keepdims=True)
    tets = rng.integers(0, tables.layout.corner_order.shape[0], count)
    return jnp.asarray(tets, jnp.int32), jnp.asarray(lambdas, dtype)


def check_merged(merged, tables, config, dtype, tolerance):
    points = points_of(tables, dtype)
    expected = encode_jit(tables, config, *points)[:, feature_order(merged, config)]
    assert_allclose(merged_jit(merged, config, *points), expected, atol=tolerance)


def test_nodes_are_numbered_one_by_one():
    assert_array_equal(node_number(*node_coordinates(7).T), np.arange(120))


# Rounding of the weights; float32 puts points near a node on its other side.
@pytest.mark.parametrize("dtype, tolerance", [("float64", 1e-13), ("float32", 3e-5)])
@pytest.mark.parametrize("layout", ["per_simplex", "per_tet"])
def test_all_levels_in_one(layout, dtype, tolerance, x64):
    config = dataclasses.replace(CONFIG, layout=layout)
    tables = tables_of(config, dtype)
    merged = merge_levels(tables, config)
    assert isinstance(merged, MergedTables) and merged.finer is None
    assert merged.chains == ((0, 1, 3, 5), (2, 4))
    check_merged(merged, tables, config, dtype, tolerance)


@pytest.mark.parametrize("growth, levels", [(None, 10), (2.0, 6), (6.0, 3)])
def test_finer_levels_that_do_not_fit_stay_as_they_are(growth, levels, x64):
    config = dataclasses.replace(CONFIG, growth=growth, num_levels=levels)
    tables = tables_of(config, "float64")
    merged = merge_levels(tables, config, max_megabytes=1)
    assert isinstance(merged, MergedTables) and merged.finer is not None
    assert sum(nodes.nbytes for nodes in merged.nodes) <= 1 << 20
    check_merged(merged, tables, config, "float64", 1e-13)


def test_joined_layouts_with_mixed_levels(x64):
    """Dense in the small mesh, hashed in the large one."""
    small = build_layout(*MESHES["delaunay"](), dataclasses.replace(CONFIG, log2_tet_table=9))
    large = build_layout(*MESHES["delaunay"](), CONFIG)
    tables = tables_of(CONFIG, "float64", layout=join_layouts([small, large]))
    assert tables.layout.num_mixed
    for megabytes in (64, 0.5):
        merged = merge_levels(tables, CONFIG, megabytes)
        assert isinstance(merged, MergedTables)
        check_merged(merged, tables, CONFIG, "float64", 1e-13)


@pytest.mark.parametrize(
    "changes, megabytes",
    [
        ({"growth": 1.5, "base_resolution": 4, "num_levels": 2}, 64),
        ({"interpolation": "grid"}, 64),
        ({}, 0),
        ({"num_levels": 1}, 64),
    ],
)
def test_what_cannot_be_merged_stays_as_it_is(changes, megabytes):
    config = dataclasses.replace(CONFIG, **changes)
    tables = tables_of(config, "float32")
    assert merge_levels(tables, config, megabytes) is tables
