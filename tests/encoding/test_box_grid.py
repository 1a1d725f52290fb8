"""encoding.box_grid: Instant-NGP's grid, looked up at the rest position of points in tets."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from meshes import MESHES, local_vertices
from numpy.testing import assert_allclose

from nimpostor_jax.config import EncodingConfig, ImpostorConfig
from nimpostor_jax.encoding.layout import NGP_PRIMES
from nimpostor_jax.field.impostor import features, init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh

COUNT = 40
CONFIG = EncodingConfig(
    layout="box", interpolation="grid", num_levels=3, base_resolution=4, growth=3.0, log2_table_size=12
)
lookup = jax.jit(features)


def box_impostor(config=CONFIG):
    """Two dense levels (125 and 2,197 nodes) and a hashed one."""
    mesh = build_tet_mesh(*MESHES["delaunay"](), dtype="float64")
    made = init_impostor(jax.random.key(0), mesh, ImpostorConfig(encoding=config))
    table = np.random.default_rng(0).normal(size=made.tables.features.shape)
    return made.replace(tables=made.tables.replace(features=jnp.asarray(table)))


def points_of(impostor, rng):
    ids = rng.integers(0, len(impostor.mesh.tets), COUNT).astype(np.int32)
    lambdas = rng.dirichlet(np.ones(4), COUNT)
    vertices, tets = local_vertices(impostor.mesh)
    low = vertices.min(axis=0)
    positions = np.einsum("ni,nix->nx", lambdas, vertices[tets[ids]])
    # The layout keeps corners in float32.
    return ids, lambdas, (positions - low) / (vertices.max(axis=0) - low).max()


def trilinear(impostor, position):
    """Instant-NGP's lookup of one point, by loops."""
    table, layout, found = np.asarray(impostor.tables.features), impostor.tables.layout, []
    size = 1 << impostor.config.encoding.log2_table_size
    for level, resolution in enumerate(impostor.config.encoding.resolutions):
        low = np.clip(np.floor(position * resolution), 0, resolution - 1).astype(int)
        share, total = position * resolution - low, 0
        for bits in itertools.product((0, 1), repeat=3):
            x, y, z = (int(n) for n in low + bits)
            if (resolution + 1) ** 3 <= size:
                entry = (z * (resolution + 1) + y) * (resolution + 1) + x
            else:
                entry = (x * NGP_PRIMES[0] ^ y * NGP_PRIMES[1] ^ z * NGP_PRIMES[2]) % size
            weight = np.prod([s if bit else 1 - s for s, bit in zip(share, bits, strict=True)])
            total = total + weight * table[int(layout.starts[level]) + entry]
        found.append(total)
    return np.concatenate(found)


def test_agrees_with_a_loop_over_voxels(x64, rng):
    impostor = box_impostor()
    assert np.diff(impostor.tables.layout.starts).tolist() == [125, 2197, 4096]
    ids, lambdas, positions = points_of(impostor, rng)
    values = lookup(impostor, jnp.asarray(ids), jnp.asarray(lambdas))
    expected = [trilinear(impostor, position) for position in positions]
    assert_allclose(values, expected, atol=1e-4)  # float32 corners, times 36 cells across the box


@pytest.mark.parametrize("interpolation", ["grid", "simplex"])
def test_is_continuous_across_faces_and_follows_the_cage(interpolation, x64, rng):
    """Equal rest positions have equal features, from whichever tet; moving vertices changes nothing."""
    impostor = box_impostor(EncodingConfig(**{**CONFIG.__dict__, "interpolation": interpolation}))
    mesh = impostor.mesh
    tet, corner = np.argwhere(np.asarray(mesh.neighbors) >= 0)[:COUNT].T
    other = np.asarray(mesh.neighbors)[tet, corner]
    tets = np.asarray(mesh.tets)
    here, there = np.zeros((2, len(tet), 4))
    weights = rng.dirichlet(np.ones(3), len(tet))
    for n, (a, b, c) in enumerate(zip(tet, other, corner, strict=True)):
        face = [i for i in range(4) if i != c]
        here[n, face] = weights[n]
        there[n, [list(tets[b]).index(tets[a, i]) for i in face]] = weights[n]
    moved = impostor.replace(mesh=mesh.replace(vertices=mesh.vertices * 2 + 1))
    first = lookup(impostor, jnp.asarray(tet, jnp.int32), jnp.asarray(here))
    assert_allclose(first, lookup(moved, jnp.asarray(other, jnp.int32), jnp.asarray(there)), atol=1e-9)


@pytest.mark.parametrize("interpolation", ["grid", "simplex"])
def test_gradients_agree_with_differences(interpolation, x64, rng):
    impostor = box_impostor(EncodingConfig(**{**CONFIG.__dict__, "interpolation": interpolation}))
    ids, lambdas, _ = points_of(impostor, rng)
    weights = jnp.asarray(rng.normal(size=(COUNT, 6)))

    def value(lambdas, table):
        at = impostor.replace(tables=impostor.tables.replace(features=table))
        return jnp.sum(weights * features(at, jnp.asarray(ids), lambdas))

    arguments = jnp.asarray(lambdas), impostor.tables.features
    gradients = jax.jit(jax.grad(value, argnums=(0, 1)))(*arguments)
    for which, direction in enumerate(jnp.asarray(rng.normal(size=x.shape)) for x in arguments):
        steps = [
            value(*(x + sign * 1e-7 * direction if i == which else x for i, x in enumerate(arguments)))
            for sign in (-1, 1)
        ]
        expected = (steps[1] - steps[0]) / 2e-7
        # 1e-7 stays within a cell of 40 points but for bad luck, which the seed excludes
        assert_allclose(jnp.sum(gradients[which] * direction), expected, rtol=1e-5)


