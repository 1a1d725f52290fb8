"""edit.subdivide: a finer cage around the same field."""

import dataclasses

import jax
import numpy as np
import pytest
import scenes
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.edit.deform import deform, stretch, twist
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.renderer import render_rays

CONFIG = dataclasses.replace(
    scenes.exact(max_samples_per_ray=64),
    march=dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=64, max_entries_per_ray=6),
)
render = jax.jit(render_rays, static_argnames="config")


def rays_of(dtype="float32"):
    return pixel_rays(scenes.camera(dtype=dtype), image_pixels(9, 12).reshape(-1, 2).astype(dtype))


def region_of(impostor):
    """The tets in the lower half."""
    vertices = np.asarray(impostor.mesh.vertices)
    return vertices[np.asarray(impostor.mesh.tets)].mean(axis=1)[:, 2] < 0


@pytest.mark.parametrize(
    "local, times", [(True, 1), *(pytest.param(*c, marks=pytest.mark.slow) for c in [(False, 1), (True, 2)])]
)
def test_the_picture_stays(local, times, x64):
    made = scenes.impostor("blobs", "float64")
    fine = subdivide(made, times, region_of(made) if local else None)
    assert len(fine.mesh.tets) > 4**times * len(made.mesh.tets)
    rays = rays_of("float64")
    expected = render(made, rays, CONFIG)
    found = render(fine, rays, CONFIG)
    assert not found.overflow.any()
    # Samples are placed by the same measure: only sums along the ray are rounded differently.
    assert_allclose(found.color, expected.color, atol=1e-10)
    assert np.std(expected.color) > 0.02


def test_all_but_the_region_is_bit_identical():
    made = scenes.impostor("delaunay")
    region = np.arange(len(made.mesh.tets)) == 0
    fine = subdivide(made, 1, region)
    assert fine.tables is made.tables and fine.decoders is made.decoders
    assert_array_equal(np.asarray(fine.mesh.vertices)[: len(made.mesh.vertices)], made.mesh.vertices)
    kept = np.all(np.asarray(fine.embedding.lambdas) == np.eye(4), axis=(1, 2))
    cells = np.asarray(fine.embedding.cells)[kept]
    assert len(cells) and not region[cells].any()
    assert_array_equal(np.asarray(fine.mesh.tets)[kept], np.asarray(made.mesh.tets)[cells])
    # of neighbours, some had to be cut
    assert 0 < np.sum(~region) - len(cells) < np.sum(~region)


def test_moves_as_the_coarse_cage_until_new_vertices_do():
    made = scenes.impostor("blobs")
    fine = subdivide(made, 1)
    affine = stretch(0.0, 1.0)  # piecewise linear on both
    rays = rays_of()
    coarse_moved, fine_moved = (render(deform(x, affine), rays, CONFIG) for x in (made, fine))
    assert_allclose(fine_moved.color, coarse_moved.color, atol=2e-4)  # float32 samples near faces


def test_a_finer_cage_follows_a_curved_map_better():
    made = scenes.impostor("delaunay")
    space_map = twist(1.5)

    def error(impostor):
        """Distance of moved points from where the map takes them."""
        rest, tets = world_vertices(impostor.mesh), np.asarray(impostor.mesh.tets)
        moved = world_vertices(deform(impostor, space_map).mesh)
        rng = np.random.default_rng(0)
        weights = rng.dirichlet(np.ones(4), len(tets))
        inside, follows = (np.einsum("ti,tix->tx", weights, x[tets]) for x in (rest, moved))
        return np.linalg.norm(np.asarray(space_map(inside.astype(np.float32))) - follows, axis=1).mean()

    coarse, fine = error(made), error(subdivide(made))
    assert fine < 0.35 * coarse  # a quarter, by halved edges


def test_subdividing_again_a_moved_and_saved_one(tmp_path):
    made = deform(scenes.impostor("blobs"), twist(0.4))
    once = subdivide(made)
    save_impostor(tmp_path / "once.npz", once)
    twice = subdivide(load_impostor(tmp_path / "once.npz"))
    direct = subdivide(made, 2)
    assert_allclose(twice.mesh.vertices, direct.mesh.vertices, atol=1e-6)
    assert_allclose(twice.embedding.lambdas, direct.embedding.lambdas, atol=1e-6)
    assert_allclose(twice.rest_vertices, direct.rest_vertices, atol=1e-6)
    assert_array_equal(twice.embedding.cells, direct.embedding.cells)


def test_bad_input():
    made = scenes.impostor("cube")
    with pytest.raises(ValueError, match="must flag each of"):
        subdivide(made, 1, np.ones(3, bool))
    with pytest.raises(ValueError, match="times must be >= 0"):
        subdivide(made, -1)
