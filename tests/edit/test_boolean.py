"""edit.boolean: set algebra of balls in a cube, by points and by rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from nimpostor_jax.edit.boolean import (
    difference,
    gated,
    intersection,
    settled_tets,
    solid_of,
    symmetric_difference,
    union,
)
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.edit.deform import deform, rigid
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.field.solids import CLOSED, MIXED, OPEN, is_inside
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.preprocess.patterns import solid_from_image, solid_from_surface
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.types import FunctionSolid

CONFIG = dataclasses.replace(
    scenes.exact(max_samples_per_ray=256, step=0.04, density_measure="euclidean"),
    march=dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=24, max_entries_per_ray=4),
)
render = jax.jit(render_rays, static_argnames="config")
A, B = np.array([0.4, 0.5, 0.5]), np.array([0.65, 0.5, 0.45])
RADIUS = 0.3
POINTS = np.random.default_rng(0).uniform(-0.1, 1.1, (2000, 3)).astype(np.float32)


def ball(points, center, radius=RADIUS):
    return radius**2 - jnp.sum((points - center) ** 2, axis=-1)


def ball_a(points):
    return ball(points, A)


def ball_b(points):
    return ball(points, B)


def full():
    """A cube of constant density 1."""
    return scenes.constant_density(scenes.impostor("cube"), 0.0)


def shape(function):
    return gated(full(), FunctionSolid(function), keep_inside=True)


def fills(impostor, points=POINTS):
    return np.asarray(is_inside(solid_of(impostor), jnp.asarray(points)))


def in_a(points=POINTS):
    return (np.asarray(ball_a(points)) > 0) & np.all((points > 0) & (points < 1), axis=-1)


def in_b(points=POINTS):
    return (np.asarray(ball_b(points)) > 0) & np.all((points > 0) & (points < 1), axis=-1)


@pytest.mark.parametrize(
    "operation, keep",
    [
        (lambda a, b: union(a, b, color="first"), in_a() | in_b()),
        (lambda a, b: union(a, b, color="second"), in_a() | in_b()),
        (lambda a, b: union(a, b, color="blend"), in_a() | in_b()),
        (lambda a, b: intersection(a, b, color="first"), in_a() & in_b()),
        (lambda a, b: intersection(a, b, color="second"), in_a() & in_b()),
        (lambda a, b: intersection(a, b, color="blend"), in_a() & in_b()),
        (difference, in_a() & ~in_b()),
        (symmetric_difference, in_a() ^ in_b()),
    ],
    ids=["first", "second", "blend", "and", "and second", "and blend", "less", "xor"],
)
def test_operations_are_those_of_sets(operation, keep):
    assert_array_equal(fills(operation(shape(ball_a), shape(ball_b))), keep)
    assert 0.01 < keep.mean() < 0.5


def test_identities():
    """A less A is nothing; A xor B is (A or B) less (A and B); De Morgan within the cube."""
    a, b = shape(ball_a), shape(ball_b)
    either = union(a, b, color="first")
    assert not fills(difference(a, a)).any()
    assert_array_equal(fills(union(a, a, color="first")), fills(a))
    assert_array_equal(fills(difference(either, intersection(a, b))), fills(symmetric_difference(a, b)))
    assert_array_equal(fills(difference(full(), either)), fills(difference(difference(full(), a), b)))
    assert_array_equal(fills(intersection(a, b)), fills(intersection(b, a)))


def chords(keep):
    """Length of each pixel's ray on which `keep(points)` holds, by brute force."""
    rays = pixel_rays(scenes.camera(), image_pixels(9, 12).reshape(-1, 2))
    t = (np.arange(4000) + 0.5) / 4000 * 6
    points = np.asarray(rays.origins)[:, None] + t[:, None] * np.asarray(rays.directions)[:, None]
    return np.asarray(keep(points.reshape(-1, 3))).reshape(points.shape[:2]).sum(axis=1) * 6 / 4000


def depths(impostor):
    """Optical depth of each pixel, in world units."""
    rays = pixel_rays(scenes.camera(), image_pixels(9, 12).reshape(-1, 2))
    output = render(impostor, rays, CONFIG)
    assert not output.overflow.any()
    return -np.log1p(-np.asarray(output.opacity, np.float64)) * float(impostor.mesh.scale)


@pytest.mark.parametrize("operation, keep", [(difference, lambda x: in_a(x) & ~in_b(x))])
def test_rays_see_what_is_left(operation, keep):
    """Cut samples: the same of a union, whose parts are several objects in one place."""
    cut = operation(shape(ball_a), shape(ball_b))
    expected = chords(keep)
    # Steps are 0.04 of the barycentric measure, 0.02 or so in length; up to four ends of chords lie in one.
    assert_allclose(depths(cut), expected, atol=0.05)
    assert expected.max() > 0.15 and np.mean(expected > 0) > 0.05
    together = union(cut, shape(ball_b), color="blend")
    assert_allclose(depths(together), expected + chords(in_b), atol=0.05)


def test_gates_follow_the_cage_and_survive_everything_else(tmp_path):
    """A point of a moved cage is open where it was at rest, cut finer, composed and saved as well."""
    cut = gated(shape(ball_a), solid_of(shape(ball_b)), keep_inside=False)
    space_map = rigid(Rotation.from_rotvec([0.3, 0.8, -0.2]).as_matrix(), np.array([2.0, 1.0, -1.0]))
    moved = deform(cut, space_map)
    places = np.asarray(space_map(jnp.asarray(POINTS)))
    clear = np.ones(len(POINTS), bool)
    for values in (ball_a(POINTS), ball_b(POINTS)):
        clear &= np.abs(np.asarray(values)) > 1e-4  # rounding of moved coordinates
    expected = in_a() & ~in_b()

    def check(impostor):
        assert_array_equal(fills(impostor, places)[clear], expected[clear])

    check(moved)
    check(subdivide(moved))
    far = np.eye(4)
    far[0, 3] = 30.0
    check(compose([full(), moved], [far, None]))
    check(deform(subdivide(cut, 1, np.arange(len(cut.mesh.tets)) == 1), space_map))
    grid = solid_from_surface(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS).apply_translation(B))
    saved = gated(full(), grid, keep_inside=False)
    save_impostor(tmp_path / "cut.npz", saved)
    assert_array_equal(fills(load_impostor(tmp_path / "cut.npz")), fills(saved))
    assert clear.mean() > 0.95


def test_a_surface_is_a_solid():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.3).apply_translation(A)
    solid = solid_from_surface(sphere, 96)
    distances = np.linalg.norm(POINTS - A, axis=1)
    clear = np.abs(distances - 0.3) > 0.6 / 96  # a voxel
    assert_array_equal(np.asarray(is_inside(solid, POINTS))[clear], (distances < 0.3)[clear])
    assert clear.mean() > 0.9


def test_a_picture_is_extruded():
    image = np.zeros((20, 40))
    image[:10, 20:] = 1  # the upper right quarter
    solid = solid_from_image(image, corner=(1, 2, 3), right=(4, 0, 0), up=(0, 0, 2), depth=(0, 1, 0))
    inside = [(4.9, 2.5, 4.9), (3.1, 2.02, 4.1), (3.1, 2.98, 4.1)]
    outside = [(2.9, 2.5, 4.5), (4.0, 2.5, 3.9), (4.0, 1.9, 4.5), (4.0, 3.1, 4.5), (5.1, 2.5, 4.5)]
    assert is_inside(solid, jnp.asarray(inside)).all()
    assert not is_inside(solid, jnp.asarray(outside)).any()


@pytest.mark.parametrize("kind", ["grid", "impostor"])
def test_what_is_settled_by_tets_is_right(kind):
    """No point of a tet that counts as inside is outside, nor the other way round."""
    made = subdivide(scenes.impostor("cube"), 3)
    corners = world_vertices(made.mesh)[np.asarray(made.mesh.tets)]
    small = trimesh.creation.icosphere(subdivisions=3, radius=0.35).apply_translation(A)
    solid = solid_from_surface(small, 48)
    if kind == "impostor":
        move = np.eye(4) * 0.4
        move[3, 3] = 1
        solid = solid_of(compose([full()], [move]))
    full_tets, empty_tets = settled_tets(solid, corners)
    weights = np.random.default_rng(0).dirichlet(np.ones(4), (20, len(corners)))
    points = np.einsum("ntc,tcx->ntx", weights, corners).reshape(-1, 3)
    inside = np.asarray(is_inside(solid, jnp.asarray(points, jnp.float32))).reshape(20, -1)
    assert inside[:, full_tets].all() and not inside[:, empty_tets].any()
    assert empty_tets.mean() > 0.3
    assert kind == "impostor" or full_tets.any()


def test_tets_decide_first():
    half = solid_from_surface(trimesh.creation.box(bounds=[[-1, -1, -1], [0.5, 2, 2]]), 64)
    states = np.asarray(gated(subdivide(full(), 2), half, keep_inside=False).gates[0].states)
    assert {OPEN, CLOSED, MIXED} == set(states.tolist())


def test_bad_input():
    a = shape(ball_a)
    with pytest.raises(ValueError, match="color must be"):
        union(a, a, color="third")
    with pytest.raises(ValueError, match="no field to take"):
        intersection(a, FunctionSolid(ball_b), color="blend")
    with pytest.raises(ValueError, match="threshold must be"):
        solid_of(a, -1.0)
    with pytest.raises(ValueError, match="some values above"):
        solid_from_image(np.zeros((4, 4)), (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))
    with pytest.raises(ValueError, match="span a box"):
        solid_from_image(np.ones((4, 4)), (0, 0, 0), (1, 0, 0), (2, 0, 0), (0, 0, 1))
