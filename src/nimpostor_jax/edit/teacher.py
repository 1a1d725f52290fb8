"""Pictures of an impostor from all around, to train another one's region on. Host code.

Axes: N views, P pixels.
"""


import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from nimpostor_jax.config import MarchConfig, RenderConfig, RetrainConfig
from nimpostor_jax.edit.region import Region
from nimpostor_jax.geometry.topology import build_in_frame, world_vertices
from nimpostor_jax.render.camera import pixel_rays
from nimpostor_jax.render.capacity import all_entries
from nimpostor_jax.render.frame import frame_config, render_frame
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import PixelPool, build_pool
from nimpostor_jax.types import Camera, NeuralImpostor, Rays, TetMesh

DISTANCE = 3.0  # of cameras from the region's middle, in its radii
FILTER_PIXELS = 1 << 16  # a call


def pictures_of(
    old: NeuralImpostor, new: NeuralImpostor, region: Region, render: RenderConfig, config: RetrainConfig
) -> PixelPool:
    """Pixels of an old impostor, seen from all around the new one's region, whose rays cross the region."""
    cameras = cameras_around(new.mesh, region, config.views, config.view_width)
    one = [jax.tree.map(lambda x, i=i: x[i], cameras) for i in range(config.views)]
    sized = frame_config(old, one[0], render)
    images = np.empty((config.views, config.view_width, config.view_width, 4), np.float32)
    for image, camera in zip(images, one, strict=True):
        frame = render_frame(old, camera, sized)
        image[..., :3], image[..., 3] = frame.color, frame.opacity
    pool, _ = build_pool(new.mesh, cameras, images, render.march)
    if region.tets.size == new.mesh.tets.shape[0]:
        return pool
    return pool.take(np.flatnonzero(_crosses(new.mesh, region, pool, render.march)))


def cameras_around(mesh: TetMesh, region: Region, count: int, width: int) -> Camera:
    """Cameras [count] whose square pictures a region fills, spread evenly over the sphere (Fibonacci's)."""
    vertices = world_vertices(mesh)
    inside = vertices[np.unique(np.asarray(mesh.tets)[np.asarray(region.tets)])]
    center = (inside.min(axis=0) + inside.max(axis=0)) / 2
    radius = float(np.linalg.norm(inside - center, axis=1).max())
    distance = max(DISTANCE * radius, 1.5 * float(np.linalg.norm(vertices - center, axis=1).max()))
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    back = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    aside = np.where(np.abs(back[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    right = np.cross(aside, back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3] = np.stack([right, np.cross(back, right), back, center + distance * back], axis=2)
    focal = width / 2 * np.sqrt(distance**2 - radius**2) / radius
    return Camera(
        camera_to_world=jnp.asarray(poses, jnp.float32),
        focal=jnp.full((count, 2), focal, jnp.float32),
        principal=jnp.full((count, 2), width / 2, jnp.float32),
        width=width,
        height=width,
    )


def _crosses(mesh: TetMesh, region: Region, pool: PixelPool, march: MarchConfig) -> Bool[np.ndarray, " P"]:
    """Whether each pixel's ray meets a tet of the region."""
    chosen = np.asarray(mesh.tets)[np.asarray(region.tets)]
    used, inverse = np.unique(chosen, return_inverse=True)
    part = build_in_frame(mesh, np.asarray(mesh.vertices)[used], inverse.reshape(-1, 4), deformed=True)
    tables = march_tables(part)
    count = len(pool.views)
    padded = np.pad(np.arange(count), (0, -count % FILTER_PIXELS), mode="edge").reshape(-1, FILTER_PIXELS)
    found = []
    for indices in padded:
        rays = _cast(pool, jnp.asarray(indices))
        entries, _ = all_entries(part, tables, rays, march)
        found.append(np.asarray(entries.holds)[:, 0] >= 0)
    return np.concatenate(found)[:count]


@jax.jit
def _cast(pool: PixelPool, indices: Int[Array, " n"]) -> Rays:
    cameras = jax.tree.map(lambda x: x[pool.views[indices]], pool.cameras)
    return pixel_rays(cameras, pool.pixels[indices] + 0.5)
