"""edit.remesh and what it is made of: what fits is kept, the rest is trained, nothing else changes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import MESHES, oriented
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from nimpostor_jax.config import RetrainConfig
from nimpostor_jax.edit import visibility
from nimpostor_jax.edit.boolean import gated, union
from nimpostor_jax.edit.deform import deform, rigid, stretch, twist
from nimpostor_jax.edit.probe import draw_points, occupancy_of
from nimpostor_jax.edit.region import Region, trained_part, with_region, with_trained_part
from nimpostor_jax.edit.remesh import consolidate, overlay, transfer
from nimpostor_jax.edit.retrain import fit_features
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.edit.teacher import pictures_of
from nimpostor_jax.edit.visibility import NewMesh, add_seen, seen_parts
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import to_cells
from nimpostor_jax.geometry.locate import locate_tables
from nimpostor_jax.geometry.tetrahedron import corners, signed_volumes
from nimpostor_jax.geometry.topology import build_in_frame, world_vertices
from nimpostor_jax.render.camera import image_pixels, pixel_rays, to_local
from nimpostor_jax.render.capacity import ray_entries
from nimpostor_jax.render.occupancy import cell_index, in_occupied_cells, num_cells
from nimpostor_jax.render.renderer import render_rays, render_samples
from nimpostor_jax.render.segments import march_segments
from nimpostor_jax.render.selection import optical_weights
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import build_pool, draw_batch
from nimpostor_jax.train.step import RayBatch
from nimpostor_jax.types import FunctionSolid

CONFIG = dataclasses.replace(
    scenes.exact(max_samples_per_ray=64, step=0.25),
    march=dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=48, max_entries_per_ray=6),
)
QUICK = RetrainConfig(
    feature_steps=20, points_per_batch=4096, render_steps=60, rays_per_batch=512, views=6, view_width=32
)
render = jax.jit(render_rays, static_argnames="config")


def picture(impostor):
    camera = scenes.camera(24, 18)
    rays = pixel_rays(camera, image_pixels(18, 24).reshape(-1, 2))
    output = render(impostor, rays, CONFIG)
    assert not output.overflow.any()
    return np.asarray(output.color + (1 - output.opacity)[:, None])


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2))


def quiet(_):
    pass


def one_vertex_moved(made):
    """The same cage, but for one inner vertex: the tets around it are other tets now."""
    vertices, tets = world_vertices(made.mesh), np.asarray(made.mesh.tets)
    chosen = np.bincount(tets.reshape(-1)).argmax()
    moved = vertices.copy()
    moved[chosen] += 0.04
    return moved, tets, np.any(tets == chosen, axis=1)


def test_a_local_change_leaves_all_other_tets_their_bits():
    made = scenes.impostor("delaunay")
    vertices, tets, touched = one_vertex_moved(made)
    config = dataclasses.replace(QUICK, max_lost_share=1.0, feature_steps=2, render_steps=2)
    new = transfer(made, vertices, tets, CONFIG, config, quiet)
    cells = np.asarray(new.embedding.cells)
    trained = cells >= len(made.mesh.tets)
    # A changed tet may lie within the one that was there before: then it needs no training.
    assert not np.any(trained & ~touched) and trained.sum() > 0.8 * touched.sum()
    assert_array_equal(cells[~touched], np.flatnonzero(~touched))
    # Tables: level by level the old entries come first. Decoders: the old set is the first.
    old_starts, new_starts = (np.asarray(x.tables.layout.starts) for x in (made, new))
    for level in range(len(old_starts) - 1):
        size = old_starts[level + 1] - old_starts[level]
        mine = new.tables.features[new_starts[level] : new_starts[level] + size]
        assert_array_equal(mine, made.tables.features[old_starts[level] : old_starts[level + 1]])
    for ours, theirs in zip(jax.tree.leaves(new.decoders), jax.tree.leaves(made.decoders), strict=True):
        assert_array_equal(ours[:1], theirs)
    assert not np.allclose(new.decoders["density"][0]["weight"][1], made.decoders["density"][0]["weight"][0])
    index = np.asarray(new.decoder_index)[cells]
    assert_array_equal(index, trained.astype(int))


def test_only_decoders_of_changed_tets_are_copied():
    """So that edit after edit adds sets, and does not double them."""
    made = scenes.impostor("delaunay")
    decoders = jax.tree.map(lambda x: jnp.concatenate([x, x + 1, x + 2]), made.decoders)
    cells = np.arange(len(made.mesh.tets))
    made = made.replace(decoders=decoders, decoder_index=jnp.asarray(cells % 3, jnp.int32))
    places = np.broadcast_to(np.eye(4), (len(cells), 4, 4))
    for changed, sets in ((cells % 3 == 1, [3]), (cells % 3 != 1, [3, 4]), (cells >= 0, [0, 1, 2])):
        new, region = with_region(made, made.mesh, np.where(changed, -1, cells), places, cells)
        assert_array_equal(region.decoder_sets, sets)
        placed = cells if new.embedding is None else np.asarray(new.embedding.cells)
        index = np.asarray(new.decoder_index)[placed]
        bias = [np.asarray(x.decoders["density"][0]["bias"]) for x in (made, new)]
        assert_array_equal(bias[1][index], bias[0][cells % 3])  # new sets begin as the old ones
        assert len(bias[1]) == (3 if len(sets) == 3 else 3 + len(sets))


def test_a_whole_new_cage_trains_all_entries_in_order():
    """Then rows are neither gathered nor scattered."""
    made = scenes.impostor("delaunay")
    cells, places = np.full(len(made.mesh.tets), -1), np.broadcast_to(np.eye(4), (len(made.mesh.tets), 4, 4))
    new, region = with_region(made, made.mesh, cells, places, np.zeros(len(cells), int))
    assert_array_equal(region.entries, np.arange(len(new.tables.features)))
    part = trained_part(new, region)
    taken = jax.jit(lambda part: jax.tree.map(lambda x: x + 1, part), donate_argnums=0)(part)
    assert part["features"].is_deleted() and not new.tables.features.is_deleted()
    assert_array_equal(with_trained_part(new, region, taken).tables.features, new.tables.features + 1)


def test_tables_start_near_the_old_features():
    """The same tets as new ones: levels without collisions can be met, and the other tets keep their bits."""
    made = scenes.impostor("delaunay")
    cells = np.arange(len(made.mesh.tets))
    changed = np.where(cells % 2, -1, cells)
    places = np.broadcast_to(np.eye(4), (len(cells), 4, 4))
    new, region = with_region(made, made.mesh, changed, places, cells)
    source, start, off = locate_tables(made.mesh), new, []
    draw = functools.partial(draw_points, count=1 << 13, measure="barycentric")
    for i in range(12):
        points = draw(jax.random.key(i), made, source, new, region)
        found = field.features(new, *to_cells(new.embedding, points.tets, points.lambdas))
        off.append(np.mean(np.square(found - points.features), axis=0))
        new = fit_features(new, points)
    levels = made.config.encoding.num_levels
    dense = np.asarray(new.tables.layout.rank_starts).size - 1
    first, last = (x.reshape(levels, -1).mean(axis=1) for x in (off[0], off[-1]))
    # 8e-4 of the squared error are left here; how fast it falls depends on where the points are.
    assert dense == levels and np.all(last < 0.02 * first), (first, last)
    same = np.delete(np.asarray(new.tables.features), region.entries, axis=0)
    assert_array_equal(same, np.delete(np.asarray(start.tables.features), region.entries, axis=0))


@pytest.mark.slow
def test_retraining_brings_the_picture_back():
    made = scenes.impostor("delaunay")
    vertices, tets, _ = one_vertex_moved(made)
    config = dataclasses.replace(QUICK, max_lost_share=1.0)
    untrained = dataclasses.replace(config, feature_steps=0, render_steps=0)
    features = dataclasses.replace(config, feature_steps=60, render_steps=0)
    target = picture(made)
    found = [
        psnr(picture(transfer(made, vertices, tets, CONFIG, c, quiet)), target)
        for c in (untrained, features, config)
    ]
    assert found[2] > found[0] + 2 and found[2] > 25, found
    assert found[1] > found[0] - 1, found


def test_cut_tets_go_on_in_the_old_field_exactly():
    """A new cage that only cuts old tets needs no training, whoever made it."""
    made = scenes.impostor("blobs")
    fine = subdivide(made)
    vertices, tets = world_vertices(fine.mesh), np.asarray(fine.mesh.tets)
    over = overlay(made, np.asarray(fine.mesh.vertices, np.float64), tets)
    assert_array_equal(over.tets, fine.embedding.cells)
    new = transfer(made, vertices, tets, CONFIG, QUICK, quiet)
    assert new.tables.features.shape == made.tables.features.shape
    assert_allclose(picture(new), picture(made), atol=1e-4)


def test_vertices_that_stay_come_to_rest_where_they_were():
    """Whatever tets they belong to now, which the tets around them do not share."""
    made = deform(scenes.impostor("delaunay"), twist(0.3))
    vertices = world_vertices(made.mesh)
    inner = vertices[np.asarray(made.mesh.tets[:3])].mean(axis=1)
    vertices = np.concatenate([vertices, inner])
    _, tets = oriented(vertices, Delaunay(vertices).simplices)
    config = dataclasses.replace(QUICK, max_lost_share=1.0, feature_steps=0, render_steps=0)
    new = transfer(made, vertices, tets, CONFIG, config, quiet)
    old_cells = np.asarray(new.embedding.cells) < len(made.mesh.tets)
    assert 0 < old_cells.sum() < len(tets)  # some tets stay, and some do not
    assert_array_equal(new.rest_vertices[:-3], made.rest_vertices)
    # the new ones: the middles of tets stay their middles
    rest = np.asarray(made.rest_vertices)[np.asarray(made.mesh.tets[:3])].mean(axis=1)
    assert_allclose(new.rest_vertices[-3:], rest, atol=1e-5)


def test_a_moved_cage_is_remeshed_where_it_stands():
    turn = Rotation.from_rotvec([0.3, 0.8, -0.2]).as_matrix()
    made = deform(scenes.impostor("delaunay"), rigid(turn, np.zeros(3)))
    vertices, tets, _ = one_vertex_moved(made)
    config = dataclasses.replace(QUICK, max_lost_share=1.0, feature_steps=0, render_steps=0)
    new = transfer(made, vertices, tets, CONFIG, config, quiet)
    kept = np.all(np.abs(world_vertices(made.mesh) - vertices) < 1e-9, axis=1)
    assert_allclose(new.rest_vertices[kept], made.rest_vertices[kept], atol=1e-5)
    assert np.isfinite(new.rest_vertices).all()
    again = deform(new, stretch(0.1, 1.0))
    assert np.isfinite(picture(again)).all()


@pytest.mark.slow
def test_consolidating_a_difference():
    made = scenes.impostor("delaunay")
    center = world_vertices(made.mesh).mean(axis=0).astype(np.float32)
    ball = FunctionSolid(lambda x: 0.9**2 - jnp.sum((x - center) ** 2, axis=-1))
    live = gated(made, ball, keep_inside=False)
    plain = consolidate(live, CONFIG, dataclasses.replace(QUICK, render_steps=150), quiet)
    assert not plain.gates
    before, after = (psnr(picture(x), picture(live)) for x in (made, plain))
    assert after > before + 3 and after > 24, (before, after)


@pytest.mark.slow
def test_consolidating_overlapping_objects():
    """Of a point in two tets, each object's own field is learned."""
    first, second = scenes.impostor("cube", seed=1), scenes.impostor("cube", seed=2)
    corner = FunctionSolid(lambda x: 0.5 - x[:, 0])
    live = union(gated(first, corner, keep_inside=True), second)
    plain = consolidate(live, CONFIG, dataclasses.replace(QUICK, render_steps=100), quiet)
    assert_array_equal(np.unique(plain.mesh.object_ids), [0, 1])
    assert psnr(picture(plain), picture(live)) > 22


def test_a_part_taken_out_and_put_back_changes_nothing():
    made = scenes.impostor("delaunay")
    vertices, tets, _ = one_vertex_moved(made)
    config = dataclasses.replace(QUICK, max_lost_share=1.0, feature_steps=0, render_steps=0)
    new = transfer(made, vertices, tets, CONFIG, config, quiet)
    region = Region(tets=jnp.arange(2), entries=jnp.array([3, 5, 8]), decoder_sets=jnp.array([1]))
    same = with_trained_part(new, region, trained_part(new, region))
    for ours, theirs in zip(jax.tree.leaves(same), jax.tree.leaves(new), strict=True):
        assert_array_equal(ours, theirs)


@pytest.mark.parametrize("known", [False, True])
def test_new_cells_are_occupied_where_the_old_ones_were(known):
    """Every part, whether the place of a point in the old mesh is known or has to be found."""
    made = scenes.impostor("cube")
    count = len(made.mesh.tets)
    occupied = np.random.default_rng(0).uniform(size=(count, num_cells(4))) < 0.3
    made = dataclasses.replace(made, occupied=jnp.asarray(occupied))
    eye = np.broadcast_to(np.eye(4), (count, 4, 4))
    new, region = with_region(made, made.mesh, np.full(count, -1), eye, np.arange(count))
    if known:
        region = dataclasses.replace(region, sources=jnp.arange(count))
    found = np.asarray(occupancy_of(made, locate_tables(made.mesh), new, region, QUICK))
    assert np.all(found[occupied])  # 16 points each: none is overlooked
    assert np.mean(found != occupied) < 0.01  # points on the side of a part, by rounding
    points = draw_points(
        jax.random.key(0),
        made,
        locate_tables(made.mesh),
        dataclasses.replace(new, occupied=jnp.asarray(found)),
        region,
        count=2000,
        measure="barycentric",
    )
    inside = in_occupied_cells(jnp.asarray(found), points.tets, points.lambdas)
    # 0.3 of the parts, ten times as often as others of the same volume: 0.81
    assert 0.7 < np.mean(inside) < 0.9


def test_bad_input():
    made = scenes.impostor("cube")
    vertices, tets = MESHES["cube"]()
    with pytest.raises(ValueError, match="does not overlap"):
        transfer(made, vertices + 10, tets, CONFIG, QUICK, quiet)
    with pytest.raises(ValueError, match=r"lies outside the new cage, more than .*max_lost_share"):
        transfer(made, 0.8 * vertices, tets, CONFIG, QUICK, quiet)
    with pytest.raises(ValueError, match="inverted or flat"):
        transfer(made, vertices, np.asarray(tets)[:, [1, 0, 2, 3]], CONFIG, QUICK, quiet)
    live = gated(made, FunctionSolid(lambda x: x[:, 0] - 50), keep_inside=True)
    with pytest.raises(ValueError, match="consolidate live"):
        transfer(live, vertices, tets, CONFIG, QUICK, quiet)
    with pytest.raises(ValueError, match="hides everything"):
        consolidate(live, CONFIG, QUICK, quiet)


@jax.jit
def weights_of(made, rays):
    output, samples = render_samples(made, rays, CONFIG)
    features = field.features(made, samples.tet_ids, samples.lambdas)
    return output, samples, optical_weights(field.density(made, samples.tet_ids, features), samples)


def weights_by_part(made, rays, parts):
    """The weights of samples in the tets and parts where they lie, by a loop of NumPy's, and their sum."""
    output, samples, weights = weights_of(made, rays)
    found = np.zeros((len(made.mesh.tets), parts))
    places = np.asarray(cell_index(jnp.zeros_like(samples.tet_ids), samples.lambdas, parts))
    np.add.at(found, (np.asarray(samples.tet_ids), places), np.asarray(weights))
    assert_allclose(found.sum(), np.sum(output.opacity), rtol=1e-5)
    return found


@pytest.mark.parametrize("overlapping", [False, True])
def test_what_is_seen_adds_up_in_the_parts(overlapping):
    """Tets in another order, or overlapping ones whose places are known; some of them in the region."""
    made, parts = scenes.impostor("blobs" if overlapping else "delaunay"), num_cells(3)
    made = scenes.pushed_together(made) if overlapping else made
    count = len(made.mesh.tets)
    order = np.random.default_rng(0).permutation(count)
    mesh = build_in_frame(made.mesh, np.asarray(made.mesh.vertices), np.asarray(made.mesh.tets)[order])
    rays = pixel_rays(scenes.camera(16, 16), image_pixels(16, 16).reshape(-1, 2))
    expected = weights_by_part(made, rays, parts)
    inside = np.arange(count) % 3 > 0
    rows = np.full(count, inside.sum())
    rows[inside] = np.arange(inside.sum())
    target = None if overlapping else NewMesh(mesh, locate_tables(mesh))
    expected = (expected if overlapping else expected[order])[inside]
    batch = RayBatch(rays=rays, target=None, background=None, jitter=None)
    add = jax.jit(add_seen, static_argnames="config")
    found = add(jnp.zeros_like(expected), made, target, jnp.asarray(rows), batch, config=CONFIG)
    # a sample within rounding of a part's side may count on the other
    off = np.abs(found - expected)
    assert np.sum(off) < 0.01 * np.sum(expected) and np.median(off) < 1e-6


@pytest.mark.parametrize("known", [False, True])
def test_points_follow_what_is_seen(monkeypatch, known):
    """From the pool's rays, on all devices, to the parts in which points are drawn."""
    monkeypatch.setattr(visibility, "RAYS", 2048)
    made, parts = scenes.impostor("delaunay"), num_cells(2)
    count = len(made.mesh.tets)
    made = dataclasses.replace(made, occupied=jnp.ones((count, parts), bool))
    eye = np.broadcast_to(np.eye(4), (count, 4, 4))
    new, region = with_region(made, made.mesh, np.full(count, -1), eye, np.arange(count))
    if known:
        region = dataclasses.replace(region, sources=jnp.arange(count))
    pool = pictures_of(made, new, region, CONFIG, QUICK)
    seen = seen_parts(made, new, region, pool, CONFIG, QUICK)
    rays = [draw_batch(jax.random.key(QUICK.seed + 3), i, pool, 512, "random").rays for i in range(4)]
    expected = weights_by_part(made, jax.tree.map(lambda *x: jnp.concatenate(x), *rays), parts)
    # with jitter or without, the same rays see the same tets: but for where steps begin
    assert_allclose(np.sum(seen, axis=1), expected.sum(axis=1), atol=0.02 * expected.sum())
    assert_allclose(np.sum(seen), expected.sum(), rtol=0.02)
    region, draws = dataclasses.replace(region, seen=seen), 50_000
    points = draw_points(
        jax.random.key(0), made, locate_tables(made.mesh), new, region, count=draws, measure="barycentric"
    )
    drawn = np.bincount(cell_index(points.tets, points.lambdas, parts), minlength=seen.size) / draws
    volumes = np.asarray(signed_volumes(corners(made.mesh.vertices, made.mesh.tets)))
    even = np.repeat(volumes / volumes.sum() / parts, parts)
    target = 0.8 * np.ravel(seen) / np.sum(seen) + 0.2 * even
    assert_allclose(drawn, target, atol=0.005)  # three standard deviations of 50,000 draws


def test_pictures_show_a_region_by_the_rays_that_cross_it():
    """A part of a cage with gaps: rays know where they enter the whole of it."""
    made = scenes.impostor("nonconvex")
    region = Region(tets=jnp.arange(6), entries=jnp.arange(0), decoder_sets=jnp.arange(0))
    pool = pictures_of(made, made, region, CONFIG, QUICK)
    whole, _ = build_pool(made.mesh, pool.cameras, np.zeros((6, 32, 32, 4), np.float32), CONFIG.march)
    batch = draw_batch(jax.random.key(0), 0, pool, 256, "white")
    march = dataclasses.replace(CONFIG.march, max_entries_per_ray=pool.entries.slots)
    tables = march_tables(made.mesh)
    jax.tree.map(assert_array_equal, batch.entries, ray_entries(made.mesh, tables, batch.rays, march))
    segments = march_segments(made.mesh, to_local(made.mesh, batch.rays), CONFIG)
    crossed = np.unique(np.asarray(segments.rays)[np.isin(segments.tet_ids, np.arange(6))])
    assert_array_equal(crossed, np.arange(256))
    assert 0 < len(pool.views) < 0.9 * len(whole.views)


@pytest.mark.parametrize("seen", [None, 0.0])
def test_points_are_spread_evenly_where_nothing_is_seen(seen):
    made = scenes.impostor("cube")
    count = len(made.mesh.tets)
    made = dataclasses.replace(made, occupied=jnp.ones((count, num_cells(2)), bool))
    region = Region(tets=jnp.arange(count), entries=jnp.arange(0), decoder_sets=jnp.arange(0))
    if seen is not None:
        region = dataclasses.replace(region, seen=jnp.full((count, num_cells(2)), seen))
    points = draw_points(
        jax.random.key(0), made, locate_tables(made.mesh), made, region, count=20_000, measure="barycentric"
    )
    share = np.bincount(np.asarray(points.tets), minlength=count) / 20_000
    volumes = np.asarray(signed_volumes(corners(made.mesh.vertices, made.mesh.tets)))
    assert_allclose(share, volumes / volumes.sum(), atol=0.011)  # three standard deviations
