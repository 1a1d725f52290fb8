"""render.occupancy: cells of tets, and what the renderer and training leave out by them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import local_vertices
from numpy.testing import assert_array_equal
from rays import as_rays, generic
from scenes import RENDER

from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.occupancy import (
    cell_index,
    cell_resolution,
    cells_of,
    finer_cells,
    in_occupied_cells,
    num_cells,
    random_points,
)
from nimpostor_jax.render.renderer import render_rays, render_samples
from nimpostor_jax.render.sampling import place_samples, plan_samples
from nimpostor_jax.render.segments import in_cells, march_segments
from nimpostor_jax.render.selection import present_samples, slabs_of

COUNT = 32
render = jax.jit(render_rays, static_argnames="config")


def view(impostor, jitter=False):
    """World rays towards the mesh, and their jitter."""
    origins, directions = generic(*local_vertices(impostor.mesh), np.random.default_rng(1), COUNT)
    rays = as_rays((np.asarray(impostor.mesh.center) + float(impostor.mesh.scale) * origins, directions))
    return rays, jnp.linspace(0, 0.99, COUNT) if jitter else None


@pytest.mark.parametrize("resolution", [1, 2, 3, 16])
def test_cells_are_numbered_without_gaps(resolution):
    parts = np.stack(np.meshgrid(*[np.arange(resolution)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    parts = parts[parts.sum(axis=1) < resolution]
    first = (parts + 0.2 / 3) / resolution
    lambdas = jnp.asarray(np.column_stack([first, 1 - first.sum(axis=1)]), jnp.float32)
    cells = num_cells(resolution)
    assert cell_resolution(cells) == resolution
    assert len(parts) == cells
    index = cell_index(jnp.full(cells, 2), lambdas, cells)
    assert_array_equal(np.sort(index), 2 * cells + np.arange(cells))


def test_every_point_of_a_tet_has_a_cell(rng):
    lambdas = np.concatenate([rng.dirichlet(np.full(4, 0.2), 2000), np.eye(4), [[0.5, 0.5, 0, 0]]])
    lambdas = jnp.asarray(lambdas + rng.normal(scale=1e-7, size=lambdas.shape), jnp.float32)
    index = np.asarray(cell_index(jnp.zeros(len(lambdas), jnp.int32), lambdas, num_cells(8)))
    assert index.min() >= 0
    assert index.max() < num_cells(8)


def test_a_number_of_cells_that_no_grid_has_is_refused():
    with pytest.raises(ValueError, match="no resolution has 5 cells"):
        cell_resolution(5)


def test_marked_cells_are_those_of_the_used_points(rng):
    lambdas = jnp.asarray(rng.dirichlet(np.ones(4), 50), jnp.float32)
    tets, used = jnp.asarray(rng.integers(0, 3, 50)), jnp.arange(50) < 20
    marked = cells_of(tets, lambdas, used, 3, num_cells(4))
    assert np.all(in_occupied_cells(marked, tets, lambdas)[:20])
    assert 0 < np.sum(marked) <= 20


def test_nothing_changes_where_all_cells_are_occupied():
    impostor = scenes.impostor("blobs")
    full = dataclasses.replace(impostor, occupied=jnp.ones((len(impostor.mesh.tets), num_cells(4)), bool))
    rays, jitter = view(impostor, jitter=True)
    config = dataclasses.replace(RENDER, min_weight=1e-3)
    outputs = [jax.tree.leaves(render(each, rays, config, jitter)) for each in (impostor, full)]
    for a, b in zip(*outputs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)  # sums over rows that begin elsewhere


def test_only_samples_in_occupied_cells_are_rendered():
    """The cells that one pass saw are enough for the next; without any, nothing is seen."""
    impostor = scenes.impostor("blobs")
    shape = len(impostor.mesh.tets), num_cells(4)
    config = dataclasses.replace(RENDER, min_weight=1e-3)
    rays, _ = view(impostor)
    output, samples = jax.jit(render_samples, static_argnames="config")(impostor, rays, config)
    seen = cells_of(samples.tet_ids, samples.lambdas, samples.deltas > 0, *shape)
    assert 0 < np.mean(seen) < 1
    again = render(dataclasses.replace(impostor, occupied=seen), rays, config)
    # What is left out contributed less than min_weight a sample; 16 samples a ray.
    np.testing.assert_allclose(again.color, output.color, atol=16 * config.min_weight)
    empty = dataclasses.replace(impostor, occupied=jnp.zeros(shape, bool))
    assert_array_equal(render(empty, rays, config).opacity, 0)
    kept = render(empty, rays, dataclasses.replace(config, skip_empty=False))
    np.testing.assert_allclose(kept.color, output.color, atol=1e-5)  # other programs, fused otherwise


@pytest.mark.parametrize("finer", [False, True])
@pytest.mark.parametrize("measure, cone", [("barycentric", 0.0), ("alpha", 0.0), ("euclidean", 0.05)])
def test_slabs_leave_out_only_what_cells_would(measure, cone, finer, rng):
    """The same samples in the end, of fewer that were planned; tets are empty, full, or hold a few cells.

    Also where the mesh is finer than the field whose cells these are.
    """
    impostor = scenes.impostor("blobs")
    num_tets, step = len(impostor.mesh.tets), 0.02 if measure == "euclidean" else 0.05
    share = rng.choice([0, 0.01, 0.1, 1], (num_tets, 1))
    occupied = jnp.asarray(rng.uniform(size=(num_tets, num_cells(8))) < share)
    impostor = dataclasses.replace(impostor, occupied=occupied)
    impostor = subdivide(impostor) if finer else impostor
    sampler = dataclasses.replace(RENDER.sampler, measure=measure, step=step, cone_angle=cone)
    sampler = dataclasses.replace(sampler, max_samples_per_ray=256)
    config = dataclasses.replace(RENDER, sampler=sampler, min_weight=0.0)
    rays, _ = view(impostor)
    mesh = impostor.mesh
    segments = jax.jit(lambda rays: march_segments(mesh, to_local(mesh, rays), config))(rays)

    @jax.jit
    def sample(slabs):
        plan = plan_samples(in_cells(segments, impostor.embedding), sampler, measure, slabs=slabs)
        _, chosen, count = present_samples(impostor, plan, config)
        return place_samples(plan, chosen, count), count, plan.num_used

    slabs, kept, planned = slabs_of(impostor, config), [], []
    for those in (None, slabs):
        samples, count, all_of_them = sample(those)
        kept.append([np.asarray(x)[: int(count)] for x in (samples.rays, samples.tet_ids, samples.t)])
        planned.append(int(all_of_them))
    for expected, found in zip(*kept, strict=True):
        assert_array_equal(found, expected)
    assert len(kept[0][0]) <= planned[1] < planned[0]
    assert len(kept[0][0]) > COUNT  # most rays see something
    assert slabs_of(impostor, dataclasses.replace(config, skip_empty=False)) is None


def test_with_jitter_some_rays_look_into_empty_cells():
    impostor = scenes.impostor("blobs")
    empty = jnp.zeros((len(impostor.mesh.tets), num_cells(2)), bool)
    rays, _ = view(impostor)
    blind, rng, seeing = dataclasses.replace(impostor, occupied=empty), np.random.default_rng(0), 0
    for _ in range(20):
        jitter = jnp.asarray(rng.uniform(size=COUNT), jnp.float32)
        seeing += int(np.sum(render(blind, rays, RENDER, jitter).opacity > 0))
    assert 0.02 < seeing / (20 * COUNT) < 0.12  # a sixteenth of 640: 0.0625 with 0.0096 standard deviation


def test_random_points_lie_in_their_cells():
    cells = num_cells(5)
    wanted = jnp.asarray(np.tile(np.arange(3 * cells), 4), jnp.int32)
    tets, lambdas = random_points(jax.random.key(0), wanted, cells)
    assert_array_equal(cell_index(tets, lambdas, cells), wanted)
    np.testing.assert_allclose(np.sum(lambdas, axis=1), 1, atol=1e-6)
    assert np.min(lambdas) >= 0


@pytest.mark.parametrize("coarse, fine", [(4, 8), (4, 4), (2, 6), (3, 4)])
def test_finer_cells_are_as_the_ones_around_them(coarse, fine, rng):
    occupied = jnp.asarray(rng.uniform(size=(3, num_cells(coarse))) < 0.5)
    lambdas = jnp.asarray(rng.dirichlet(np.ones(4), 3000), jnp.float32)
    tets = jnp.asarray(rng.integers(0, 3, 3000), jnp.int32)
    before = np.asarray(in_occupied_cells(occupied, tets, lambdas))
    after = np.asarray(in_occupied_cells(finer_cells(occupied, num_cells(fine)), tets, lambdas))
    assert np.all(after[before])  # nothing that was seen is lost
    # A cell beside the face lambda_3 = 0 stands for the corner that the face cuts off.
    assert np.mean(after != before) < 0.02 if fine % coarse == 0 else after.all()
