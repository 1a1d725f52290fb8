"""render.traverse and render.segments against brute force: every ray against every tet, in float64."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from meshes import MESHES, cube, delaunay, grid, local_vertices, tet_mesh
from numpy.testing import assert_allclose, assert_array_equal
from rays import DEGENERATE, GENERIC, as_rays, by_ray, generic, unit

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry.tetrahedron import num_inverted
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.render.segments import locate_segments
from nimpostor_jax.render.traverse import march_tables, traverse

CONFIG = MarchConfig(max_tets_per_ray=40, max_entries_per_ray=4, tile_size=16)
COUNT = 32
KINDS = GENERIC | DEGENERATE
# Positions are about 1 and rays start at distance 3: a few dozen roundings of the dtype, and an exit
# position moves by 1 / sin of the angle at which a face is met, which the tests' rays keep below 1e3.
TOLERANCE = {"float32": 2e-4, "float64": 1e-9}


@functools.partial(jax.jit, static_argnames="config")
def walk(mesh, rays, config=CONFIG, near=0.0):
    return by_ray(locate_segments(mesh, rays, traverse(march_tables(mesh), rays, config), near))


def row(segments, ray):
    """A ray's nonempty slots as NumPy arrays."""
    used = np.asarray(segments.tet_ids[ray]) >= 0
    names = ("tet_ids", "t_enter", "t_exit", "lambda_enter", "lambda_exit")
    return tuple(np.asarray(getattr(segments, name)[ray])[used] for name in names)


def check_consistent(mesh, rays, segments, tolerance):
    """What holds on every ray, degenerate or not: order, and coordinates that say where the ends are."""
    vertices, tets = local_vertices(mesh)
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        ids, enters, exits, lambda_enter, lambda_exit = row(segments, ray)
        assert np.all(enters < exits)
        assert np.all(enters >= 0)
        assert np.all(enters[1:] > exits[:-1] - tolerance)
        for t, weights in ((enters, lambda_enter), (exits, lambda_exit)):
            assert_allclose(weights.sum(axis=1), 1, atol=tolerance)
            assert np.all(weights >= -tolerance)
            points = np.einsum("ki,kix->kx", weights.astype(float), vertices[tets[ids]])
            assert_allclose(points, origin + t[:, None] * direction, atol=tolerance)


def check_chord(mesh, rays, segments, tolerance):
    """Segments sum to the exact chord: the length of the union of the oracle's intervals."""
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        expected = oracles.union_length(oracles.ray_segments(*local_vertices(mesh), origin, direction))
        _, enters, exits, _, _ = row(segments, ray)
        assert_allclose(np.sum(exits - enters), expected, atol=tolerance, err_msg=f"ray {ray}")


CASES = [
    *[(name, "float32") for name in MESHES], ("delaunay", "float64"), ("nonconvex", "float64"),
]  # fmt: skip


@functools.cache
def walked(name, dtype):
    """A mesh, and for each kind of rays the rays and their segments: marched together, compiled once."""
    mesh, rng = tet_mesh(name, dtype), np.random.default_rng(0)
    kinds = {kind: make(*local_vertices(mesh), rng, COUNT) for kind, make in KINDS.items()}
    together = tuple(np.concatenate(parts) for parts in zip(*kinds.values(), strict=True))
    segments = walk(mesh, as_rays(together, dtype))
    slices = {kind: slice(i * COUNT, (i + 1) * COUNT) for i, kind in enumerate(kinds)}
    return mesh, {
        kind: (kinds[kind], jax.tree.map(lambda x, s=slices[kind]: x[s], segments)) for kind in kinds
    }


@pytest.mark.parametrize("kind", GENERIC)
@pytest.mark.parametrize("name, dtype", CASES)
def test_generic_rays_cross_what_the_oracle_says(name, dtype, kind, x64):
    mesh, kinds = walked(name, dtype)
    rays, segments = kinds[kind]
    tolerance = TOLERANCE[dtype]
    assert not np.any(segments.overflow)
    check_consistent(mesh, rays, segments, tolerance)
    crossed = 0
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        expected = oracles.ray_segments(*local_vertices(mesh), origin, direction)
        found = {tet: ends for tet, *ends in zip(*row(segments, ray)[:3], strict=True)}
        for low, high, tet, *_ in expected:
            if high - low > tolerance:
                assert_allclose(found[tet], (low, high), atol=tolerance)
                crossed += 1
        extra = set(found) - {s[2] for s in expected}
        assert all(found[tet][1] - found[tet][0] < tolerance for tet in extra)
        chord = sum(high - low for low, high in found.values())
        assert_allclose(chord, oracles.union_length(expected), atol=tolerance)
    assert (crossed >= COUNT // 2) == (kind == "generic")


@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("name, dtype", CASES)
def test_degenerate_rays_lose_nothing(name, dtype, kind, x64):
    mesh, kinds = walked(name, dtype)
    rays, segments = kinds[kind]
    if kind != "along_faces":  # where a ray lies in a face, rounding says at which point it passes the face
        check_consistent(mesh, rays, segments, TOLERANCE[dtype])
    shifts = 1e-5 * np.concatenate([np.zeros((1, 3)), unit(np.random.default_rng(5).normal(size=(6, 3)))])
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        _, enters, exits, _, _ = row(segments, ray)
        # A ray within the cage's surface may be passed on either side of it: as if it were shifted a little.
        chords = [
            oracles.union_length(oracles.ray_segments(*local_vertices(mesh), origin + shift, direction))
            for shift in shifts
        ]
        # shifting by 1e-5 moves an exit by as much over the sine of the angle
        assert min(chords) - 2e-3 <= np.sum(exits - enters) <= max(chords) + 2e-3


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_rays_through_vertices_never_leave_their_line(dtype, x64, optimized):
    """Many, through the vertices of a cage that is not convex: they leave and re-enter it at a vertex.

    If kernels rounded a vertex's projection differently (fused multiply-adds), about 1 in 500 would derail.
    """
    mesh = tet_mesh("nonconvex", dtype)
    vertices, tets = local_vertices(mesh)
    origins, directions = DEGENERATE["through_vertices"](vertices, tets, np.random.default_rng(7), 4096)
    segments = jax.jit(walk.__wrapped__, static_argnames="config")(
        mesh, as_rays((origins, directions), dtype)
    )
    used = np.asarray(segments.tet_ids) >= 0
    corners = vertices[tets[np.maximum(segments.tet_ids, 0)]]
    for t, weights in ((segments.t_enter, segments.lambda_enter), (segments.t_exit, segments.lambda_exit)):
        points = np.einsum("rki,rkix->rkx", np.asarray(weights, float), corners)
        on_line = origins[:, None] + np.asarray(t)[..., None] * directions[:, None]
        assert np.max(np.abs(points - on_line)[used]) < TOLERANCE[dtype] * 5  # more rays, sharper angles


def test_lattice_rays_through_vertices_and_faces_of_a_cube():
    """Integer geometry: the chord through interior edges, vertices and face planes is exact."""
    vertices, tets = cube()
    mesh = build_tet_mesh(vertices, tets)
    mesh = mesh.replace(vertices=jnp.asarray(vertices, jnp.float32))
    origins = np.array(
        [[-1, 0.5, 0.5], [0.5, 0.5, -2], [0.5, 3, 0.5], [-1, -1, -1], [-1, 0.5, -1], [-1, 0.25, 0.75]]
    )
    directions = unit(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0], [1, 1, 1], [1, 0, 1], [1, 0, 0]]))
    segments = walk(mesh, as_rays((origins, directions)))
    chords = np.sum(np.asarray(segments.t_exit - segments.t_enter), axis=1)
    assert_allclose(chords, [1, 1, 1, np.sqrt(3), np.sqrt(2), 1], atol=1e-6)


def test_parallel_rays_over_a_cubes_silhouette_count_it_once(rng):
    """Rays through a lattice, its border included: the half-open silhouette has exactly n x n of them."""
    vertices, tets = cube()
    mesh = build_tet_mesh(vertices, tets).replace(vertices=jnp.asarray(vertices, jnp.float32))
    n = 8
    x, y = np.meshgrid(np.arange(n + 1) / n, np.arange(n + 1) / n)
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], axis=1)
    directions = np.broadcast_to([0.0, 0.0, 1.0], origins.shape)
    segments = walk(mesh, as_rays((origins, directions)))
    chords = np.sum(np.asarray(segments.t_exit - segments.t_enter), axis=1)
    assert np.all((chords < 1e-6) | (np.abs(chords - 1) < 1e-6))
    assert np.sum(chords > 0.5) == n * n


def test_neighbouring_segments_meet(rng):
    mesh = tet_mesh("delaunay")
    vertices, tets = local_vertices(mesh)
    segments = walk(mesh, as_rays(generic(vertices, tets, rng, COUNT)))
    for ray in range(COUNT):  # convex: one run without gaps
        _, enters, exits, _, _ = row(segments, ray)
        assert_allclose(enters[1:], exits[:-1], atol=1e-5)


@pytest.mark.parametrize("near", [0.5, 2.9, 10.0])
def test_near_cuts_the_ray(near, rng):
    mesh = tet_mesh("nonconvex")
    vertices, tets = local_vertices(mesh)
    rays = generic(vertices, tets, rng, COUNT)
    segments = walk(mesh, as_rays(rays), near=near)
    check_consistent(mesh, rays, segments, TOLERANCE["float32"])
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        expected = oracles.union_length(oracles.ray_segments(vertices, tets, origin, direction, near))
        _, enters, exits, _, _ = row(segments, ray)
        assert np.all(enters >= near)
        assert_allclose(np.sum(exits - enters), expected, atol=TOLERANCE["float32"])


def crossings(mesh, rays, **march):
    config = MarchConfig(**({"max_tets_per_ray": 40, "max_entries_per_ray": 4, "tile_size": 16} | march))
    result = jax.jit(traverse, static_argnames="config")(march_tables(mesh), rays, config)
    return np.asarray(result.codes).T, np.asarray(result.overflow)


def test_too_few_slots_are_reported_and_hold_the_first_tets(rng):
    mesh = tet_mesh("delaunay")
    rays = as_rays(generic(*local_vertices(mesh), rng, COUNT))
    whole, overflow = crossings(mesh, rays)
    assert not overflow.any()
    needed = np.sum(whole >= 0, axis=1)
    for slots in (1, int(needed.max()) - 1):
        codes, overflow = crossings(mesh, rays, max_tets_per_ray=slots)
        assert_array_equal(codes, whole[:, :slots])
        assert_array_equal(overflow, needed > slots)


def test_too_few_entries_are_reported_and_hold_the_first_runs(rng):
    mesh = tet_mesh("blobs")
    vertices, tets = local_vertices(mesh)
    left, right = vertices[tets].mean(axis=1)[[0, -1]]
    directions = unit(right - left)[None] + rng.normal(size=(COUNT, 3)) * 0.02
    rays = (left - 2 * unit(directions), unit(directions))
    whole, overflow = crossings(mesh, as_rays(rays))
    codes, too_many = crossings(mesh, as_rays(rays), max_entries_per_ray=1)
    assert not overflow.any()
    assert too_many.sum() > COUNT // 2
    second = whole // 36 >= len(tets) // 2  # of the two bodies
    assert np.any(second & (whole >= 0)) and np.any(~second & (whole >= 0))
    for ray in range(COUNT):
        count = np.sum(codes[ray] >= 0)
        assert_array_equal(codes[ray, :count], whole[ray, :count])
        assert too_many[ray] == (np.sum(whole[ray] >= 0) > count)


def test_overlapping_bodies_both_count(rng):
    """Two copies of a mesh in the same place (Fig. 4, intersecting): both bodies' tets are crossed."""
    vertices, tets = delaunay(count=12)
    mesh = build_tet_mesh(
        np.concatenate([vertices, vertices + 0.3]), np.concatenate([tets, tets + len(vertices)])
    )
    rays = generic(*local_vertices(mesh), rng, COUNT)
    segments = walk(mesh, as_rays(rays))
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        expected = sum(s[1] - s[0] for s in oracles.ray_segments(*local_vertices(mesh), origin, direction))
        assert_allclose(
            np.sum(row(segments, ray)[2] - row(segments, ray)[1]), expected, atol=TOLERANCE["float32"]
        )


@pytest.mark.parametrize("tile", [1, 7, None])
def test_results_do_not_depend_on_the_tile(tile, rng):
    mesh = tet_mesh("nonconvex")
    rays = as_rays(generic(*local_vertices(mesh), rng, COUNT))
    expected, _ = crossings(mesh, rays, tile_size=16)
    codes, overflow = crossings(mesh, rays, tile_size=tile)
    assert_array_equal(codes, expected)
    assert not overflow.any()


def test_no_rays_give_no_segments():
    mesh = tet_mesh("cube")
    segments = walk(mesh, as_rays((np.zeros((0, 3)), np.zeros((0, 3)))))
    assert segments.t_enter.shape[0] == 0


def test_far_away_rays_find_a_small_cage(rng):
    """Culling by cones must not lose faces where the cage is a speck."""
    mesh = tet_mesh("cube")
    targets = rng.uniform(-0.4, 0.4, (COUNT, 3))
    directions = unit(rng.normal(size=(COUNT, 3)))
    rays = as_rays((targets - 200 * directions, directions))
    found = np.sum(np.asarray(walk(mesh, rays).tet_ids) >= 0, axis=1)
    assert np.all(found > 0)


def test_moved_vertices_are_walked_with_fresh_tables(rng):
    mesh = tet_mesh("nonconvex", "float32")
    vertices, _ = local_vertices(mesh)
    angle = 0.7 * vertices[:, 2]
    twisted = vertices.copy()
    twisted[:, 0] = np.cos(angle) * vertices[:, 0] - np.sin(angle) * vertices[:, 1]
    twisted[:, 1] = np.sin(angle) * vertices[:, 0] + np.cos(angle) * vertices[:, 1]
    moved = mesh.replace(vertices=jnp.asarray(1.3 * twisted + 0.2, jnp.float32))
    assert num_inverted(moved.vertices, moved.tets) == 0
    rays = generic(*local_vertices(moved), rng, COUNT)
    segments = walk(moved, as_rays(rays))
    check_consistent(moved, rays, segments, TOLERANCE["float32"])
    check_chord(moved, rays, segments, TOLERANCE["float32"])


@pytest.mark.parametrize("damage", ["scrambled", "flat", "point"])
def test_inverted_and_flat_tets_end_and_stay_finite(damage, rng):
    mesh = tet_mesh("delaunay")
    vertices = np.asarray(mesh.vertices).copy()
    if damage == "scrambled":
        vertices = rng.permutation(vertices)
    else:
        vertices[:, 2 if damage == "flat" else slice(None)] = 0.0
    broken = mesh.replace(vertices=jnp.asarray(vertices))
    assert num_inverted(broken.vertices, broken.tets) > 0
    rays = as_rays(generic(*local_vertices(mesh), rng, COUNT))

    def total(vertices):
        segments = walk(broken.replace(vertices=vertices), rays)
        return jnp.sum(segments.t_exit - segments.t_enter) + jnp.sum(segments.lambda_enter[..., 0])

    segments = walk(broken, rays)
    for leaf in jax.tree.leaves(segments):
        assert np.all(np.isfinite(leaf))
    assert np.all(np.isfinite(jax.grad(total)(broken.vertices)))


def test_one_flat_tet_does_not_hide_those_behind_it(rng):
    """A sliver inside the cage is walked through: the chord of the whole cage stays exact."""
    mesh = build_tet_mesh(*cube())
    corner, *others = np.asarray(mesh.tets)[0, [1, 0, 2, 3]]
    flattened = np.asarray(mesh.vertices).copy()
    flattened[corner] = flattened[others].mean(axis=0)
    flat = mesh.replace(vertices=jnp.asarray(flattened))
    rays = generic(*local_vertices(flat), rng, COUNT)
    segments = walk(flat, as_rays(rays))
    vertices, tets = local_vertices(flat)
    for ray, (origin, direction) in enumerate(zip(*rays, strict=True)):
        ids, enters, exits, _, _ = row(segments, ray)
        assert len(np.unique(ids)) == len(ids)
        expected = oracles.union_length(oracles.ray_segments(vertices, tets[1:], origin, direction))
        assert_allclose(np.sum(exits - enters), expected, atol=TOLERANCE["float32"])
    for leaf in jax.tree.leaves(segments):
        assert np.all(np.isfinite(leaf))


def test_ends_are_differentiable_in_vertices_and_rays(x64, rng):
    mesh = tet_mesh("cube", "float64")
    rays = as_rays(generic(*local_vertices(mesh), rng, 6), "float64")
    mix = jnp.asarray(rng.normal(size=(6, CONFIG.max_tets_per_ray, 4)))

    def function(x):
        moved = mesh.replace(vertices=mesh.vertices + x[:8])
        bent = rays.replace(origins=rays.origins + x[8:14], directions=rays.directions + x[14:])
        bent = bent.replace(
            directions=bent.directions / jnp.linalg.norm(bent.directions, axis=1, keepdims=True)
        )
        segments = walk(moved, bent)
        ends = segments.lambda_enter + 0.5 * segments.lambda_exit
        ends += (segments.t_enter - 2 * segments.t_exit)[..., None]
        return jnp.sum(jnp.where((segments.tet_ids >= 0)[..., None], mix * ends, 0))

    function = jax.jit(function)
    x = jnp.zeros((20, 3))
    gradient = jax.jit(jax.grad(function))(x)
    for _ in range(4):
        direction = jnp.asarray(rng.normal(size=x.shape))
        expected = oracles.directional_difference(function, x, direction, 1e-6)
        # step^2 times third derivatives, which grow where a ray meets a face at a grazing angle
        assert_allclose(jnp.sum(gradient * direction), expected, rtol=1e-6)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_rays_in_the_planes_of_a_grid_walk_on(dtype, x64, rng, optimized):
    """Every face of such a plane is seen edge-on; the chord is that of the box, whatever is decided there."""
    mesh = build_tet_mesh(*grid(np.ones((3, 3, 3), bool)), dtype=dtype)
    count, half = 4096, np.abs(np.asarray(mesh.vertices)).max()
    axis = np.arange(count) % 3
    points, directions = rng.uniform(-half, half, (count, 3)), unit(rng.normal(size=(count, 3)))
    rows = np.arange(count)
    points[rows, axis] = rng.choice([-half / 3, half / 3], count)  # the two inner planes across an axis
    directions[rows, axis] = 0
    rays = as_rays((points - 3 * unit(directions), unit(directions)), dtype)
    segments = walk(mesh, rays, MarchConfig(max_tets_per_ray=48, max_entries_per_ray=4))
    assert not np.any(segments.overflow)
    used = np.asarray(segments.tet_ids) >= 0
    ends = np.maximum.accumulate(np.where(used, segments.t_exit, -np.inf), axis=1)
    tolerance = TOLERANCE[dtype]
    assert np.all((segments.t_enter[:, 1:] >= ends[:, :-1] - tolerance) | ~used[:, 1:])

    origins, slopes = (np.asarray(x, np.float64) for x in (rays.origins, rays.directions))
    with np.errstate(divide="ignore"):
        sides = np.sort((np.array([-half, half])[:, None, None] - origins) / slopes, axis=0)
    crossed = np.arange(3) != axis[:, None]  # parallel to the third pair of sides, and between them
    low = np.max(np.where(crossed, sides[0], -np.inf), axis=1)
    high = np.min(np.where(crossed, sides[1], np.inf), axis=1)
    chords = np.sum(segments.t_exit - segments.t_enter, axis=1)
    assert_allclose(chords, np.maximum(high - low, 0), atol=tolerance)
