"""The query Q against a float64 search of all tets, SciPy and Embree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import Delaunay

from nimpostor_jax.geometry.locate import locate
from nimpostor_jax.geometry.topology import build_tet_mesh, world_vertices
from nimpostor_jax.preprocess.embree import EmbreeQuery

# A point may round to the wrong side of a face by this share of the cage's size: 8 ulps accepted, and the
# world points, frame and vertices are rounded to float32 once each.
ROUNDING = 2e-6
COUNT = 2500  # points; the same in most tests, which then share a compilation


def oriented(vertices, tets):
    flipped = np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) < 0
    return np.where(flipped[:, None], tets[:, [0, 1, 3, 2]], tets)


def cloud(count=120, seed=0, offset=0.0):
    """A convex mesh without slivers and its SciPy triangulation."""
    points = np.random.default_rng(seed).normal(size=(count, 3)) + offset
    triangulation = Delaunay(points)
    return points, oriented(points, triangulation.simplices), triangulation


def hollow(dtype="float32"):
    """Tets of a cloud, a third of which were removed: not convex, with holes."""
    vertices, tets, _ = cloud(150, 4)
    keep = np.random.default_rng(5).uniform(size=len(tets)) > 0.33
    return build_tet_mesh(vertices, tets[keep], dtype=dtype)


def depths(vertices, tets, points):
    """Smallest signed distance [N, T] of each point to the face planes of each tet, float64."""
    corners = vertices[tets]
    result = np.full((len(points), len(tets)), np.inf)
    for i in range(4):
        a, b, c = (corners[:, j] for j in range(4) if j != i)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        normal *= np.sign(np.sum(normal * (corners[:, i] - a), axis=1, keepdims=True))
        result = np.minimum(result, points @ normal.T - np.sum(normal * a, axis=1))
    return result


def assert_locates(mesh, points, tet_ids):
    """Every answer holds its point, and no point that is clearly inside is lost."""
    size = float(mesh.scale)
    depth = depths(world_vertices(mesh), np.asarray(mesh.tets), points)
    found = tet_ids >= 0
    assert np.all(depth[found, tet_ids[found]] >= -ROUNDING * size)
    assert np.all(depth[~found].max(axis=1) <= ROUNDING * size)


def box_points(mesh, count, seed=0, grow=1.1):
    vertices = world_vertices(mesh)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    share = (np.random.default_rng(seed).uniform(size=(count, 3)) - 0.5) * grow + 0.5
    return np.float32(low + share * (high - low)).astype(np.float64)


@pytest.mark.parametrize("dtype, tolerance", [("float32", 2e-5), ("float64", 1e-11)])
def test_agrees_with_a_search_of_all_tets(dtype, tolerance, x64):
    mesh = hollow(dtype)
    points = box_points(mesh, COUNT)
    tet_ids, lambdas = (np.asarray(x) for x in locate(mesh, jnp.asarray(points, dtype)))
    assert lambdas.dtype == dtype
    assert 0.1 < np.mean(tet_ids >= 0) < 0.6  # both outcomes are common
    assert_locates(mesh, points, tet_ids)
    # The tets are disjoint: where the point is not within rounding of a face, the id is exact.
    depth = depths(world_vertices(mesh), np.asarray(mesh.tets), points)
    clear = np.abs(depth.max(axis=1)) > ROUNDING * float(mesh.scale)
    expected = np.where(depth.max(axis=1) > 0, depth.argmax(axis=1), -1)
    np.testing.assert_array_equal(tet_ids[clear], expected[clear])
    assert clear.mean() > 0.99
    # Coordinates reproduce the point; tets are well shaped enough that a few ulps stay a few ulps.
    corners = world_vertices(mesh)[np.asarray(mesh.tets)]
    inside = tet_ids >= 0
    rebuilt = np.sum(lambdas[..., None] * corners[tet_ids], axis=1)
    np.testing.assert_allclose(rebuilt[inside], points[inside], atol=tolerance)
    assert np.all(lambdas[~inside] == 0)


def test_agrees_with_scipy():
    vertices, tets, triangulation = cloud()
    mesh = build_tet_mesh(vertices, tets)
    points = box_points(mesh, COUNT, 2)
    tet_ids = np.asarray(locate(mesh, jnp.asarray(points))[0])
    expected = triangulation.find_simplex(points)
    different = tet_ids != expected
    assert different.sum() <= 2  # only within rounding of a face, which assert_locates checks
    assert_locates(mesh, points[different], tet_ids[different])


@pytest.mark.parametrize("offset", [0.0, 50.0])
def test_agrees_with_embree(offset):
    vertices, tets, _ = cloud(offset=offset)
    mesh = build_tet_mesh(vertices, tets)
    points = box_points(mesh, COUNT, 4)
    tet_ids = np.asarray(locate(mesh, jnp.asarray(points))[0])
    expected = EmbreeQuery(world_vertices(mesh), tets).locate(points)
    different = tet_ids != expected
    assert different.sum() <= 2 + 2 * offset
    # float32 world coordinates at distance `offset` resolve 4e-6: either side is right within that.
    depth = depths(world_vertices(mesh), tets, points[different])
    closest = np.sort(depth, axis=1)[:, -1]
    assert np.all(np.abs(closest) < 1e-5 * (1 + offset))


def test_deformed_mesh_is_refitted():
    mesh = hollow()
    v = mesh.vertices
    angle = 0.8 * v[:, 2]
    twisted = jnp.stack(
        [v[:, 0] * jnp.cos(angle) - v[:, 1] * jnp.sin(angle) + 3,
         v[:, 0] * jnp.sin(angle) + v[:, 1] * jnp.cos(angle), 2 * v[:, 2]], axis=-1,
    )  # fmt: skip
    moved = mesh.replace(vertices=twisted)
    points = box_points(moved, COUNT, 6)
    tet_ids = np.asarray(locate(moved, jnp.asarray(points))[0])
    assert np.mean(tet_ids >= 0) > 0.05
    # 4x: the frame no longer fits the mesh, whose coordinates reach 4
    depth = depths(world_vertices(moved), np.asarray(mesh.tets), points)
    size = 4 * ROUNDING * float(mesh.scale)
    found = tet_ids >= 0
    assert np.all(depth[found, tet_ids[found]] >= -size)
    assert np.all(depth[~found].max(axis=1) <= size)


def test_vertices_edges_and_faces_are_never_lost():
    mesh = hollow()
    corners = world_vertices(mesh)[np.asarray(mesh.tets)]
    weights = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [1, 2, 0, 0], [1, 1, 1, 0], [3, 1, 1, 0], [1, 1, 1, 1]])
    points = np.einsum("wi,tix->twx", weights / weights.sum(axis=1, keepdims=True), corners).reshape(-1, 3)
    points = np.random.default_rng(1).permutation(points)[:COUNT]
    tet_ids = np.asarray(locate(mesh, jnp.asarray(points))[0])
    assert np.all(tet_ids >= 0)
    # Deterministic: the same answer whatever is asked beside the point
    order = np.random.default_rng(0).permutation(len(points))
    again = np.asarray(locate(mesh, jnp.asarray(points[order]))[0])
    np.testing.assert_array_equal(again, tet_ids[order])


@pytest.mark.parametrize("shares", [[1, 0, 0, 0], [0.3, 0.7, 0, 0]])
@pytest.mark.parametrize("moved", [[1, 2, 3], [2]])
def test_flat_and_inverted_tets_do_not_swallow_points(moved, shares):
    """Corners of a tet moved to its first one, or onto an edge: rounding leaves faces with a normal."""
    vertices, tets, _ = cloud()
    mesh = build_tet_mesh(vertices, tets)
    place = jnp.asarray(shares, jnp.float32) @ mesh.vertices[mesh.tets[5]]
    mesh = mesh.replace(vertices=mesh.vertices.at[mesh.tets[5, jnp.asarray(moved)]].set(place))
    flat = np.random.default_rng(2).dirichlet(np.ones(4), 64) @ world_vertices(mesh)[np.asarray(mesh.tets[5])]
    points = box_points(mesh, COUNT, 8, grow=2.0)
    points[: len(flat)] = flat
    tet_ids = np.asarray(locate(mesh, jnp.asarray(points))[0])
    outside = np.any(np.abs(points - np.asarray(mesh.center)) > 1.001 * np.abs(
        world_vertices(mesh) - np.asarray(mesh.center)).max(axis=0), axis=1)  # fmt: skip
    assert outside.any() and np.all(tet_ids[outside] == -1)
    assert not np.any(tet_ids == 5)


def test_odd_points_and_shapes():
    mesh = hollow()
    points = box_points(mesh, COUNT).reshape(50, COUNT // 50, 3)
    points[:3, 0] = [[np.nan, 0, 0], [np.inf, 0, 0], [1e30, 0, -1e30]]
    tet_ids, lambdas = locate(mesh, jnp.asarray(points))
    assert tet_ids.shape == points.shape[:2] and lambdas.shape == (*points.shape[:2], 4)
    assert np.all(tet_ids[:3, 0] == -1) and np.all(lambdas[:3, 0] == 0)
    assert np.any(tet_ids >= 0) and np.all(np.isfinite(lambdas))
    gradients = jax.grad(lambda p: jnp.sum(locate(mesh, p)[1] ** 2))(jnp.asarray(points))
    assert np.all(np.isfinite(gradients))
    assert locate(mesh, jnp.zeros((0, 3)))[0].shape == (0,)


def test_a_single_tet():
    one = build_tet_mesh(np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.array([[0, 1, 2, 3]]))
    tet_ids, lambdas = locate(one, jnp.array([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5]]))
    np.testing.assert_array_equal(tet_ids, [0, -1])
    np.testing.assert_allclose(lambdas[0], [0.4, 0.1, 0.2, 0.3], atol=1e-6)  # float32 rounding


def test_gradients_match_finite_differences(x64):
    mesh = hollow("float64")
    points = jnp.asarray(box_points(mesh, COUNT, 9))
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(COUNT, 4)))

    def loss(vertices, points):
        lambdas = locate(mesh.replace(vertices=vertices), points)[1]
        return jnp.sum(weights * lambdas**2)

    gradients = jax.grad(loss, argnums=(0, 1))(mesh.vertices, points)
    assert all(bool(jnp.any(g != 0)) for g in gradients)
    rng = np.random.default_rng(2)
    step = 1e-7  # small enough that no point changes its tet
    for argument, gradient in enumerate(gradients):
        direction = rng.normal(size=gradient.shape)
        values = []
        for sign in (1, -1):
            arguments = [mesh.vertices, points]
            arguments[argument] = arguments[argument] + sign * step * direction
            values.append(loss(*arguments))
        numeric = (values[0] - values[1]) / (2 * step)
        # central differences: 1e-16 / step in the values, relative to a sum over hundreds of points
        np.testing.assert_allclose(jnp.sum(gradient * direction), numeric, rtol=1e-5)


def test_a_deformation_or_new_points_do_not_retrace():
    mesh = hollow()
    points = jnp.asarray(box_points(mesh, COUNT), jnp.float32)
    locate(mesh, points)
    before = locate._cache_size()
    locate(mesh.replace(vertices=1.1 * mesh.vertices), points + 0.01)
    assert locate._cache_size() == before


def test_memory_is_points_plus_tets():
    mesh = hollow()
    count = 20000
    used = locate.lower(mesh, jnp.zeros((count, 3))).compile().memory_analysis().temp_size_in_bytes
    # A single byte for each point and tet would be more: there are 600 tets.
    assert len(mesh.tets) > 500
    assert 20 * count < used < 300 * count
