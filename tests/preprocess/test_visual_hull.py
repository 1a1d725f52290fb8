import numpy as np
import pytest
from posed_balls import posed_balls

from nimpostor_jax.preprocess import visual_hull as module
from nimpostor_jax.preprocess.visual_hull import visual_hull


def occupied_at(grid, points):
    index = np.rint((np.asarray(points) - grid.origin) / grid.voxel_size).astype(int)
    inside = ((index >= 0) & (index < grid.occupied.shape)).all(axis=-1)
    return inside & grid.occupied[tuple(np.where(inside[:, None], index, 0).T)]


def points_in_ball(center, radius, count=2000):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3))
    points *= radius * rng.random((count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1)[:, None]
    return np.asarray(center) + points


def test_hull_contains_the_object_and_little_more():
    center, radius = np.array([0.3, -0.1, 0.2]), 0.6
    grid = visual_hull(*posed_balls([(center, radius)]), resolution=64)
    assert occupied_at(grid, points_in_ball(center, radius)).all()
    # Slack of carving: 2 half pixel diagonals at distance 4.6 (0.13), a voxel's radius (0.02) and
    # that of the hull of 24 views against the ball (0.01).
    assert np.linalg.norm(grid.centers - center, axis=1).max() < radius + 0.2
    assert np.abs(grid.bounds.mean(axis=0) - center).max() < 0.05


@pytest.mark.parametrize("scale", [0.05, 1.0])
def test_box_is_found_for_small_and_large_objects(scale):
    masks, poses, focal, principal = posed_balls([((0, 0, 0), 1.0)])
    poses[:, :3, 3] *= scale
    poses[:, :3, 3] += [20.0, -3.0, 7.0]
    grid = visual_hull(masks, poses, focal, principal, resolution=32)
    expected = np.array([20.0, -3.0, 7.0]) + scale * np.array([[-1.0], [1.0]])
    # As above at 32 voxels: 0.2 on each side, and one voxel of 0.08.
    assert np.abs(grid.bounds - expected).max() < 0.3 * scale


def test_tiny_separate_parts_stay():
    small = ((0.9, 0.0, 0.0), 0.03)  # less than a pixel and about a voxel wide
    grid = visual_hull(*posed_balls([((-0.3, 0, 0), 0.4), small], side=96), resolution=48)
    assert occupied_at(grid, np.array([small[0]])).all()


def test_a_point_out_of_frame_is_not_carved_by_that_image():
    ball = ((0.0, 0.0, 0.0), 0.5)
    masks, poses, focal, principal = posed_balls([ball], count=16)
    # Two frames are shifted until they crop the object: what they do not see must stay.
    cropped = masks.copy()
    shift = 28  # of 64 pixels
    for i in (3, 9):
        cropped[i] = 0
        cropped[i, :, shift:] = masks[i, :, :-shift]
        principal[i, 0] += shift
    grid = visual_hull(cropped, poses, focal, principal, resolution=48)
    assert occupied_at(grid, points_in_ball(*ball)).all()


def test_faint_alpha_is_foreground():
    masks, *cameras = posed_balls([((0, 0, 0), 0.5)], count=12, side=32)
    solid = visual_hull(masks, *cameras, resolution=24)
    faint = visual_hull(masks * np.float32(1 / 255), *cameras, resolution=24)
    np.testing.assert_array_equal(solid.occupied, faint.occupied)


def test_blocks_and_single_voxels_agree_up_to_rounding(monkeypatch):
    views = posed_balls([((0.2, 0, 0), 0.5), ((-0.7, 0.3, 0), 0.1)], count=12, side=48)
    prepared = [module._view(*parts) for parts in zip(*views, strict=True)]
    box = np.full(3, -1.0), np.full(3, 1.0)  # 32 voxels a side are whole blocks of 8
    blocks = module._carve(prepared, *box, 32)
    monkeypatch.setattr(module, "_BLOCK", 1)
    single = module._carve(prepared, *box, 32)
    assert blocks.occupied.shape == single.occupied.shape == (32, 32, 32)
    # A block is rounded to a pixel once, its voxels each: it may carve a few more, never fewer.
    assert not (blocks.occupied & ~single.occupied).any()
    assert blocks.occupied.sum() > 0.95 * single.occupied.sum()
    assert occupied_at(blocks, points_in_ball((0.2, 0, 0), 0.5)).all()


def test_large_masks_are_pooled_without_losing_foreground():
    mask = np.zeros((700, 601), bool)
    mask[699, 600] = mask[0, 0] = True
    view = module._view(mask, np.eye(4), np.array([500.0, 500.0]), np.array([300.0, 350.0]))
    assert view.distance.shape == (350, 301)
    assert view.distance[349, 300] <= 0 and view.distance[0, 0] <= 0
    assert view.distance[100, 100] > 0
    np.testing.assert_allclose(view.focal, 250.0)


def test_empty_mask_is_named():
    masks, *cameras = posed_balls([((0, 0, 0), 0.5)], count=6, side=32)
    masks[4] = 0
    with pytest.raises(ValueError, match=r"mask of image 4 \(r_4\) is empty"):
        visual_hull(masks, *cameras, names=[f"r_{i}" for i in range(6)])


def test_opaque_images_do_not_bound_an_object():
    masks, *cameras = posed_balls([((0, 0, 0), 0.5)], count=8, side=32)
    with pytest.raises(ValueError, match=r"8 of 8 masks have no background \(first: image 0\)"):
        visual_hull(np.ones_like(masks), *cameras)


def test_views_from_one_side_do_not_bound_an_object():
    masks, poses, *intrinsics = posed_balls([((0, 0, 0), 0.5)], count=2, side=32)
    with pytest.raises(ValueError, match="same direction: their masks do not bound the object"):
        visual_hull(masks[[0, 0]], poses[[0, 0]], *intrinsics)


def test_disagreeing_cameras_are_an_error():
    masks, poses, focal, principal = posed_balls([((0.9, 0, 0), 0.1)], count=12)
    poses[:, :3, :3] = poses[:, :3, :3] @ np.diag([1.0, -1.0, -1.0])  # OpenCV axes
    with pytest.raises(ValueError, match=r"check the camera convention|do not bound"):
        visual_hull(masks, poses, focal, principal)


def test_bad_shapes_and_values_are_named():
    masks, poses, focal, principal = posed_balls([((0, 0, 0), 0.5)], count=4, side=16)
    with pytest.raises(ValueError, match="at least 2 masks"):
        visual_hull(masks[:1], poses[:1], focal[:1], principal[:1])
    with pytest.raises(ValueError, match="focal must have shape"):
        visual_hull(masks, poses, focal[:, :1], principal)
    poses[2, 0, 3] = np.nan
    with pytest.raises(ValueError, match="camera_to_world of image 2 is not finite"):
        visual_hull(masks, poses, focal, principal)
