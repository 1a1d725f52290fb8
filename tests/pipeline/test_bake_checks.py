"""pipeline.bake: what is refused before long work, and which tets are left."""

import dataclasses
import re

import jax
import numpy as np
import pytest
import scenes
import scenes_baked
from scenes import constant_density

from nimpostor_jax.config import BakeConfig, TrainConfig
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.pipeline.bake import bake, checked_resolutions, face_pixels, only_tets, refine
from nimpostor_jax.pipeline.prepare import prepare
from nimpostor_jax.render.frame import render_frame
from nimpostor_jax.train.pool import build_pool

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]])


class Views:
    camera_to_world = np.broadcast_to(np.eye(4) + 4 * np.eye(4)[:, [3, 3, 3, 3]] * [0, 0, 0, 1], (2, 4, 4))
    focal = np.full((2, 2), 100.0)


def test_faces_without_area_are_named():
    with pytest.raises(ValueError, match=r"1 faces have no area; first: that of tet 1 opposite corner 2"):
        face_pixels(CORNERS, np.array([[0, 1, 2, 3], [0, 1, 2, 4]]), Views)


def test_lengths_are_in_pixels():
    pixels = face_pixels(CORNERS, np.array([[0, 1, 2, 3]]), Views)
    center = CORNERS[:4].mean(axis=0)  # the fifth is of no tet
    distance = np.linalg.norm(Views.camera_to_world[0, :3, 3] - center)
    np.testing.assert_allclose(pixels[0], np.sqrt(2) * 100 / distance)


def test_textures_that_need_too_much_memory_are_refused():
    """With the texels that would fit, where some would."""
    pixels, config = np.full((1000, 4), 85.0), BakeConfig(texels_per_pixel=0.7, max_megabytes=100)
    refused = r"need 4\d\d MB, more than BakeConfig.max_megabytes = 100"
    with pytest.raises(ValueError, match=refused) as caught:
        checked_resolutions(pixels, 14, config, print)
    coarser = float(re.search(r"texels_per_pixel=([\d.]+) would fit", str(caught.value))[1])
    fitting = dataclasses.replace(config, texels_per_pixel=coarser)
    assert 0.25 < coarser < 0.4  # half the texels along an edge need a quarter of the memory
    assert np.all(checked_resolutions(pixels, 14, fitting, print) == np.ceil(85 * coarser))
    with pytest.raises(ValueError, match=r"= 1; raise BakeConfig.tet_pixels, or raise the limit"):
        checked_resolutions(pixels, 140, dataclasses.replace(config, max_megabytes=1), print)


def test_an_impostor_that_shows_nothing_is_refused(config, cage):
    scene = prepare(config, "fluffy_ball", cage=cage, log=lambda _: None)
    with pytest.raises(ValueError, match="nothing is seen in any tet; train the impostor"):
        bake(constant_density(scene.impostor, -40.0), scene, BakeConfig(fit_rays=1000), log=lambda _: None)


@pytest.mark.parametrize("decoders", [False, True])
def test_refinement_gives_up_textures_and_nothing_else(decoders):
    """Other arrays of the impostor that it takes stay readable; decoders change only where asked."""
    baked = scenes_baked.baked()
    texels = baked.textures.features.shape
    cameras = jax.tree.map(lambda x: x[None], scenes.camera(24, 18, (8.0, 6.0, 5.0), (-0.9, 0.5, 0.8)))
    march = dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=24, max_entries_per_ray=3)
    pool, _ = build_pool(baked.mesh, cameras, np.full((1, 18, 24, 4), 0.5, np.float32), march)
    config = BakeConfig(refine_steps=3, refine_decoders=decoders)
    render = dataclasses.replace(scenes.RENDER, march=march)
    lines = []
    refined = refine(baked, pool, TrainConfig(rays_per_batch=64), render, config, log=lines.append)
    assert len(lines) == 1 and lines[0].startswith("refined: loss")
    assert refined.textures.features.shape == texels and np.all(np.isfinite(refined.textures.features))
    assert refined.textures.layout is baked.textures.layout  # not that of a batch's texels
    pairs = zip(jax.tree.leaves(refined.decoders), jax.tree.leaves(baked.decoders), strict=True)
    assert any(np.any(ours != theirs) for ours, theirs in pairs) == decoders
    np.testing.assert_array_equal(refined.mesh.vertices, baked.mesh.vertices)


def test_what_is_left_of_tets_keeps_its_place_in_the_field():
    """All tets: the same picture. Some: theirs alone, and the vertices stay."""
    impostor = subdivide(scenes.impostor("blobs"), 1)
    camera = scenes.camera(position=(8.0, 6.0, 5.0), target=(-0.9, 0.5, 0.8))
    march = dataclasses.replace(scenes.RENDER.march, max_tets_per_ray=64, max_entries_per_ray=8)
    config = dataclasses.replace(scenes.RENDER, march=march)
    keep = np.ones(len(impostor.mesh.tets), bool)
    whole = render_frame(impostor, camera, config)
    np.testing.assert_allclose(render_frame(only_tets(impostor, keep), camera, config).color, whole.color)
    keep[::2] = False
    part = only_tets(impostor, keep)
    np.testing.assert_array_equal(part.mesh.vertices, impostor.mesh.vertices)
    np.testing.assert_array_equal(part.mesh.tets, np.asarray(impostor.mesh.tets)[keep])
    np.testing.assert_array_equal(part.embedding.cells, np.asarray(impostor.embedding.cells)[keep])
    left = render_frame(part, camera, config)
    assert 0.1 < left.opacity.sum() / whole.opacity.sum() < 0.9
