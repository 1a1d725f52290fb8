"""encoding.hash_grid: interpolation, continuity across faces, gradients."""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from meshes import MESHES
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.hash_grid import encode, init_features
from nimpostor_jax.encoding.layout import build_layout
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import adjacency
from nimpostor_jax.types import HashTables

KINDS = list(itertools.product(["per_simplex", "per_tet"], ["grid", "simplex"]))
LEVELS = 3  # 1, 6 and 36: dense ones and a hashed one
COUNT = 64  # points: of one shape, so that few programs are compiled
encode_jit = jax.jit(encode, static_argnames="config")


@functools.cache
def tables_of(layout, interpolation, mesh="delaunay", dtype="float64"):
    """Random tables on a mesh, small enough that the finest levels are hashed with collisions."""
    config = EncodingConfig(
        layout=layout, interpolation=interpolation, num_levels=LEVELS, growth=6.0, log2_tet_table=8
    )
    vertices, tets = MESHES[mesh]()
    hash_layout = build_layout(vertices, tets, config)
    rng = np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(int(hash_layout.starts[-1]), 2)), dtype)
    return config, tets, HashTables(features=features, layout=hash_layout)


def random_points(tets, rng, count):
    return rng.integers(0, len(tets), count).astype(np.int32), rng.dirichlet(np.ones(4), count)


@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_agrees_with_a_loop_over_nodes(layout, interpolation, x64, rng):
    config, tets, tables = tables_of(layout, interpolation)
    ids, lambdas = random_points(tets, rng, COUNT)
    values = encode_jit(tables, config, jnp.asarray(ids), jnp.asarray(lambdas))
    assert values.shape == (COUNT, LEVELS * 2)
    for value, tet, coordinates in zip(values, ids, lambdas, strict=True):
        expected = oracles.encode(tables.features, tables.layout, config, tet, coordinates)
        assert_allclose(value, expected, atol=1e-12)


@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_returns_a_nodes_own_feature_at_the_node(layout, interpolation, x64, rng):
    config, tets, tables = tables_of(layout, interpolation)
    order = np.asarray(tables.layout.corner_order)
    for level, resolution in enumerate(config.resolutions):
        nodes = rng.multinomial(resolution, [0.25] * 4, COUNT)
        nodes[:4] = resolution * np.eye(4)  # the tet's corners among them
        ids = rng.integers(0, len(tets), COUNT).astype(np.int32)
        lambdas = np.zeros((COUNT, 4))
        np.put_along_axis(lambdas, order[ids], nodes / resolution, axis=1)
        values = encode_jit(tables, config, jnp.asarray(ids), jnp.asarray(lambdas))[
            :, 2 * level : 2 * level + 2
        ]
        entries = [
            oracles.node_entry(tables.layout, config, level, t, n) for t, n in zip(ids, nodes, strict=True)
        ]
        assert_allclose(values, tables.features[np.array(entries)], atol=1e-12)


@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_constant_tables_give_constants(layout, interpolation, x64, rng):
    """Weights sum to 1 everywhere, at corners, on edges and faces too."""
    config, tets, tables = tables_of(layout, interpolation)
    ids, lambdas = random_points(tets, rng, COUNT)
    lambdas[:20, rng.integers(0, 4)] = 0
    lambdas[:8, :3] = np.eye(4)[:, :3][rng.integers(0, 3, 8)]
    lambdas /= lambdas.sum(axis=1, keepdims=True)
    constant = tables.replace(features=jnp.full_like(tables.features, 0.7))
    values = encode_jit(constant, config, jnp.asarray(ids), jnp.asarray(lambdas))
    assert_allclose(values, 0.7, atol=1e-12)


@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_weights_are_not_negative(layout, interpolation, x64, rng):
    """By the gradient in the tables, which is the weights."""
    config, tets, tables = tables_of(layout, interpolation)
    ids, lambdas = random_points(tets, rng, COUNT)

    def total(features):
        return jnp.sum(
            encode(tables.replace(features=features), config, jnp.asarray(ids), jnp.asarray(lambdas))
        )

    gradient = jax.jit(jax.grad(total))(tables.features)
    assert np.min(gradient) >= 0
    for start, stop in itertools.pairwise(tables.layout.starts):
        assert_allclose(np.sum(gradient[start:stop]), COUNT * 2, rtol=1e-9)


def interior_face_points(tets, rng, count):
    """Points on interior faces, seen from both sides: (tet, lambdas) twice."""
    neighbors = adjacency(tets)
    pairs = np.argwhere(neighbors >= 0)
    sides = [[], []]
    for tet, corner in pairs[rng.integers(0, len(pairs), count)]:
        other = neighbors[tet, corner]
        shared = tets[tet][list(FACES[corner])]
        weights = rng.dirichlet(np.ones(3))
        for side, t in zip(sides, (tet, other), strict=True):
            lambdas = np.zeros(4)
            for vertex, weight in zip(shared, weights, strict=True):
                lambdas[list(tets[t]).index(vertex)] = weight
            side.append((t, lambdas))
    return [(jnp.asarray([t for t, _ in s], jnp.int32), jnp.asarray([x for _, x in s])) for s in sides]


@pytest.mark.parametrize("mesh", ["delaunay", "nonconvex"])
@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_only_per_simplex_is_continuous_across_faces(layout, interpolation, mesh, x64, rng):
    config, tets, tables = tables_of(layout, interpolation, mesh)
    left, right = (encode_jit(tables, config, *side) for side in interior_face_points(tets, rng, COUNT))
    jump = np.abs(left - right).max(axis=0).reshape(LEVELS, 2).max(axis=1)
    if layout == "per_simplex":
        assert_array_equal(
            jump < 1e-12, True
        )  # the same nodes with the same weights, summed in another order
    else:
        assert np.all(jump > 0.1)  # features are standard normal


@pytest.mark.parametrize("interpolation", ["grid", "simplex"])
def test_per_simplex_does_not_depend_on_how_tets_are_listed(interpolation, x64, rng):
    """Renumbered tets and turned corners: the same tables give the same field."""
    config, tets, tables = tables_of("per_simplex", interpolation)
    turns = np.array([p for p in itertools.permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0])
    turn = turns[rng.integers(0, len(turns), len(tets))]
    shuffle = rng.permutation(len(tets))
    relisted = np.take_along_axis(tets, turn, axis=1)[shuffle]
    layout = build_layout(MESHES["delaunay"]()[0], relisted, config)
    assert_array_equal(layout.starts, tables.layout.starts)

    def canonical(tets, layout, features):
        """Tables addressed through geometry: a feature for each place that does not name tets."""
        ids, lambdas = random_points(tets, np.random.default_rng(3), COUNT)
        return ids, lambdas, encode_jit(HashTables(features=features, layout=layout), config, ids, lambdas)

    ids, lambdas, expected = canonical(tets, tables.layout, tables.features)
    new_ids = np.argsort(shuffle)[ids].astype(np.int32)
    new_lambdas = np.take_along_axis(lambdas, turn[ids], axis=1)
    relisted_tables = HashTables(features=tables.features, layout=layout)
    found = encode_jit(relisted_tables, config, jnp.asarray(new_ids), jnp.asarray(new_lambdas))
    assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("layout, interpolation", KINDS)
def test_gradients_match_finite_differences_and_plain_autodiff(layout, interpolation, x64, rng):
    config, tets, tables = tables_of(layout, interpolation)
    ids, lambdas = random_points(tets, rng, COUNT)
    ids, lambdas = jnp.asarray(ids), jnp.asarray(lambdas)
    mix = jnp.asarray(rng.normal(size=(COUNT, 6)))

    def of_lambdas(x):
        return jnp.sum(mix * encode(tables, config, ids, x))

    def of_tables(features):
        return jnp.sum(mix * encode(tables.replace(features=features), config, ids, lambdas))

    direction = rng.normal(size=lambdas.shape)
    expected = oracles.directional_difference(jax.jit(of_lambdas), lambdas, direction, 1e-7)
    # piecewise multilinear, and 1e-7 crosses no cell here: 1e-16 / 1e-7 is left
    assert_allclose(jnp.sum(jax.jit(jax.grad(of_lambdas))(lambdas) * direction), expected, rtol=1e-6)

    gradient = jax.jit(jax.grad(of_tables))(tables.features)
    nudge = rng.normal(size=tables.features.shape)
    of_tables = jax.jit(of_tables)
    exact = of_tables(tables.features + nudge) - of_tables(tables.features)
    assert_allclose(np.sum(gradient * nudge), exact, rtol=1e-9)  # linear

    # Forward over reverse-free: the tables' gradient is also the transpose of the linear map, by autodiff.
    (transposed,) = jax.linear_transpose(plain_tables(tables, config, ids, lambdas), tables.features)(mix)
    assert_allclose(gradient, transposed, atol=1e-12)


def plain_tables(tables, config, ids, lambdas):
    """The encoding as a plain gather with the oracle's nodes, for JAX to transpose."""
    nodes = oracles.grid_nodes if config.interpolation == "grid" else oracles.simplex_nodes
    order = np.asarray(tables.layout.corner_order)
    plans = []
    for level, resolution in enumerate(config.resolutions):
        rows = []
        for tet, coordinates in zip(np.asarray(ids), np.asarray(lambdas), strict=True):
            pairs = list(nodes(coordinates[order[tet]], resolution))
            rows.append([(oracles.node_entry(tables.layout, config, level, tet, u), w) for u, w in pairs])
        plans.append(np.array(rows))

    def apply(features):
        return jnp.concatenate(
            [jnp.sum(features[p[..., 0].astype(int)] * p[..., 1:], axis=1) for p in plans],
            axis=1,
        )

    return apply


@pytest.mark.parametrize("interpolation", ["grid", "simplex"])
def test_gradients_are_finite_on_corners_edges_and_faces(interpolation):
    config, _, tables = tables_of("per_simplex", interpolation, dtype="float32")
    lambdas = np.concatenate(
        [np.eye(4), [[0.5, 0.5, 0, 0], [0, 0.25, 0.75, 0], [0.25] * 4, [0, 1 / 3, 1 / 3, 1 / 3]]]
    )
    lambdas = jnp.asarray(lambdas, jnp.float32)
    total = jax.jit(jax.grad(lambda x: jnp.sum(encode(tables, config, jnp.zeros(8, jnp.int32), x))))
    gradient = total(lambdas)
    assert np.all(np.isfinite(gradient))


def test_all_levels_may_be_hashed(x64, rng):
    config = EncodingConfig(num_levels=2, base_resolution=20, log2_tet_table=4)
    vertices, tets = MESHES["delaunay"]()
    layout = build_layout(vertices, tets, config)
    assert len(layout.dense_ranks) == 0
    features = jnp.asarray(rng.normal(size=(int(layout.starts[-1]), 2)))
    ids, lambdas = random_points(tets, rng, 4)
    values = encode_jit(HashTables(features, layout), config, jnp.asarray(ids), jnp.asarray(lambdas))
    for value, tet, coordinates in zip(values, ids, lambdas, strict=True):
        assert_allclose(value, oracles.encode(features, layout, config, tet, coordinates), atol=1e-12)


def test_gradients_asked_for_alone_are_those_of_both(rng):
    config, tets, tables = tables_of("per_simplex", "simplex", dtype="float32")
    ids, lambdas = map(jnp.asarray, random_points(tets, rng, COUNT))

    def total(features, lambdas):
        values = encode(tables.replace(features=features), config, ids, lambdas.astype(jnp.float32))
        return jnp.sum(values**2)

    by_both = jax.jit(jax.grad(total, argnums=(0, 1)))(tables.features, lambdas)
    for argument, expected in enumerate(by_both):
        alone = jax.jit(jax.grad(total, argnums=argument))(tables.features, lambdas)
        assert_allclose(alone, expected, rtol=1e-5, atol=1e-5)  # sums in another order


def test_coordinates_out_of_range_by_rounding_are_clipped(rng):
    config, _, tables = tables_of("per_simplex", "grid", dtype="float32")
    inside = jnp.array([[0.0, 0.5, 0.5, 0.0]], jnp.float32)
    outside = jnp.array([[-1e-6, 0.5, 0.5, -1e-6]], jnp.float32)
    ids = jnp.zeros(1, jnp.int32)
    assert_array_equal(encode_jit(tables, config, ids, inside), encode_jit(tables, config, ids, outside))


def test_initial_features_are_small_and_differ():
    config = EncodingConfig(num_levels=2, init_scale=0.01)
    features = init_features(jax.random.key(0), 500, config)
    assert features.shape == (500, 2)
    assert np.abs(features).max() <= 0.01
    assert np.std(features) > 0.004
    assert abs(np.corrcoef(features[:, 0], features[:, 1])[0, 1]) < 0.3
