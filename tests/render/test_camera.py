"""render.camera."""

import jax
import jax.numpy as jnp
import numpy as np
import scenes
from meshes import tet_mesh
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.render.camera import image_pixels, pixel_rays, to_local
from nimpostor_jax.types import Camera, Rays


def camera(matrix=None, width=8, height=6):
    return Camera(
        camera_to_world=jnp.eye(4) if matrix is None else jnp.asarray(matrix, jnp.float32),
        focal=jnp.array([10.0, 12.0]),
        principal=jnp.array([4.0, 3.0]),
        width=width,
        height=height,
    )


def test_axes_are_opengl():
    rays = pixel_rays(camera(), jnp.array([[4.0, 3.0], [14.0, 3.0], [4.0, 15.0]]))
    right, down = np.array([1, 0, -1]) / 2**0.5, np.array([0, -1, -1]) / 2**0.5
    assert_allclose(rays.directions, [[0, 0, -1], right, down], atol=1e-6)
    assert_array_equal(rays.origins, np.zeros((3, 3)))


def test_rays_project_back_to_their_pixels(rng):
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation * np.sign(np.linalg.det(rotation)), rng.normal(size=3)
    pixels = rng.uniform(0, 8, (20, 2))
    rays = pixel_rays(camera(matrix), jnp.asarray(pixels, jnp.float32))
    assert_allclose(np.linalg.norm(rays.directions, axis=1), 1, atol=1e-6)
    points = rays.origins + 3 * rays.directions
    seen = (np.linalg.inv(matrix) @ np.append(points, np.ones((20, 1)), axis=1).T).T
    depth = -seen[:, 2]
    assert_allclose(4 + 10 * seen[:, 0] / depth, pixels[:, 0], atol=1e-4)
    assert_allclose(3 - 12 * seen[:, 1] / depth, pixels[:, 1], atol=1e-4)


def test_batched_cameras_pair_with_pixels(rng):
    matrices = np.broadcast_to(np.eye(4), (5, 4, 4)).copy()
    matrices[:, :3, 3] = rng.normal(size=(5, 3))
    batch = jax.tree.map(lambda x: jnp.broadcast_to(x, (5, *x.shape)), camera())
    batch = batch.replace(camera_to_world=jnp.asarray(matrices, jnp.float32))
    pixels = jnp.asarray(rng.uniform(0, 6, (5, 2)), jnp.float32)
    rays = pixel_rays(batch, pixels)
    for i in range(5):
        single = pixel_rays(camera(matrices[i]), pixels[i])
        assert_allclose(rays.origins[i], single.origins, atol=1e-6)
        assert_allclose(rays.directions[i], single.directions, atol=1e-6)


def test_pixel_centres_are_at_half_integers():
    pixels = image_pixels(2, 3)
    assert pixels.shape == (2, 3, 2)
    assert_array_equal(pixels[1, 2], [2.5, 1.5])


def test_to_local_divides_distances_by_the_scale(rng):
    mesh = tet_mesh("cube")
    rays = Rays(origins=jnp.asarray(rng.normal(size=(4, 3))), directions=jnp.eye(4, 3))
    local = to_local(mesh, rays)
    t = 0.7
    world = rays.origins + t * mesh.scale * rays.directions
    assert_allclose(mesh.center + mesh.scale * (local.origins + t * local.directions), world, atol=1e-6)


def test_a_pixels_ray_has_the_same_bits_in_a_picture_and_in_a_batch(rng, optimized):
    """Of one camera, and of many that are gathered: other kernels, that fuse and divide in their own ways."""
    cameras = [scenes.camera(90, 70, position=p) for p in ((3, 1, 2), (-2, 1.5, 2), (0.5, -2.5, 1.0))]
    cameras = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    view, y, x = (rng.integers(0, count, 4096) for count in (3, 70, 90))
    picture = jax.jit(lambda camera: pixel_rays(camera, image_pixels(70, 90)))
    batch = jax.jit(lambda view, pixels: pixel_rays(jax.tree.map(lambda c: c[view], cameras), pixels + 0.5))
    found = batch(jnp.asarray(view), jnp.asarray(np.stack([x, y], axis=1)))
    pictures = [picture(jax.tree.map(lambda c, i=i: c[i], cameras)) for i in range(3)]
    for name in ("origins", "directions"):
        expected = np.stack([getattr(rays, name) for rays in pictures])[view, y, x]
        assert_array_equal(getattr(found, name), expected)
