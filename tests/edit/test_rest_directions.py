"""View directions in the rest frames of tets: what turns with its cage looks the same."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from nimpostor_jax.edit.deform import deform, rigid, twist
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.types import Rays

render = jax.jit(render_rays, static_argnames="config")
ROTATION = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
SHIFT = np.array([0.3, -0.2, 0.5])


def config_of(integrate, directions="rest"):
    march = dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=32, max_entries_per_ray=6)
    return dataclasses.replace(
        scenes.exact(max_samples_per_ray=64), march=march, integrate=integrate, directions=directions
    )


def rays_of():
    return pixel_rays(scenes.camera(), image_pixels(9, 12).reshape(-1, 2))


@pytest.mark.parametrize("integrate", ["color", pytest.param("features", marks=pytest.mark.slow)])
def test_a_rigid_motion_of_object_and_camera_changes_nothing(integrate):
    made, rays = subdivide(scenes.impostor("blobs")), rays_of()
    turned = deform(made, rigid(ROTATION, SHIFT))
    moved = Rays(
        origins=rays.origins @ jnp.asarray(ROTATION.T, jnp.float32) + jnp.asarray(SHIFT, jnp.float32),
        directions=rays.directions @ jnp.asarray(ROTATION.T, jnp.float32),
    )
    expected = render(made, rays, config_of(integrate)).color
    assert_allclose(render(turned, moved, config_of(integrate)).color, expected, atol=1e-4)
    world = render(turned, moved, config_of(integrate, "world")).color
    assert np.abs(world - expected).max() > 0.02  # the field does depend on the direction


@pytest.mark.parametrize("directions", ["world", "rest"])
def test_the_identity_is_bit_identical(directions):
    made, rays = scenes.impostor("blobs", offset=0.37), rays_of()
    same = deform(made, lambda points: points)
    assert_array_equal(same.mesh.vertices, made.mesh.vertices)
    config = config_of("color", directions)
    assert_array_equal(render(same, rays, config).color, render(made, rays, config).color)


def test_gradients_of_vertices_match_differences(x64):
    made = scenes.impostor("cube", "float64")
    rays = Rays(
        origins=jnp.array([[0.31, 0.27, 3.0], [0.62, 0.41, 3.0]]), directions=jnp.array([[0, 0.05, -1.0]] * 2)
    )
    rays = dataclasses.replace(
        rays, directions=rays.directions / jnp.linalg.norm(rays.directions, axis=1, keepdims=True)
    )
    start = deform(made, twist(0.3))
    change = jnp.asarray(np.random.default_rng(0).normal(size=start.mesh.vertices.shape))

    def value(step):
        mesh = dataclasses.replace(start.mesh, vertices=start.mesh.vertices + step * change)
        output = render(dataclasses.replace(start, mesh=mesh), rays, config_of("color"))
        return jnp.sum(jnp.sin(3 * output.color))

    difference = (value(1e-6) - value(-1e-6)) / 2e-6
    assert_allclose(jax.grad(value)(0.0), difference, rtol=1e-5)


def test_inverted_and_flat_tets_are_no_nan():
    made = scenes.impostor("blobs")
    crushed = deform(made, lambda x: x * jnp.array([1.0, 1.0, 0.0]))
    folded = deform(made, lambda x: x.at[0].add(jnp.array([2.0, 2.0, 2.0])))
    for each in (crushed, folded):
        output = render(each, rays_of(), config_of("color"))
        assert np.isfinite(output.color).all()
