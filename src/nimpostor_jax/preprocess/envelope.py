"""Envelope: a closed, outward-oriented triangle surface at a distance around an object.

The object is an occupancy grid (`visual_hull`) or a closed surface, which is voxelised first. The
envelope is a level set of the exact Euclidean distance to the occupied voxels' centres, so it
contains every part of the object, joins parts nearer than twice the offset, and cannot cross
itself. World units.
"""

import math

import numpy as np
import trimesh
from jaxtyping import Float
from scipy import ndimage
from skimage import measure

from nimpostor_jax.preprocess.surface import check_surface
from nimpostor_jax.preprocess.visual_hull import OccupancyGrid

# From a voxel's centre to its corner, in voxels, and a little for the interpolation of distances.
_CELL_REACH = 0.5 * math.sqrt(3.0) + 0.1


def envelope_from_grid(
    grid: OccupancyGrid, offset: float, step: float | None = None
) -> trimesh.Trimesh:
    """Surface at `offset` from the occupied voxels, with triangles of about `step` (None: a voxel).

    Cavities are filled. An offset below the reach of a voxel's corners is raised to it, so that the
    object inside the voxels is contained.

    Raises:
        ValueError: the grid has no occupied voxel.
    """
    if not grid.occupied.any():
        raise ValueError(
            f"the occupancy grid {grid.occupied.shape} is empty: there is nothing to enclose"
        )
    # Squared distances between voxels are whole numbers; a level between two of them meets no
    # sample, where marching cubes would leave degenerate triangles.
    squared = max(offset / grid.voxel_size, _CELL_REACH) ** 2
    offset = grid.voxel_size * math.sqrt(math.floor(squared + 0.5) + 0.5)  # rounded up
    stride = max(1.0, (step or 0.0) / grid.voxel_size)
    # Two samples of the coarser grid beyond the level, so that the level set closes within the
    # array.
    padding = math.ceil(offset / grid.voxel_size + 2.0 * stride) + 1
    solid = ndimage.binary_fill_holes(np.pad(grid.occupied, padding))
    distance = ndimage.distance_transform_edt(~solid, sampling=grid.voxel_size)
    if stride > 1.0:
        distance = _resample(distance, stride)
    vertices, faces, _, _ = measure.marching_cubes(distance, offset, gradient_direction="ascent")
    surface = trimesh.Trimesh(grid.origin + grid.voxel_size * (stride * vertices - padding), faces)
    if surface.volume < 0:
        surface.invert()
    return surface


def _resample(values: Float[np.ndarray, "X Y Z"], stride: float) -> Float[np.ndarray, "x y z"]:
    """Linear interpolation at every `stride`-th voxel; the last sample may lie past the end."""
    counts = [math.ceil((size - 1) / stride) + 1 for size in values.shape]
    axes = [np.arange(count) * stride for count in counts]
    return ndimage.map_coordinates(
        values, np.meshgrid(*axes, indexing="ij"), order=1, mode="nearest"
    )


def voxelize_surface(
    surface: trimesh.Trimesh,
    resolution: int = 128,
    source: str = "surface",
    allow_self_intersections: bool = False,
) -> OccupancyGrid:
    """Voxels that a closed surface touches or encloses, `resolution` along the longest side.

    Raises:
        ValueError: the surface is empty, non-finite, open or self-intersecting (`check_surface`).
    """
    check_surface(surface, source, allow_self_intersections)
    lower, upper = surface.bounds
    voxel_size = float((upper - lower).max()) / resolution
    shape = np.maximum(np.ceil((upper - lower) / voxel_size - 1e-9).astype(int), 1)
    origin = 0.5 * (lower + upper) - 0.5 * voxel_size * (shape - 1)
    # Corners of triangles smaller than half a voxel leave no gap that a flood could pass.
    points, _ = trimesh.remesh.subdivide_to_size(
        surface.vertices, surface.faces, max_edge=0.5 * voxel_size, max_iter=20
    )
    index = np.clip(np.rint((points - origin) / voxel_size).astype(int), 0, shape - 1)
    occupied = np.zeros(shape, bool)
    occupied[tuple(index.T)] = True
    return OccupancyGrid(ndimage.binary_fill_holes(occupied), origin, voxel_size)


def envelope_from_surface(
    surface: trimesh.Trimesh,
    offset: float,
    resolution: int = 128,
    step: float | None = None,
    source: str = "surface",
) -> trimesh.Trimesh:
    """Surface at `offset` from a closed surface and its inside; errors as in `voxelize_surface`."""
    return envelope_from_grid(voxelize_surface(surface, resolution, source), offset, step)
