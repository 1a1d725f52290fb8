"""Posed alpha masks of balls, exact up to the pixel grid, for the tests of this folder."""

import numpy as np

CAMERA_DISTANCE = 4.0


def look_at_origin(directions):
    """Camera-to-world matrices (OpenGL axes) of cameras that look at the origin."""
    poses = []
    for direction in np.asarray(directions, float):
        back = direction / np.linalg.norm(direction)
        up = np.array([0.0, 0.0, 1.0]) if abs(back[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
        pose[:3, 3] = CAMERA_DISTANCE * back
        poses.append(pose)
    return np.stack(poses)


def spread_directions(count):
    """A Fibonacci spiral over the whole sphere."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    angle = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def pixel_rays(pose, focal, principal, side):
    """Origin [3] and unit directions [side, side, 3] of one camera's pixel centres."""
    x, y = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    local = np.stack(
        [(x - principal[0]) / focal[0], -(y - principal[1]) / focal[1], -np.ones_like(x)], axis=-1
    )
    directions = local @ pose[:3, :3].T
    return pose[:3, 3], directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def posed_balls(balls, count=24, side=64, fov=0.7):
    """Masks, camera-to-world, focal and principal of `count` views of (center, radius) balls."""
    poses = look_at_origin(spread_directions(count))
    focal = np.full((count, 2), 0.5 * side / np.tan(0.5 * fov))
    principal = np.full((count, 2), 0.5 * side)
    masks = np.zeros((count, side, side), np.float32)
    for i in range(count):
        origin, directions = pixel_rays(poses[i], focal[i], principal[i], side)
        for center, radius in balls:
            offset = np.asarray(center, float) - origin
            along = directions @ offset
            masks[i] = np.maximum(masks[i], (offset @ offset - along**2 < radius**2) & (along > 0))
    return masks, poses, focal, principal
