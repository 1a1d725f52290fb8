"""train.refine: training of face textures on whole pictures, from the texels that a batch looks up."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes_baked
from meshes import local_vertices
from numpy.testing import assert_allclose, assert_array_equal
from rays import as_rays, generic
from scenes import RENDER, pushed_together

from nimpostor_jax import chunks
from nimpostor_jax.encoding.face_grid import texels_around
from nimpostor_jax.render.baked import render_baked_rays
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.composite import blend_background
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.train.refine import (
    TABLES,
    count_lit,
    init_refinement,
    looked_up,
    refine_step,
    with_tables,
)
from nimpostor_jax.train.step import B1, B2, EPSILON, RayBatch

COUNT = 32
MARCH = dataclasses.replace(RENDER.march, max_tets_per_ray=24, max_entries_per_ray=3)
CONFIG = dataclasses.replace(RENDER, march=MARCH, min_weight=1e-3)
step = jax.jit(partial(refine_step, config=CONFIG))


def batch_for(baked, rng):
    origins, directions = generic(*local_vertices(baked.mesh), rng, COUNT)
    center, scale = np.asarray(baked.mesh.center), float(baked.mesh.scale)
    rays = as_rays((center + scale * origins, directions), baked.mesh.vertices.dtype)
    target = jnp.full((COUNT, 4), 0.5).at[:, :3].set(jnp.asarray([0.4, 0.1, 0.2]))
    return RayBatch(rays=rays, target=target, background=jnp.zeros((COUNT, 3)), jitter=jnp.zeros(COUNT))


def test_refinement_lowers_the_loss_and_leaves_decoders_alone_at_rate_zero(rng):
    baked = scenes_baked.baked(num_sets=2)
    batch, state, losses = batch_for(baked, rng), init_refinement(baked), []
    for _ in range(60):
        state, (loss, lost) = step(state, baked, batch, jnp.float32(0.02), jnp.float32(0))
        losses.append(float(loss))
        assert lost == 0
    assert losses[-1] < 0.2 * losses[0]
    jax.tree.map(assert_array_equal, state.decoders, baked.decoders)
    for name in TABLES:
        assert np.any(state.tables[name] != getattr(baked, name).features)


@pytest.mark.parametrize(("overlapping", "num_sets"), [(False, 2), (True, 1)])
def test_a_step_is_that_of_all_texels(overlapping, num_sets, rng, monkeypatch, x64):
    """The first step of Adam, and its moments, by the gradient of the whole tables; in small chunks."""
    monkeypatch.setattr(chunks, "CPU_CHUNK", 64)
    baked = scenes_baked.baked(dtype="float64", num_sets=num_sets)
    baked = pushed_together(baked) if overlapping else baked
    batch = batch_for(baked, rng)

    def loss(tables, decoders):
        whole = dataclasses.replace(with_tables(baked, tables), decoders=decoders)
        output = render_baked_rays(whole, batch.rays, CONFIG)
        color = blend_background(output.color, output.opacity, batch.background)
        target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
        return photometric(color, target, output.overflow)

    start = init_refinement(baked)
    value, gradients = jax.jit(jax.value_and_grad(loss, argnums=(0, 1)))(start.tables, start.decoders)
    one_step = jax.jit(partial(refine_step, config=CONFIG))
    state, found = one_step(start, baked, batch, jnp.asarray(0.02), jnp.asarray(0.01))
    assert_allclose(found[0], value, rtol=1e-12)
    before, after = (start.tables, start.decoders), (state.tables, state.decoders)
    for rate, g, old, new in zip((0.02, 0.01), gradients, before, after, strict=True):
        moved = jax.tree.map(lambda g, old, rate=rate: old - rate * g / (abs(g) + EPSILON), g, old)
        # where gradients are as small as Adam's epsilon, their own rounding is divided by it
        jax.tree.map(partial(assert_allclose, atol=1e-8), new, moved)
    # sums of float64 terms in another order
    close = partial(assert_allclose, rtol=1e-9, atol=1e-15)
    for name in TABLES:
        close(state.moments[name].first, (1 - B1) * gradients[0][name])
        close(state.moments[name].second, (1 - B2) * gradients[0][name] ** 2)
    of_decoders = jax.tree.map(lambda g: (1 - B1) * g, gradients[1])
    jax.tree.map(close, state.decoder_moments.mu, of_decoders)
    assert 0.01 < np.mean(np.any(gradients[0]["textures"] != 0, axis=1)) < 0.95


def test_each_texel_that_is_looked_up_is_there_once(rng, monkeypatch):
    monkeypatch.setattr(chunks, "CPU_CHUNK", 64)
    baked = scenes_baked.baked()
    batch = batch_for(baked, rng)
    march = jax.jit(lambda rays: march_segments(baked.mesh, to_local(baked.mesh, rays), CONFIG))
    segments = march(batch.rays)
    tets, last = jnp.maximum(segments.tet_ids, 0), np.flatnonzero(segments.tet_ids >= 0)[-1] + 1
    arguments = baked.depths.layout, len(baked.depths.features), tets, segments.lambda_enter, jnp.int32(last)
    rows, layout, count = jax.jit(looked_up, static_argnums=1)(*arguments)
    texels = texels_around(baked.depths.layout, tets, segments.lambda_enter)[1]
    found = np.asarray(rows)[: int(count)]
    assert len(np.unique(found)) == len(found)
    # The chunk in which the used points end is looked up as a whole, but only they count.
    assert set(np.stack(texels, axis=1)[:last].ravel()) == set(found)
    assert_array_equal(np.asarray(layout.rows)[found], np.arange(len(found)))
    assert np.all((np.asarray(layout.rows) >= 0) & (np.asarray(layout.rows) < rows.size))
    assert 0 < len(found) < len(baked.depths.features)


def test_rays_whose_segments_do_not_fit_are_left_out(rng):
    baked = scenes_baked.baked()
    batch, rates = batch_for(baked, rng), (jnp.float32(0.02), jnp.float32(0))
    lit = int(jax.jit(partial(count_lit, config=CONFIG))(baked, batch))
    enough = -(-lit // COUNT)
    found = {None: step(init_refinement(baked), baked, batch, *rates)}
    for room in (1, enough):
        one_step = jax.jit(partial(refine_step, config=CONFIG, lit_per_ray=room))
        found[room] = one_step(init_refinement(baked), baked, batch, *rates)
    assert enough > 1 and found[enough][1][1] == 0
    # one buffer or the other: the same sums
    close = partial(assert_allclose, rtol=1e-4, atol=1e-6)
    jax.tree.map(close, found[enough][0].tables, found[None][0].tables)
    assert 0.1 < found[1][1][1] < 1
    # The last rays are those that are left out: as if they saw nothing, and were meant to.
    left_out = (np.arange(COUNT) >= round(COUNT * (1 - float(found[1][1][1]))))[:, None]
    away = {"origins": batch.rays.origins + 1e3, "directions": jnp.ones((COUNT, 3))}
    rays = batch.rays.replace(**{k: jnp.where(left_out, v, getattr(batch.rays, k)) for k, v in away.items()})
    target = jnp.where(left_out, 0, batch.target)
    alone = step(init_refinement(baked), baked, batch.replace(rays=rays, target=target), *rates)
    assert_allclose(found[1][1][0], alone[1][0], rtol=1e-5)  # a mean over all rays


def test_a_step_needs_memory_for_a_batch_and_one_number_a_texel(rng):
    """Beside the tables, which it may consume: no gradient of all texels."""
    sizes, texels = [], []
    for finest in (8, 80):
        baked = scenes_baked.baked(finest=finest)
        state, rate = init_refinement(baked), jnp.float32(0.02)
        lowered = jax.jit(partial(refine_step, config=CONFIG), donate_argnums=0).lower(
            state, baked, batch_for(baked, rng), rate, rate
        )
        sizes.append(lowered.compile().memory_analysis().temp_size_in_bytes)
        texels.append(len(baked.depths.features))
    assert texels[1] > 50 * texels[0]
    # The number of each texel, and its copy where loops that write it begin.
    assert sizes[1] - sizes[0] < 3 * 4 * (texels[1] - texels[0])
