"""edit.appearance: paints change colours inside a solid, and nothing else."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from nimpostor_jax.config import RetrainConfig
from nimpostor_jax.edit.appearance import recolored, uniform, with_material
from nimpostor_jax.edit.boolean import gated
from nimpostor_jax.edit.compose import compose
from nimpostor_jax.edit.deform import deform, rigid
from nimpostor_jax.edit.remesh import consolidate
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.io.impostor_file import load_impostor, save_impostor
from nimpostor_jax.preprocess.patterns import solid_from_surface
from nimpostor_jax.render.camera import image_pixels, pixel_rays
from nimpostor_jax.render.occupancy import num_cells
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.types import FunctionSolid, Rays

CONFIG = dataclasses.replace(
    scenes.exact(max_samples_per_ray=64),
    march=dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=24, max_entries_per_ray=4),
)
RED = np.array([1.0, 0.25, 0.0])
ROUNDING = 1e-6  # of float32 opacities: XLA fuses programs with and without paints differently
render = jax.jit(render_rays, static_argnames="config")


def everywhere(points):
    return jnp.ones(points.shape[0])


def lower(points):
    return 0.5 - points[:, 2]


def beside(points):
    return points[:, 0] - 0.5


def rays_of():
    return pixel_rays(scenes.camera(), image_pixels(9, 12).reshape(-1, 2))


def test_colours_inside_are_multiplied_and_densities_stay():
    made, rays = scenes.impostor("cube"), rays_of()
    before = render(made, rays, CONFIG)
    after = render(recolored(made, FunctionSolid(everywhere), RED), rays, CONFIG)
    assert_allclose(after.opacity, before.opacity, atol=ROUNDING)
    assert_allclose(after.color, np.asarray(before.color) * RED, atol=1e-6)
    half = render(recolored(made, FunctionSolid(lower), RED), rays, CONFIG)
    # one colour channel of each sample is multiplied by 0.25 or 1
    ratio = np.asarray(half.color[:, 1]) / np.maximum(before.color[:, 1], 1e-9)
    seen = np.asarray(before.opacity) > 0.05
    assert ratio[seen].min() > 0.25 - 1e-5 and ratio[seen].max() < 1 + 1e-5
    assert np.ptp(ratio[seen]) > 0.3


def test_paints_follow_the_cage_and_survive_everything_else(tmp_path):
    made = recolored(scenes.impostor("cube"), FunctionSolid(lower), RED)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    rays = rays_of()
    moved = Rays(
        origins=rays.origins @ jnp.asarray(turn.T, jnp.float32) + 2.0,
        directions=rays.directions @ jnp.asarray(turn.T, jnp.float32),
    )
    config = dataclasses.replace(CONFIG, directions="rest")
    expected = render(made, rays, config).color
    turned = deform(subdivide(made), rigid(turn, np.full(3, 2.0)))
    far = np.eye(4)
    far[0, 3] = 40.0
    for each in (turned, compose([scenes.impostor("cube"), turned], [far, None])):
        assert_allclose(render(each, moved, config).color, expected, atol=2e-3)  # float32, 40 away
    grid = solid_from_surface(trimesh.creation.icosphere(radius=0.6), 32)
    saved = with_material(made, grid, scenes.impostor("cube", seed=1), 0.5)
    save_impostor(tmp_path / "painted.npz", dataclasses.replace(saved, paints=saved.paints[1:]))
    loaded = load_impostor(tmp_path / "painted.npz")
    assert_array_equal(
        render(loaded, rays, CONFIG).color,
        render(dataclasses.replace(saved, paints=saved.paints[1:]), rays, CONFIG).color,
    )


def test_paints_and_gates_are_the_same_in_one_pass_and_in_two(rng):
    """On a cage finer than the field's, with cells left out: the first pass drops only what is not seen."""
    made = recolored(scenes.impostor("cube"), FunctionSolid(lower), RED)
    cells = jnp.asarray(rng.uniform(size=(len(made.mesh.tets), num_cells(4))) < 0.5)
    made = gated(dataclasses.replace(made, occupied=cells), FunctionSolid(beside), keep_inside=True)
    once = render(subdivide(made), rays_of(), CONFIG)
    twice = render(subdivide(made), rays_of(), dataclasses.replace(CONFIG, min_weight=1e-6))
    assert_allclose(twice.color, once.color, atol=1e-4)  # 64 samples of 1e-6
    assert 0.1 < np.mean(np.asarray(once.opacity) > 0.05) < 0.9


def test_a_material_lends_its_colours_to_another_shape():
    shape, material, rays = scenes.impostor("cube"), scenes.impostor("cube", seed=5), rays_of()
    painted = with_material(shape, FunctionSolid(everywhere), material)
    # Same cage: what the material's field has at the same samples, under the shape's densities.
    borrowed = render(painted, rays, CONFIG)
    assert_allclose(borrowed.opacity, render(shape, rays, CONFIG).opacity, atol=ROUNDING)
    plain = uniform(shape.mesh, (0.2, 0.4, 0.6), 1.0, shape.config)
    flat = render(with_material(shape, FunctionSolid(everywhere), plain), rays, CONFIG)
    assert_allclose(flat.color, np.asarray(flat.opacity)[:, None] * [0.2, 0.4, 0.6], atol=1e-5)
    mixed = render(with_material(shape, FunctionSolid(everywhere), plain, 0.5), rays, CONFIG)
    assert_allclose(mixed.color, (flat.color + render(shape, rays, CONFIG).color) / 2, atol=1e-5)


@pytest.mark.slow
def test_consolidated_paint():
    live = recolored(scenes.impostor("cube"), FunctionSolid(lower), RED)
    config = RetrainConfig(
        feature_steps=20, points_per_batch=4096, render_steps=400, rays_per_batch=1024, views=6, view_width=32
    )
    plain = consolidate(live, CONFIG, config, lambda _: None)
    assert not plain.paints
    rays = rays_of()
    error = np.mean((render(plain, rays, CONFIG).color - render(live, rays, CONFIG).color) ** 2)
    assert -10 * np.log10(error) > 25  # 24 dB after half of the steps, 26.7 after these


def test_bad_input():
    made = scenes.impostor("cube")
    solid = FunctionSolid(everywhere)
    with pytest.raises(ValueError, match="three finite numbers"):
        recolored(made, solid, (1, 2))
    with pytest.raises(ValueError, match="share must be"):
        with_material(made, solid, made, 1.5)
    with pytest.raises(ValueError, match=r"must be in \(0, 1\)"):
        uniform(made.mesh, (0, 0.5, 1), 1.0, made.config)
    with pytest.raises(ValueError, match="integrate must be 'color'"):
        render(recolored(made, solid, RED), rays_of(), dataclasses.replace(CONFIG, integrate="features"))
    with pytest.raises(ValueError, match="function, which no file can hold"):
        save_impostor("never.npz", recolored(made, solid, RED))
