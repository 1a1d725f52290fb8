"""pipeline.novel_views: cameras between cameras, and what stands behind their pictures."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from nimpostor_jax.config import RenderConfig
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.pipeline import novel_views
from nimpostor_jax.pipeline.novel_views import poses_between, with_novel_views
from nimpostor_jax.render.frame import Frame

DISTANCE = 4.0


def dome(count: int) -> np.ndarray:
    """Level cameras all over the upper half of a sphere, looking at its centre."""
    i = np.arange(count) + 0.5
    z, azimuth = 0.9 * i / count, i * np.pi * (1 + 5**0.5)
    back = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z], axis=1)
    right = np.cross([0.0, 0, 1], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = np.stack([right, np.cross(back, right), back, DISTANCE * back], axis=2)
    return poses


def test_poses_lie_between_cameras_and_look_where_they_look(rng):
    cameras = dome(60)
    poses = poses_between(cameras, 200, rng)
    hull = ConvexHull(cameras[:, :3, 3])
    outside = poses[:, :3, 3] @ hull.equations[:, :3].T + hull.equations[:, 3]
    assert outside.max() < 1e-9
    rotations = poses[:, :3, :3]
    assert_allclose(rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (200, 1, 1)), atol=1e-9)
    assert_allclose(np.linalg.det(rotations), 1)
    # The distance of the optical axis to the centre: means of places and of rotations are not the same mean.
    axes, places = poses[:, :3, 2], poses[:, :3, 3]
    missed = np.linalg.norm(places - np.sum(places * axes, axis=1, keepdims=True) * axes, axis=1)
    assert np.median(missed) < 0.05 * DISTANCE
    apart = np.linalg.norm(places[:, None] - cameras[:, :3, 3], axis=-1).min(axis=1)
    assert np.median(apart) > 0.03 * DISTANCE  # not the cameras again


@pytest.mark.parametrize("count", [1, 2])
def test_a_camera_or_two_are_enough(count, rng):
    poses = poses_between(dome(count), 3, rng)
    assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)


def test_cameras_around_an_object_have_none_in_it_between_them(rng):
    angle = np.arange(4) * np.pi / 2
    cameras = dome(4)
    back = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    right = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    cameras[:, :3] = np.stack([right, np.cross(back, right), back, DISTANCE * back], axis=2)
    poses = poses_between(cameras, 20, rng)
    assert np.linalg.norm(poses[:, :3, 3], axis=1).min() > 0.99 * DISTANCE  # none are alike


def views(backgrounds: np.ndarray | None) -> PosedImages:
    return PosedImages(
        images=np.full((5, 2, 3, 4), 0.25, np.float32),
        camera_to_world=dome(5),
        focal=np.full((5, 2), 3.0),
        principal=np.full((5, 2), 1.0),
        names=tuple("abcde"),
        has_alpha=np.full(5, backgrounds is None),
        backgrounds=backgrounds,
    )


@pytest.fixture
def half_red(monkeypatch):
    """Renders that are half covered by red."""
    frame = Frame(
        color=np.full((2, 3, 3), [0.5, 0, 0], np.float32),
        opacity=np.full((2, 3), 0.5, np.float32),
        depth=np.ones((2, 3), np.float32),
        coarsened=np.zeros((2, 3), bool),
    )
    monkeypatch.setattr(novel_views, "frame_config", lambda impostor, camera, config: config)
    monkeypatch.setattr(novel_views, "render_frame", lambda impostor, camera, config: frame)


def test_new_views_are_premultiplied_like_the_old(half_red):
    joined = with_novel_views(views(None), None, 4, RenderConfig())
    assert len(joined) == 9 and joined.names[5] == "between_0" and joined.has_alpha.all()
    assert_allclose(joined.images[5:], np.broadcast_to([0.5, 0, 0, 0.5], (4, 2, 3, 4)))
    assert joined.backgrounds is None
    assert_allclose(joined.camera_to_world[:5], dome(5))


def test_where_backgrounds_are_known_new_views_stand_before_one(half_red):
    joined = with_novel_views(views(np.zeros((5, 2, 3, 3), np.float32)), None, 4, RenderConfig())
    behind = joined.backgrounds[5:]
    assert_allclose(joined.images[5:, ..., :3], [0.5, 0, 0] + 0.5 * behind, atol=1e-6)
    assert_allclose(joined.images[5:, ..., 3], 1)
    assert np.ptp(behind, axis=(1, 2)).max() == 0 and np.ptp(behind[:, 0, 0], axis=0).min() > 0.1
    assert not joined.has_alpha.any()


def test_none_asked_for_is_none_rendered():
    before = views(None)
    assert with_novel_views(before, None, 0, RenderConfig()) is before
