"""Embree's point location and segments against float64 searches of all tets."""

import itertools

import numpy as np
import pytest
from scipy.spatial import Delaunay

from nimpostor_jax.preprocess.embree import EmbreeQuery

# Embree traces in float32: a face is seen up to about 1e-6 of the cage's size (2 to 4 here) off.
ROUNDING = 1e-5


def random_mesh(count=60, seed=0):
    vertices = np.random.default_rng(seed).normal(size=(count, 3))
    tets = Delaunay(vertices).simplices
    flipped = np.linalg.det(vertices[tets[:, 1:]] - vertices[tets[:, :1]]) < 0
    return vertices, np.where(flipped[:, None], tets[:, [0, 1, 3, 2]], tets)


def coordinates(vertices, tets, points):
    """Barycentric coordinates [N, T, 4] of each point in each tet."""
    matrices = np.concatenate([vertices[tets], np.ones((len(tets), 4, 1))], axis=2)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return np.einsum("nk,tki->nti", homogeneous, np.linalg.inv(matrices))


def test_locate_agrees_with_a_search_of_all_tets():
    vertices, tets = random_mesh()
    points = np.random.default_rng(1).uniform(-2.5, 2.5, (4000, 3))
    found = EmbreeQuery(vertices, tets).locate(points)
    smallest = coordinates(vertices, tets, points).min(axis=2)
    expected = np.where(smallest.max(axis=1) >= 0, smallest.argmax(axis=1), -1)
    clear = np.abs(smallest.max(axis=1)) > ROUNDING
    assert clear.mean() > 0.99
    assert 0.1 < np.mean(expected >= 0) < 0.9
    np.testing.assert_array_equal(found[clear], expected[clear])


def test_locate_does_not_depend_on_place_and_size():
    vertices, tets = random_mesh()
    points = np.random.default_rng(1).uniform(-2, 2, (2000, 3))
    found = EmbreeQuery(vertices, tets).locate(points)
    moved = EmbreeQuery(1e-3 * vertices + 1e4, tets).locate(1e-3 * points + 1e4)
    assert np.mean(found != moved) < 1e-3  # rounding of points next to faces


def test_first_hits():
    vertices = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    query = EmbreeQuery(3 * vertices, np.array([[0, 1, 2, 3]]))
    origins = np.array([[0.3, 0.3, -1.0], [0.3, 0.3, 0.5], [5.0, 5.0, 5.0]])
    t, tet = query.first_hits(origins, np.tile([0.0, 0.0, 1.0], (3, 1)))
    np.testing.assert_allclose(t, [1.0, 1.9, np.inf], atol=1e-12)  # t is recomputed in float64
    np.testing.assert_array_equal(tet, [0, -1, -1])


def test_segments_are_the_intervals_of_the_tets():
    vertices, tets = random_mesh(40, 2)
    rng = np.random.default_rng(3)
    origins = rng.normal(size=(200, 3)) * 2
    directions = 0.5 * rng.normal(size=(200, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    segments = EmbreeQuery(vertices, tets).segments(origins, directions)

    # lambda(t) = a + b t is at least 0 in one interval of each tet
    a = coordinates(vertices, tets, origins)
    b = coordinates(vertices, tets, origins + directions) - a
    crossing = -a / b
    enter = np.maximum(np.where(b > 0, crossing, -np.inf).max(axis=2), 0)
    leave = np.where(b < 0, crossing, np.inf).min(axis=2)
    length = np.where(leave > enter, leave - enter, 0.0)
    assert (length > 0).sum() > 1000

    found = np.zeros_like(length)
    np.add.at(found, (segments.rays, segments.tets), segments.t_exit - segments.t_enter)
    # A restart skips 1e-5 of the size (3.5): what is shorter may be missing, its length going next door.
    np.testing.assert_allclose(found, length, atol=2e-4)
    np.testing.assert_allclose(found.sum(axis=1), length.sum(axis=1), atol=1e-4)
    for ray in range(200):
        mine = segments.rays == ray
        assert np.all(np.diff(segments.t_enter[mine]) >= 0)


def test_no_rays_and_rays_that_miss():
    query = EmbreeQuery(*random_mesh())
    empty = query.segments(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(empty.rays) == 0
    missing = query.segments(np.full((2, 3), 50.0), np.tile([0.0, 0.0, 1.0], (2, 1)))
    assert len(missing.tets) == 0


def test_a_face_with_three_tets_is_refused():
    vertices = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    tets = np.array([[0, 1, 2, 4], [0, 1, 2, 5], [0, 1, 2, 6]])
    with pytest.raises(ValueError, match="more than two tets"):
        EmbreeQuery(vertices, tets)
