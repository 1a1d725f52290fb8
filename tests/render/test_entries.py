"""Entries and walks where faces have no area, tets are inverted, tests are close, or there are many faces."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from meshes import grid, local_vertices, tet_mesh
from numpy.testing import assert_allclose, assert_array_equal
from rays import DEGENERATE, GENERIC, as_rays, by_ray, unit

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry.tetrahedron import num_inverted
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.render import capacity, entries
from nimpostor_jax.render import traverse as traversal
from nimpostor_jax.render.camera import to_local
from nimpostor_jax.render.entries import mended
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import find_entries, march_tables, traverse

CONFIG = MarchConfig(max_tets_per_ray=40, max_entries_per_ray=4, tile_size=64)
COUNT = 32


@jax.jit
def walk(mesh, rays):
    return by_ray(locate_segments(mesh, rays, traverse(march_tables(mesh), rays, CONFIG)))


@pytest.mark.parametrize(("culled", "flagged"), [(0, 0), (20, 1 << 13)], ids=["rays", "tiles and rays"])
@pytest.mark.parametrize("name", ["nonconvex", "blobs"])
def test_a_tree_finds_the_entries_that_a_tile_finds(name, culled, flagged, rng, monkeypatch):
    mesh = tet_mesh(name)
    kinds = [make(*local_vertices(mesh), rng, COUNT) for make in (GENERIC | DEGENERATE).values()]
    origins, directions = (np.concatenate(parts) for parts in zip(*kinds, strict=True))
    # Neighbours, too: their tile has 13 or 16 clusters before it, and the others nearly all.
    tile = CONFIG.tile_size
    beside = origins[:1] + 0.01 * rng.normal(size=(tile, 3)), np.repeat(directions[:1], tile, axis=0)
    rays = as_rays((np.concatenate([beside[0], origins]), np.concatenate([beside[1], directions])))
    expected = jax.jit(traverse, static_argnums=2)(march_tables(mesh), rays, CONFIG)
    monkeypatch.setattr(entries, "MAX_CULLED", culled)
    monkeypatch.setattr(entries, "MAX_FLAGGED", flagged)
    jax.clear_caches()  # the limits are read while tracing
    found = jax.jit(traverse, static_argnums=2)(march_tables(mesh), rays, CONFIG)
    jax.clear_caches()
    assert_array_equal(found.codes, expected.codes)
    assert not found.overflow.any()


def test_a_collapsed_cage_seen_along_a_flattened_face_is_not_entered_there():
    """Faces without area project to a point along their line: no side of them is left or right."""
    vertices, tets = grid(np.ones((2, 2, 3), bool))
    mesh = build_tet_mesh(vertices, tets)
    moved = np.asarray(mesh.vertices).copy()
    layers = np.unique(moved[:, 2])
    moved[moved[:, 2] == layers[2], 2] = layers[1]
    flat = mesh.replace(vertices=jnp.asarray(moved))
    origins = moved[moved[:, 2] == layers[1]] - np.array([0, 3, 0])
    rays = (origins, np.broadcast_to([0.0, 1.0, 0.0], origins.shape))
    segments = walk(flat, as_rays(rays))
    assert not np.any(segments.overflow)
    lengths = np.sum(np.asarray(segments.t_exit - segments.t_enter), axis=1)
    side = np.ptp(moved[:, 1])
    through = np.abs(lengths - side) < 1e-5
    assert np.all((lengths < 1e-5) | through) and np.any(through)


def test_a_fold_covers_the_line_once(rng):
    """An inner vertex beyond its neighbours: the walk goes there, back, and on; no part counts twice."""
    vertices, tets = grid(np.ones((2, 2, 2), bool))
    mesh = build_tet_mesh(vertices, tets)
    moved = np.asarray(mesh.vertices).copy()
    middle = np.argmin(np.sum(moved**2, axis=1))
    moved[middle] = np.max(moved) * np.array([1.5, 0.05, 0.02])
    folded = mesh.replace(vertices=jnp.asarray(moved))
    assert num_inverted(folded.vertices, folded.tets) > 0
    y, z = rng.uniform(-0.3, 0.3, (2, 64))
    rays = (np.stack([np.full(64, -3.0), y, z], axis=1), np.broadcast_to([1.0, 0.0, 0.0], (64, 3)))
    segments = walk(folded, as_rays(rays))
    size = np.ptp(np.asarray(mesh.vertices)[:, 0])
    for ray in range(64):
        used = np.asarray(segments.tet_ids[ray]) >= 0
        enters, exits = (np.asarray(t[ray])[used] for t in (segments.t_enter, segments.t_exit))
        assert np.all(np.abs(enters[1:] - exits[:-1]) < 1e-6)
        assert np.sum(exits - enters) > size - 1e-5  # the box, and what sticks out of it


def test_what_a_fold_has_covered_moves_with_the_vertices(rng, x64):
    """Where a walk passes a part of the line again, its segments begin at an end of an earlier one."""
    mesh = build_tet_mesh(*grid(np.ones((2, 2, 2), bool)), dtype="float64")
    middle = np.argmin(np.sum(np.asarray(mesh.vertices) ** 2, axis=1))
    beyond = np.max(np.asarray(mesh.vertices)) * np.array([1.5, 0.05, 0.02])
    folded = mesh.replace(vertices=mesh.vertices.at[middle].set(jnp.asarray(beyond)))
    y, z = rng.uniform(-0.3, 0.3, (2, 16))
    rays = (np.stack([np.full(16, -3.0), y, z], axis=1), np.broadcast_to([1.0, 0.0, 0.0], (16, 3)))
    mix = jnp.asarray(rng.normal(size=(16, CONFIG.max_tets_per_ray)))

    @jax.jit
    def starts(shift):
        segments = walk(folded.replace(vertices=folded.vertices + shift), as_rays(rays, "float64"))
        return jnp.sum(jnp.where(segments.tet_ids >= 0, mix * segments.t_enter, 0))

    x = jnp.zeros(mesh.vertices.shape)
    gradient = jax.jit(jax.grad(starts))(x)
    for _ in range(4):
        direction = jnp.asarray(rng.normal(size=x.shape))
        expected = oracles.directional_difference(starts, x, direction, 1e-6)
        # step^2 times third derivatives, which grow where a ray meets a face at a grazing angle
        assert_allclose(jnp.sum(gradient * direction), expected, rtol=1e-6)


@pytest.mark.parametrize("reach", [1.5, 2.2])
def test_what_a_fold_covers_is_out_of_order_with_what_it_reaches(reach):
    """A walk that ends on its way back has been where the next one, in another body, begins."""
    vertices, tets = grid(np.ones((2, 2, 2), bool))
    other, other_tets = grid(np.ones((1, 1, 1), bool))
    both = np.concatenate([vertices - 1, 2 * other + [1.05, -1, -1]])
    mesh = build_tet_mesh(both, np.concatenate([tets, other_tets + len(vertices)]))
    middle = np.argmin(np.sum(np.asarray(both) ** 2, axis=1))
    target = (np.array([reach, 0.03, 0.02]) - np.asarray(mesh.center)) / float(mesh.scale)
    folded = mesh.replace(vertices=mesh.vertices.at[middle].set(jnp.asarray(target, jnp.float32)))
    y, z = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 256))
    rays = (np.stack([np.full(256, -3.0), y, z], axis=1), np.broadcast_to([1.0, 0.0, 0.0], (256, 3)))
    segments = walk(folded, as_rays(rays))
    used = np.asarray(segments.tet_ids) >= 0
    furthest = np.maximum.accumulate(np.where(used, segments.t_exit, -np.inf), axis=1)
    overlap = np.any(used[:, 1:] & (segments.t_enter[:, 1:] < furthest[:, :-1] - 1e-3), axis=1)
    assert overlap.sum() > 20
    assert np.all(np.asarray(segments.disordered)[overlap])


def test_a_ray_that_is_no_number_leaves_its_neighbours_alone(rng):
    mesh = tet_mesh("cube")
    origins, directions = GENERIC["generic"](*local_vertices(mesh), rng, 16)
    expected = find_entries(march_tables(mesh), as_rays((origins, directions)), CONFIG)
    directions[3] = np.nan
    found = find_entries(march_tables(mesh), as_rays((origins, directions)), CONFIG)
    others = np.arange(16) != 3
    assert np.any(expected.holds[others] >= 0)
    assert_array_equal(found.holds[others], expected.holds[others])


def test_an_edge_that_points_to_the_camera_needs_no_care(rng, monkeypatch):
    """All rays meet its line, at the camera: tests of it are ties that decide nothing."""
    mesh = build_tet_mesh(*grid(np.ones((2, 2, 2), bool)))
    eye = np.array([1.0, 1.0, 6.0])  # above the edges at the middle of the grid
    targets = rng.uniform(0, 2, (COUNT, 3))
    rays = to_local(mesh, as_rays((np.tile(eye, (COUNT, 1)), unit(targets - eye))))
    tables, doubts, codes = march_tables(mesh), [], []
    for everywhere in (False, True):

        def watched(doubt, careful, quick, everywhere=everywhere):
            jax.debug.callback(lambda count: doubts.append(int(count)), doubt.sum())
            return mended(doubt | everywhere, careful, quick)

        monkeypatch.setattr(traversal, "mended", watched)
        codes.append(traverse(tables, rays, CONFIG).codes)
    jax.effects_barrier()
    assert doubts and sum(doubts) <= 2 * COUNT // 10  # in both marches; half of the rays, if ties counted
    assert_array_equal(*codes)


@pytest.mark.parametrize("name", ["cube", "nonconvex"])
def test_accelerators_find_the_same_crossings(name, rng, on_accelerators):
    """All rays in one tile, whose careful tests are computed without a branch."""
    mesh = tet_mesh(name)
    kinds = [make(*local_vertices(mesh), rng, COUNT) for make in (GENERIC | DEGENERATE).values()]
    rays = as_rays(tuple(np.concatenate(parts) for parts in zip(*kinds, strict=True)))
    config = dataclasses.replace(CONFIG, tile_size=None)
    there = jax.jit(lambda: traverse(march_tables(mesh), rays, config))()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax, "default_backend", lambda: "cpu")
        here = jax.jit(lambda: traverse(march_tables(mesh), rays, config))()
    assert_array_equal(there.codes, here.codes)
    assert_array_equal(there.overflow, here.overflow)
    # Sums of products that are fused or not, of numbers up to 4; a few times that where a face is edge-on.
    assert_allclose(np.stack(there.ends), np.stack(here.ends), atol=1e-5)


def test_more_entries_than_any_buffer_are_an_error(monkeypatch):
    monkeypatch.setattr(capacity, "MAX_GROWTH", 0)
    mesh = tet_mesh("blobs")
    centers = local_vertices(mesh)[0].reshape(2, -1, 3).mean(axis=1)
    direction = (centers[1] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
    rays = as_rays((centers[:1] - 3 * direction, direction[None]))
    world = rays.replace(origins=mesh.center + mesh.scale * rays.origins)
    with pytest.raises(ValueError, match="enters the cage more than 1 times; raise"):
        capacity.all_entries(mesh, march_tables(mesh), world, MarchConfig(max_entries_per_ray=1))
