"""train.pool: which pixels are trained on, and how batches are drawn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from meshes import tet_mesh
from numpy.testing import assert_allclose, assert_array_equal
from scenes import RENDER

from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.capacity import ray_entries
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import OPACITY_COST, build_pool, draw_batch

WIDTH, HEIGHT = 17, 13


@pytest.fixture(scope="module")
def views():
    """Three views of a cube: colours say view, x and y; alpha is 1 in a small middle part."""
    cameras = [scenes.camera(WIDTH, HEIGHT, position=p) for p in ((3, 1, 2), (-2, 1.5, 2), (0.5, -2.5, 1.0))]
    images = np.zeros((3, HEIGHT, WIDTH, 4), np.float32)
    images[..., 0] = np.arange(3)[:, None, None] / 10
    images[..., 1] = np.arange(HEIGHT)[:, None] / 100
    images[..., 2] = np.arange(WIDTH) / 100
    images[:, 4:6, 6:8, 3] = 1
    return jax.tree.map(lambda *x: jnp.stack(x), *cameras), images


@pytest.fixture(scope="module")
def pool(views):
    return build_pool(tet_mesh("cube"), *views, RENDER.march)


def test_the_pool_holds_the_pixels_that_hit_the_cage(pool, views):
    pixels, missed = pool
    cameras, images = views
    count = len(pixels.views)
    assert 0 < count < images[..., 0].size
    assert missed == 0
    assert len(np.unique(np.column_stack([pixels.views, pixels.pixels]), axis=0)) == count
    x, y = np.asarray(pixels.pixels).T
    assert_array_equal(pixels.colors, images[np.asarray(pixels.views), y, x])
    mesh = tet_mesh("cube")
    of_each = jax.tree.map(lambda leaf: leaf[pixels.views], cameras)
    rays = pixel_rays(of_each, pixels.pixels + 0.5)
    assert np.all(ray_entries(mesh, march_tables(mesh), rays, RENDER.march).holds[:, 0] >= 0)


def test_foreground_outside_the_cage_is_counted(views):
    cameras, images = views
    solid = images.copy()
    solid[..., 3] = 0
    solid[0, 0, 0, 3] = solid[0, 5, 7, 3] = 1  # a corner of the picture misses, the middle hits
    _, missed = build_pool(tet_mesh("cube"), cameras, solid, RENDER.march)
    assert missed == 0.5


def test_cameras_that_miss_the_cage_are_an_error(views):
    cameras, images = views
    elsewhere = dataclasses.replace(cameras, camera_to_world=cameras.camera_to_world.at[:, :3, 3].add(100.0))
    with pytest.raises(ValueError, match="hits the cage"):
        build_pool(tet_mesh("cube"), elsewhere, images, RENDER.march)


def test_a_batch_is_a_function_of_key_and_step(pool):
    pixels, key = pool[0], jax.random.key(0)
    batch = draw_batch(key, 3, pixels, 40, "random")
    for a, b in zip(
        jax.tree.leaves(batch),
        jax.tree.leaves(draw_batch(key, jnp.asarray(3), pixels, 40, "random")),
        strict=True,
    ):
        assert_array_equal(a, b)
    for other in (
        draw_batch(key, 4, pixels, 40, "random"),
        draw_batch(jax.random.key(1), 3, pixels, 40, "random"),
    ):
        assert np.mean(np.asarray(other.target[:, :3] == batch.target[:, :3]).all(axis=1)) < 0.5
        assert not np.any(np.asarray(other.jitter) == np.asarray(batch.jitter))


def test_a_batchs_rays_are_those_whose_entries_were_found(pool, views, optimized):
    """To the last bit, though views are cast one by one and batches from many cameras, in other programs."""
    pixels, _ = pool
    cameras, _ = views
    batch = draw_batch(jax.random.key(0), 0, pixels, 60, "white")
    colors = np.asarray(batch.target)
    view, y, x = (np.round(colors[:, i] * s).astype(int) for i, s in ((0, 10), (1, 100), (2, 100)))
    cast = jax.jit(lambda camera: pixel_rays(camera, image_pixels(HEIGHT, WIDTH)))
    of_views = [cast(jax.tree.map(lambda leaf, i=i: leaf[i], cameras)) for i in range(3)]
    for name in ("origins", "directions"):
        expected = np.stack([getattr(rays, name) for rays in of_views])[view, y, x]
        assert_array_equal(getattr(batch.rays, name), expected)
    assert np.all((batch.jitter >= 0) & (batch.jitter < 1))
    assert len(np.unique(view)) == 3


@pytest.mark.parametrize("background, value", [("white", 1.0), ("black", 0.0)])
def test_plain_backgrounds(pool, background, value):
    assert_array_equal(
        draw_batch(jax.random.key(0), 0, pool[0], 8, background).background, np.full((8, 3), value)
    )


def test_known_backgrounds_stand_behind_their_pixels(views):
    cameras, images = views
    behind = 1 - images[..., :3]
    known = build_pool(tet_mesh("cube"), cameras, images, RENDER.march, behind)[0]
    batch = draw_batch(jax.random.key(0), 0, known, 60, "random")
    # Each of the cube's views has its own colours: those behind a pixel belong to its target.
    assert_allclose(batch.background, 1 - batch.target[:, :3], atol=1e-6)
    assert_array_equal(batch.opacity_cost, np.full(60, OPACITY_COST, np.float32))


def test_known_alpha_has_no_opacity_cost(pool):
    assert draw_batch(jax.random.key(0), 0, pool[0], 8, "white").opacity_cost is None


def test_random_backgrounds_cover_the_range(pool):
    colors = np.asarray(draw_batch(jax.random.key(0), 0, pool[0], 400, "random").background)
    assert colors.shape == (400, 3)
    assert colors.min() < 0.05
    assert colors.max() > 0.95


def test_a_batch_has_the_entries_of_its_rays():
    """Into a cage with gaps, which rays enter once or several times; of all pixels, and of some."""
    mesh = tet_mesh("nonconvex")
    places = ((4.0, 9.0, 1.2), (1.6, 1.4, 9.0))
    cameras = [scenes.camera(WIDTH, HEIGHT, position=p, target=(1.4, 1.4, 1.0)) for p in places]
    images = np.zeros((2, HEIGHT, WIDTH, 4), np.float32)
    images[..., 0], images[..., 1] = np.arange(2)[:, None, None], np.arange(WIDTH) / WIDTH
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *cameras)
    whole, _ = build_pool(mesh, stacked, images, RENDER.march, images[..., :3])
    march = dataclasses.replace(RENDER.march, max_entries_per_ray=whole.entries.slots)
    kept = np.flatnonzero(np.arange(len(whole.views)) % 3 != 1)
    for pixels in (whole, whole.take(kept)):
        batch = draw_batch(jax.random.key(0), 0, pixels, 200, "white")
        expected = ray_entries(mesh, march_tables(mesh), batch.rays, march)
        jax.tree.map(assert_array_equal, batch.entries, expected)
        assert_array_equal(batch.background, batch.target[:, :3])
        counts = np.sum(np.asarray(batch.entries.holds) >= 0, axis=1)
        assert counts.min() == 1 and counts.max() == whole.entries.slots > 1
        assert set(np.asarray(pixels.views)) == {0, 1}
    assert_array_equal(pixels.colors, np.asarray(whole.colors)[kept])
