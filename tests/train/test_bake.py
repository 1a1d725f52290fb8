"""train.bake: what rays gather in single tets, and the least squares of textures."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import local_vertices
from numpy.testing import assert_allclose
from rays import as_rays, generic
from scenes import RENDER, exact, pushed_together

from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.train.bake import PAIRS, Moments, add_seen, gather_by_tet, nothing_seen, solve_moments
from nimpostor_jax.train.sharding import device_mesh, over_rays, replicated, sums_by_device
from nimpostor_jax.train.step import RayBatch

COUNT = 32


@pytest.mark.parametrize(("times", "overlapping"), [(0, False), (1, False), (1, True)])
def test_what_tets_gather_adds_up_to_the_picture(times, overlapping, x64):
    """On a cage as coarse as the field's, or finer: samples stay where they are, only sums are cut.

    Where tets overlap, a tet's contribution depends on what it shares its place with, but the sum does not.
    """
    impostor = scenes.impostor("blobs", "float64")
    impostor = pushed_together(impostor) if overlapping else impostor
    fine = subdivide(impostor, times)
    march = dataclasses.replace(RENDER.march, max_tets_per_ray=64, max_entries_per_ray=4)
    config = dataclasses.replace(exact(max_samples_per_ray=64, min_weight=1e-12), march=march)
    origins, directions = generic(*local_vertices(impostor.mesh), np.random.default_rng(3), COUNT)
    center, scale = np.asarray(impostor.mesh.center), float(impostor.mesh.scale)
    rays = as_rays((center + scale * origins, directions), "float64")
    jitter = jnp.linspace(0, 0.99, COUNT)
    batch = RayBatch(rays=rays, target=jnp.zeros((COUNT, 4)), background=jnp.zeros((COUNT, 3)), jitter=jitter)
    found = jax.jit(gather_by_tet, static_argnames="config")(fine, batch, config=config)
    output = jax.jit(render_rays, static_argnames="config")(impostor, rays, config, jitter)
    segments = found.segments
    lengths = segments.t_exit - segments.t_enter
    seen = found.light * found.opacity
    places = seen * (segments.t_enter + found.share * lengths)
    opacity, depth = (np.bincount(segments.rays, x, COUNT) for x in (seen, places))
    # sums of some dozens of terms, some of them from another side of a face
    assert_allclose(opacity, output.opacity, atol=1e-9)
    assert np.all((found.opacity >= 0) & (found.opacity <= 1))
    assert bool(np.any(segments.disordered)) == overlapping and int(found.lost) == 0
    if not overlapping:
        assert_allclose(depth * scale, output.depth * output.opacity, atol=1e-8)
    assert np.std(opacity) > 0.05
    assert np.sum(np.asarray(segments.tet_ids) >= 0) > COUNT * (2 if times else 1)


def test_what_is_seen_is_summed_by_tet_and_by_decoder_set():
    """Against loops over what rays gather, on tets finer than the field's cells."""
    made = scenes.impostor("blobs")
    index = jnp.arange(len(made.mesh.tets), dtype=jnp.int32) % 2
    both = jax.tree.map(lambda x: jnp.concatenate([x, x]), made.decoders)
    impostor = subdivide(dataclasses.replace(made, decoders=both, decoder_index=index), 1)
    origins, directions = generic(*local_vertices(made.mesh), np.random.default_rng(3), COUNT)
    rays = as_rays((np.asarray(made.mesh.center) + float(made.mesh.scale) * origins, directions))
    zeros = jnp.zeros((COUNT, 4))
    batch = RayBatch(rays=rays, target=zeros, background=zeros[:, :3], jitter=jnp.linspace(0, 0.99, COUNT))
    found = jax.jit(gather_by_tet, static_argnames="config")(impostor, batch, config=RENDER)
    seen = jax.jit(add_seen, static_argnames="config")(nothing_seen(impostor), impostor, batch, config=RENDER)
    taken, products = np.zeros(len(impostor.mesh.tets)), np.zeros(seen.products.shape)
    for tet, light, opacity, features in zip(
        found.segments.tet_ids, found.light, found.opacity, np.asarray(found.features), strict=True
    ):
        if tet >= 0:
            taken[tet] += light * opacity
            products[index[impostor.embedding.cells[tet]]] += light * opacity * np.outer(features, features)
    assert_allclose(seen.taken, taken, rtol=1e-4, atol=1e-6)  # float32 in another order
    assert_allclose(seen.products, products, rtol=1e-4, atol=1e-5 * np.abs(products).max())
    assert np.all(np.trace(products, axis1=1, axis2=2) > 0.1)


def test_two_devices_add_up_what_one_does():
    impostor = scenes.impostor("blobs")
    origins, directions = generic(*local_vertices(impostor.mesh), np.random.default_rng(3), COUNT)
    rays = as_rays((np.asarray(impostor.mesh.center) + float(impostor.mesh.scale) * origins, directions))
    zeros = jnp.zeros((COUNT, 4))
    batch = RayBatch(rays=rays, target=zeros, background=zeros[:, :3], jitter=jnp.linspace(0, 0.99, COUNT))
    totals = []
    for devices in (1, 2):
        mesh = device_mesh(jax.devices()[:devices])
        add = jax.jit(sums_by_device(mesh, add_seen), static_argnames="config", donate_argnums=0)
        none = jax.tree.map(lambda *x: jnp.stack(x), *[nothing_seen(impostor)] * devices)
        sums = jax.device_put(none, over_rays(mesh))
        shared, split = jax.device_put(impostor, replicated(mesh)), jax.device_put(batch, over_rays(mesh))
        for _ in range(2):
            sums = add(sums, shared, split, config=RENDER)
        assert np.all(np.asarray(sums.taken).sum(axis=1) > 0)  # each adds its own
        totals.append(jax.tree.map(lambda x: np.asarray(x).sum(axis=0), sums))
    for one, two in zip(*map(jax.tree.leaves, totals), strict=True):
        assert_allclose(two, one, rtol=1e-5, atol=1e-5 * np.abs(one).max())  # float32 terms in another order


def test_least_squares_finds_what_depends_on_the_direction(rng, monkeypatch):
    """Plenty of rays: the ridge holds back 2 % of the dependence (variance 1/20), the mean not at all."""
    truth = rng.normal(size=(5, 4, 2))
    basis = rng.dirichlet(np.ones(4), (5, 4000))
    values = np.einsum("nsk,nkc->nsc", basis, truth)
    moments = Moments(
        products=jnp.asarray(np.einsum("nsk,nsl->nkl", basis, basis)[:, *PAIRS]),
        sums=jnp.asarray(np.einsum("nsk,nsc->nkc", basis, values)),
        lost=jnp.int32(0),
    )
    found = solve_moments(moments, np.arange(5))
    monkeypatch.setattr("nimpostor_jax.train.bake.SOLVED", 2)
    assert_allclose(solve_moments(moments, np.arange(5)), found, rtol=1e-6)  # float32 is what is stored
    errors = np.einsum("nsk,nkc->nsc", basis, found - truth)
    assert np.sqrt(np.mean(errors**2)) < 0.04 * np.std(values)
    assert_allclose(errors.mean(axis=1), 0, atol=1e-3)


def test_texels_that_no_ray_has_seen_take_after_their_face():
    sums = np.zeros((3, 4, 1))
    products = np.zeros((3, 10))
    sums[0], products[0] = 25 * 0.25 * 0.8, 25 * 0.0625  # 25 rays, all through the middle: 0.8
    moments = Moments(products=jnp.asarray(products), sums=jnp.asarray(sums), lost=jnp.int32(0))
    found = solve_moments(moments, np.array([0, 0, 1]))
    assert_allclose(found[1], 0.8, atol=1e-3)  # the same face
    assert_allclose(found[2], 0, atol=1e-6)  # another face, unseen
