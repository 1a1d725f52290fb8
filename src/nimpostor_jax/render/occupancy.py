"""Which parts of the tets hold anything, so that samples in empty space and within solids cost little.

Each tet is cut into cells by the integer parts of N lambda_0, N lambda_1 and N lambda_2: a grid that moves
with the tet. Training records when a cell last contributed to a pixel, and looks into all cells now and then.

Axes: T tets, C = N (N + 1) (N + 2) / 6 cells of a tet, M samples.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

SLAB_MARGIN = 1e-4  # above the rounding of coordinates, far below the width of a cell


def num_cells(resolution: int) -> int:
    """C for N parts an edge."""
    return resolution * (resolution + 1) * (resolution + 2) // 6


def cell_resolution(cells: int) -> int:
    """N for C cells a tet. Raises ValueError where no N has that many."""
    resolution = round((6 * cells) ** (1 / 3)) - 1
    if num_cells(resolution) != cells:
        raise ValueError(f"no resolution has {cells} cells a tet")
    return resolution


def cell_index(
    tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"], cells: int
) -> Int[Array, " M"]:
    """Index into [T * C] of the cell in which each point lies, by the combinatorial number system."""
    resolution = cell_resolution(cells)
    i, j, k = (jnp.clip((lambdas[:, n] * resolution).astype(jnp.int32), 0, resolution - 1) for n in range(3))
    # Rounding may push a point of the face lambda_3 = 0 beyond it.
    plane = jnp.minimum(j + k, resolution - 1)
    space = jnp.minimum(i + plane, resolution - 1)
    k = jnp.minimum(k, plane)
    index = space * (space + 1) * (space + 2) // 6 + plane * (plane + 1) // 2 + k
    return tet_ids * cells + index


def random_points(
    key: Array, cell_ids: Int[Array, " M"], cells: int
) -> tuple[Int[Array, " M"], Float[Array, "M 4"]]:
    """A point in each of the given cells (indices into [T * C]): its tet, and its coordinates."""
    resolution = cell_resolution(cells)
    low = jnp.asarray(_corners(resolution), jnp.float32)[cell_ids % cells]
    inside = jax.random.uniform(key, (cell_ids.size, 3))
    # Cells at the face lambda_3 = 0 are cut off.
    room, asked = resolution - jnp.sum(low, axis=1), jnp.sum(inside, axis=1)
    inside *= jnp.minimum(1, room / jnp.maximum(asked, 1e-6))[:, None]
    first = (low + inside) / resolution
    last = jnp.maximum(1 - jnp.sum(first, axis=1, keepdims=True), 0)
    return cell_ids // cells, jnp.concatenate([first, last], axis=1)


def _corners(resolution: int) -> np.ndarray:
    """Integer parts of N lambda_0, N lambda_1 and N lambda_2 by cell, [C, 3]: the inverse of `cell_index`."""
    spaces = range(resolution)
    return np.array([(s - p, p - k, k) for s in spaces for p in range(s + 1) for k in range(p + 1)])


def in_occupied_cells(
    occupied: Bool[Array, "T C"], tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> Bool[Array, " M"]:
    """Whether each point lies in an occupied cell."""
    index = cell_index(tet_ids, lambdas, occupied.shape[1])
    return occupied.reshape(-1).at[index].get(mode="promise_in_bounds")


class Slabs(NamedTuple):
    """Between which barycentric coordinates the occupied cells of each tet lie; an empty tet has none."""

    low: Float[Array, "T 4"]
    high: Float[Array, "T 4"]


def occupied_slabs(occupied: Bool[Array, "T C"]) -> Slabs:
    """Slabs around occupied cells: a quick test for whole segments, before their samples are looked at."""
    resolution = cell_resolution(occupied.shape[1])
    corners = _corners(resolution)
    left = resolution - corners.sum(axis=1, keepdims=True)
    low = np.concatenate([corners, np.maximum(left - 3, 0)], axis=1) / resolution - SLAB_MARGIN
    high = np.concatenate([corners + 1, left], axis=1) / resolution + SLAB_MARGIN

    def reduce(fold: Callable, ends: np.ndarray, none: float) -> Float[Array, "T 4"]:
        columns = [fold(jnp.where(occupied, jnp.float32(end), none), axis=1) for end in ends.T]
        return jnp.stack(columns, axis=1)

    return Slabs(reduce(jnp.min, low, jnp.inf), reduce(jnp.max, high, -jnp.inf))


def finer_cells(occupied: Bool[Array, "T C"], parts: int) -> Bool[Array, "T parts"]:
    """The same grid with more cells a tet, each as the one that it lies in.

    Where the edges are not cut into a multiple of what they were, everything counts as occupied.
    """
    coarse, fine = cell_resolution(occupied.shape[1]), cell_resolution(parts)
    if fine % coarse:
        return jnp.ones((occupied.shape[0], parts), bool)
    middles = (_corners(fine) + 0.25) / fine  # 0.25: within the cells that the face lambda_3 = 0 cuts, too
    places = jnp.asarray(np.column_stack([middles, 1 - middles.sum(axis=1)]), jnp.float32)
    index = cell_index(jnp.zeros(parts, jnp.int32), places, occupied.shape[1])
    return occupied[:, index]


def cells_of(
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    used: Bool[Array, " M"],
    num_tets: int,
    cells: int,
) -> Bool[Array, "T C"]:
    """The cells in which the used points lie."""
    index = jnp.where(used, cell_index(tet_ids, lambdas, cells), num_tets * cells)
    return jnp.zeros(num_tets * cells, bool).at[index].set(True, mode="drop").reshape(num_tets, cells)
