"""preprocess.surroundings: where cameras look, and the colour behind the object, on analytic scenes."""

import numpy as np
import pytest
from captures import dome, moved, similarity
from numpy.testing import assert_allclose
from posed_balls import CAMERA_DISTANCE, look_at_origin, spread_directions

from nimpostor_jax.preprocess.surroundings import (
    Region,
    Surroundings,
    estimate_surroundings,
    fibonacci_sphere,
    pixel_directions,
    region_from_cameras,
)

SIDE, FOV = 48, 0.9
FOCAL = 0.5 * SIDE / np.tan(0.5 * FOV)


def cameras(count=40, world=None):
    poses = look_at_origin(spread_directions(count))
    poses = poses if world is None else moved(poses, *world)
    return poses, np.full((count, 2), FOCAL), np.full((count, 2), 0.5 * SIDE)


def photographs(poses, focal, principal, region, background):
    """The background, and a grey ball that fills the region."""
    images = []
    for pose, f, c in zip(poses, focal, principal, strict=True):
        directions = pixel_directions(pose, f, c, SIDE, SIDE)
        seen = region.is_missed(pose[:3, 3], directions)
        images.append(np.where(seen[..., None], background(directions), 0.3))
    return np.stack(images)


@pytest.mark.parametrize("world", [None, similarity(), similarity(1, 1e-3, (0.5, 0, 0))])
def test_the_region_is_the_ball_that_fits_the_frames(world):
    poses, focal, principal = cameras(world=world)
    region = region_from_cameras(poses, focal, principal, SIDE, SIDE)
    _, scale, shift = similarity() if world is None else world
    scale, shift = (1.0, np.zeros(3)) if world is None else (scale, shift)
    radius = scale * CAMERA_DISTANCE * np.sin(0.5 * FOV)  # touches the frame's edges
    expected = np.stack([shift - radius, shift + radius])
    assert_allclose(region.bounds, expected, atol=1e-9 * max(1, np.abs(shift).max()))


def test_an_odd_principal_point_makes_the_ball_smaller():
    poses, focal, principal = cameras()
    region = region_from_cameras(poses, focal, principal - [6, 0], SIDE, SIDE)
    nearest = np.arctan((0.5 * SIDE - 6) / FOCAL)  # of the frame's edges
    assert_allclose(np.ptp(region.bounds, axis=0), 2 * CAMERA_DISTANCE * np.sin(nearest), rtol=1e-9)


def test_some_close_ups_do_not_change_the_region():
    poses, focal, principal = cameras()
    poses[:8, :3, 3] *= 0.4
    region = region_from_cameras(poses, focal, principal, SIDE, SIDE)
    assert_allclose(region.upper, CAMERA_DISTANCE * np.sin(0.5 * FOV), rtol=1e-9)


def test_cameras_that_look_at_nothing_are_refused():
    poses, focal, principal = cameras()
    parallel = poses.copy()
    parallel[:, :3, :3] = poses[0, :3, :3]
    with pytest.raises(ValueError, match=r"optical axes of the 40 cameras are nearly parallel.*--box"):
        region_from_cameras(parallel, focal, principal, SIDE, SIDE)
    outward = poses.copy()
    outward[:, :3, [0, 2]] *= -1
    with pytest.raises(ValueError, match=r"40 of 40 cameras look away.*first: view0.*--box"):
        region_from_cameras(outward, focal, principal, SIDE, SIDE, [f"view{i}" for i in range(40)])
    with pytest.raises(ValueError, match="is out of most frames"):
        region_from_cameras(poses, focal, principal - [40, 0], SIDE, SIDE)


@pytest.mark.parametrize("is_ball", [True, False])
def test_missed_rays_against_points_along_them(is_ball):
    """Rays from outside, from inside and from a face's plane, against dense points on each ray."""
    region = Region(np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 1.0]), is_ball)
    directions = spread_directions(400)
    directions[:3] = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]
    for origin in ([3.0, 0.4, -0.2], [0.1, 0.0, 0.2], [-3.0, 0.5, 0.0]):
        t = np.linspace(0, 5, 1501)
        points = np.array(origin) + t[:, None, None] * directions
        reach = np.linalg.norm(points, axis=-1) if is_ball else np.abs(points).max(axis=-1)
        nearest = reach.min(axis=0)
        sure = np.abs(nearest - 1) > 4e-3  # the points' spacing
        assert sure.mean() > 0.9
        missed = region.is_missed(np.array(origin), directions)
        np.testing.assert_array_equal(missed[sure], (nearest > 1)[sure])


def test_the_dome_is_found_behind_the_ball():
    poses, focal, principal = cameras(world=similarity())
    region = region_from_cameras(poses, focal, principal, SIDE, SIDE)
    images = photographs(poses, focal, principal, region, dome)
    found = estimate_surroundings(images, poses, focal, principal, region)
    assert 0.3 < found.known_share < 0.9  # the ball fills the frames but for their corners
    behind = found(spread_directions(3000))
    error = np.abs(behind - dome(spread_directions(3000)))
    # The colour changes by about 0.03 across a bin of two pixels, and by more across a hole.
    assert np.median(error) < 0.01
    assert error.max() < 0.12
    assert np.abs(behind - 0.3).min(axis=1).max() > 0.1  # nothing is the ball's grey all over


def test_a_moving_stranger_does_not_matter():
    """One view in ten shows something else beside the region: the median does not move."""
    poses, focal, principal = cameras(80)
    region = region_from_cameras(poses, focal, principal, SIDE, SIDE)
    region = Region(0.6 * region.lower, 0.6 * region.upper, True)
    images = photographs(poses, focal, principal, region, lambda d: np.full(d.shape, 0.7))
    images[::10, :8] = 0.0
    found = estimate_surroundings(images, poses, focal, principal, region)
    assert np.mean(np.abs(found(spread_directions(2000)) - 0.7) < 0.02) > 0.95


def test_frames_that_the_object_may_fill_are_an_error():
    poses, focal, principal = cameras()
    everything = Region(np.full(3, -3.0), np.full(3, 3.0))
    with pytest.raises(ValueError, match="every pixel of the 40 images may show the object"):
        estimate_surroundings(np.zeros((40, SIDE, SIDE, 3)), poses, focal, principal, everything)


def test_the_cube_map_has_no_seams():
    """A linear colour, sampled around the cube's edges and corners."""
    poses, focal, principal = cameras(60)
    region = Region(np.full(3, -0.5), np.full(3, 0.5), True)

    def linear(d):
        return 0.5 + 0.3 * d

    images = photographs(poses, focal, principal, region, linear)
    found = estimate_surroundings(images, poses, focal, principal, region)
    edges = np.array([[1, 1, 0.3], [1, -1, -0.2], [1, 1, 1], [-1, 0.999, 1], [-1, 1.001, 1]])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    assert_allclose(found(edges), linear(edges), atol=0.03)  # a bin's width times the slope
    assert isinstance(found, Surroundings)


def test_bins_are_even():
    points = fibonacci_sphere(2000)
    distance = np.sort(np.linalg.norm(points[:, None] - points[None, ::50], axis=-1), axis=0)[1]
    assert distance.min() > 0.6 * distance.max()
