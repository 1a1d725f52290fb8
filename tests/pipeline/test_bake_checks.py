"""pipeline.bake: what is refused before long work."""

import numpy as np
import pytest

from nimpostor_jax.config import BakeConfig
from nimpostor_jax.pipeline.bake import checked_texels, face_pixels

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0, 0]])


class Views:
    camera_to_world = np.broadcast_to(np.eye(4) + 4 * np.eye(4)[:, [3, 3, 3, 3]] * [0, 0, 0, 1], (2, 4, 4))
    focal = np.full((2, 2), 100.0)


def test_faces_without_area_are_named():
    with pytest.raises(ValueError, match=r"1 faces have no area; first: that of tet 1 opposite corner 2"):
        face_pixels(CORNERS, np.array([[0, 1, 2, 3], [0, 1, 2, 4]]), Views)


def test_lengths_are_in_pixels():
    pixels = face_pixels(CORNERS, np.array([[0, 1, 2, 3]]), Views)
    distance = np.linalg.norm(Views.camera_to_world[0, :3, 3] - CORNERS.mean(axis=0))
    np.testing.assert_allclose(pixels[0], np.sqrt(2) * 100 / distance)


def test_textures_that_need_too_much_memory_are_refused():
    resolutions = np.full((1000, 4), 60)
    with pytest.raises(ValueError, match=r"need 4\d\d MB, more than BakeConfig.max_megabytes = 100"):
        checked_texels(resolutions, 14, BakeConfig(max_megabytes=100), print)


def test_an_impostor_that_shows_nothing_is_refused():
    with pytest.raises(ValueError, match="nothing is seen in any tet; train the impostor"):
        checked_texels(np.zeros((10, 4), int), 64, BakeConfig(), print)
