"""geometry.intersect: the side test and its ties, on which the walk rests."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.geometry.intersect import (
    face_weights,
    passes_left,
    project,
    quick_face_weights,
    quick_passes_left,
    ray_frame,
)


def columns(points):
    return tuple(jnp.asarray(points, jnp.float32).T)


def random_directions(rng):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    random = rng.normal(size=(50, 3))
    near_poles = np.array([[1e-7, 0, -1], [0, -1e-7, -1], [1e-4, 1e-4, -1]])
    directions = np.concatenate([axes, random, near_poles])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def test_ray_frame_is_right_handed_and_orthonormal(rng):
    directions = random_directions(rng)
    frame = np.stack(
        [np.stack(np.broadcast_arrays(*axis), axis=-1) for axis in ray_frame(columns(directions))], axis=1
    )
    assert_allclose(frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=1e-6)
    assert_allclose(np.linalg.det(frame), 1, atol=1e-6)
    assert_allclose(frame[:, 2], directions, atol=1e-7)


def test_project_measures_along_the_axes(rng):
    points, origins, directions = rng.normal(size=(3, 20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = ray_frame(columns(directions))
    across, up, along = project(columns(points), columns(origins), axes)
    offset = points - origins
    assert_allclose(along, np.sum(offset * directions, axis=1), atol=1e-6)
    assert_allclose(across**2 + up**2 + along**2, np.sum(offset**2, axis=1), rtol=1e-5)


# Integer points, so that products are exact and many lines pass through the ray.
LATTICE = [(x, y) for x in (-2, -1, 0, 1, 2) for y in (-2, -1, 0, 1, 2)]


def test_turning_an_edge_around_turns_the_answer():
    edges = np.array([(u, v) for u, v in itertools.product(LATTICE, LATTICE) if u != v], np.float32)
    u, v = edges[:, 0].T, edges[:, 1].T
    assert_array_equal(passes_left(u, v), ~passes_left(v, u))


@pytest.mark.parametrize("stretch", [0.0, 1e-7, 1.0])
def test_is_the_exact_sign_of_the_area(stretch, rng, optimized):
    """Nearly parallel ones included, whose float32 products are equal; float64 products are exact here.

    Compiled as users do: a multiply and an add that are fused would round differently.
    """
    u = rng.normal(size=(2, 2000)).astype(np.float32)
    v = (rng.uniform(0.5, 2, 2000) * u + stretch * rng.normal(size=(2, 2000))).astype(np.float32)
    forward, backward = u[0].astype(float) * v[1], u[1].astype(float) * v[0]
    differ = forward != backward
    left = jax.jit(passes_left)(u, v)
    assert_array_equal(left[differ], (forward > backward)[differ])
    quick, close = jax.jit(quick_passes_left)(u, v)
    assert_array_equal(quick[~close], left[~close])
    if stretch < 1:
        assert np.sum(close & differ) > 20  # the exact test had something to do


def test_quick_face_weights_are_the_careful_ones_unless_they_say_so(rng):
    triangles = rng.normal(size=(2000, 3, 2)).astype(np.float32)
    triangles[::2, 2] = triangles[::2, :2].mean(axis=1) + 1e-5 * triangles[::2, 2]  # seen edge-on
    corners = [columns(triangles[:, i]) for i in range(3)]
    following = np.roll(triangles, -1, axis=1)
    crosses = (triangles[..., 0] * following[..., 1] - triangles[..., 1] * following[..., 0]).T
    inside = np.all(np.sign(crosses) == np.sign(crosses[0]), axis=0)
    careful = np.stack(face_weights(*corners))
    quick, flat = quick_face_weights(*corners)
    trusted = inside & ~np.asarray(flat)
    assert trusted.sum() > 100
    # 6e-8 by the least trusted height, 1e-2, some ten times over
    assert_allclose(np.stack(quick)[:, trusted], careful[:, trusted], atol=1e-4)
    assert np.all(flat[::2] | ~inside[::2])


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (0, 1), (-1, 1), (1, 2), (-1, -1)])
def test_a_fan_is_hit_once_even_through_its_edges_and_centre(shift):
    """Triangles around a vertex cover their union exactly once, wherever the ray (the origin) meets it."""
    ring = (
        np.array([(2, 0), (2, 2), (0, 2), (-2, 2), (-2, 0), (-2, -2), (0, -2), (2, -2)], np.float32) + shift
    )
    centre = np.array(shift, np.float32)
    hits = 0
    for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        triangle = (centre, a, b)
        sides = [
            bool(passes_left(tuple(p), tuple(q)))
            for p, q in zip(triangle, triangle[1:] + triangle[:1], strict=True)
        ]
        hits += all(sides)
    assert hits == 1


def test_face_weights_reproduce_the_origin(rng):
    triangles = rng.normal(size=(300, 3, 2))
    crosses = (
        triangles[:, [0, 1, 2], 0] * triangles[:, [1, 2, 0], 1]
        - triangles[:, [0, 1, 2], 1] * triangles[:, [1, 2, 0], 0]
    )
    inside = np.all(crosses > 0.05, axis=1) | np.all(crosses < -0.05, axis=1)
    assert inside.sum() > 20
    triangles = triangles[inside]
    weights = np.stack(face_weights(*(columns(triangles[:, i]) for i in range(3))), axis=-1)
    assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert_allclose(
        np.sum(weights[..., None] * triangles, axis=1), 0, atol=1e-5
    )  # float32, coordinates up to 3


def test_face_weights_stay_in_range(rng):
    """Also beside the triangle, where rounding may put the ray; the triangle's nearest part is taken."""
    triangles = rng.normal(size=(300, 3, 2)) + np.array([1.0, 0.0])
    weights = np.stack(face_weights(*(columns(triangles[:, i]) for i in range(3))), axis=-1)
    assert np.all((weights >= 0) & (weights <= 1))
    assert_allclose(weights.sum(axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("turn", [0, 1, 2])
@pytest.mark.parametrize("tilt", [0.0, 1e-16, -1e-16])
def test_an_edge_along_the_cut_is_all_of_it(turn, tilt):
    """The line passes through a corner, and an edge runs from there across, up to rounding."""
    corners = np.roll([[-0.4, 0.0], [tilt, 0.4], [0.0, 0.0]], turn, axis=0)
    weights = np.stack(face_weights(*(columns(corners[None, i]) for i in range(3))), axis=-1)
    assert_allclose(weights @ corners, 0, atol=1e-7)


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_a_face_seen_edge_on_is_met_where_the_line_is_within_it(turn, rng):
    """Corners in one line, one side of the face beyond the ray: the two cut edges bound the depth."""
    along = np.array([[-1.0, -1.0], [0.5, 0.5], [2.0, 2.0]]) + rng.uniform(-1e-7, 1e-7, (64, 3, 2))
    depth = np.array([1.0, 2.0, 4.0])
    order = np.roll(np.arange(3), turn)
    weights = np.stack(face_weights(*(columns(along[:, i]) for i in order)), axis=-1)
    # at 0, the edge from -1 to 0.5 has depth 1 + 2/3, the one from -1 to 2 has depth 2
    met = weights @ depth[order]
    assert np.all((met > 5 / 3 - 1e-5) & (met < 2 + 1e-5))
    assert np.ptp(met) > 0.1  # anywhere between, as rounding will have it


@pytest.mark.parametrize(
    "corners", [[(1, 1), (2, 2), (3, 3)], [(0, 0), (0, 0), (0, 0)], [(0, 0), (1, 0), (2, 0)]]
)
def test_gradients_of_degenerate_faces_are_finite(corners):
    def total(x):
        moved = [tuple(x * jnp.float32(p) for p in corner) for corner in corners]
        return jnp.sum(jnp.stack(face_weights(*moved)) * jnp.arange(3.0))

    assert np.isfinite(total(1.0))
    assert np.isfinite(jax.grad(total)(1.0))
