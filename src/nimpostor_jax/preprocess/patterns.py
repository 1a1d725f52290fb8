"""Patterns for Boolean operations and blending: closed surfaces and pictures as solids on a grid.

Values are signed distances in voxels, positive inside, zero halfway between a voxel inside and one outside.
World units, float64 on the host.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike
from scipy import ndimage

from nimpostor_jax.preprocess.envelope import voxelize_surface
from nimpostor_jax.preprocess.surface import load_surface
from nimpostor_jax.types import GridSolid


def solid_from_surface(
    surface: str | Path | trimesh.Trimesh, resolution: int = 128, allow_self_intersections: bool = False
) -> GridSolid:
    """A closed surface (file or trimesh) as a solid, exact to a voxel: 1 / `resolution` of its longest side.

    Cavities are filled: subtract a solid of their own where they matter.
    Raises FileNotFoundError and ValueError as `preprocess.cage.cage_from_surface`.
    """
    source = "surface" if isinstance(surface, trimesh.Trimesh) else str(surface)
    mesh = surface if isinstance(surface, trimesh.Trimesh) else load_surface(surface)
    grid = voxelize_surface(mesh, resolution, source, allow_self_intersections)
    # Voxels that the surface touches count as occupied: half a voxel too many on each side.
    values = signed_distances(grid.occupied) - 0.5
    if not values.max() > 0:
        raise ValueError(
            f"{source}: nothing of it is thicker than two voxels of {grid.voxel_size:g}; "
            f"raise the resolution ({resolution})"
        )
    return _solid(values, np.eye(3) * grid.voxel_size, grid.origin)


def solid_from_image(
    image: Float[np.ndarray, "H W"], corner: ArrayLike, right: ArrayLike, up: ArrayLike, depth: ArrayLike
) -> GridSolid:
    """A picture extruded: inside where the picture, values in [0, 1], is above 1/2.

    `corner` is the world position of its lower left corner on the front; `right`, `up` and `depth` are the
    edges [3] of the box that it fills. Raises ValueError for a picture without such pixels, or a flat box.
    """
    image = np.asarray(image)
    if image.ndim != 2 or not image.size or not (image > 0.5).any():
        raise ValueError(f"the picture must be [H, W] with some values above 0.5, got shape {image.shape}")
    edges = np.stack([np.asarray(edge, np.float64) for edge in (right, up, depth)])
    if edges.shape != (3, 3) or not abs(np.linalg.det(edges)) > 0:
        raise ValueError(f"right, up and depth must span a box, got {edges.tolist()}")
    height, width = image.shape
    inside = np.repeat((image[::-1].T > 0.5)[:, :, None], 3, axis=2)  # [right, up, depth]
    flat = signed_distances(inside[:, :, 0])
    values = np.repeat(flat[:, :, None], inside.shape[2], axis=2)
    steps = edges / np.array([[width], [height], [inside.shape[2]]])
    return _solid(values, steps, np.asarray(corner, np.float64) + steps.sum(axis=0) / 2)


def signed_distances(inside: Bool[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """In voxels, between centres, less a half: positive inside."""
    padded = np.pad(inside, 1)  # what is outside the grid is outside
    into, out = ndimage.distance_transform_edt(padded), ndimage.distance_transform_edt(~padded)
    distances = np.where(padded, into - 0.5, 0.5 - out)
    return distances[tuple(slice(1, -1) for _ in inside.shape)]


def _solid(
    values: Float[np.ndarray, "X Y Z"], steps: Float[np.ndarray, "3 3"], origin: Float[np.ndarray, " 3"]
) -> GridSolid:
    """From the world vectors between neighbouring voxels, as rows, and the centre of the first."""
    inverse = np.linalg.inv(steps.T)
    matrix = np.column_stack([inverse, -inverse @ origin])
    return GridSolid(values=jnp.asarray(values, jnp.float32), world_to_grid=jnp.asarray(matrix, jnp.float32))
