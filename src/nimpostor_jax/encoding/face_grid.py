"""Textures on the faces of tets: a `Grid` of the encoding with one level (Sec. 3.4, baking).

A texel is a node of a triangular grid on a face; the features of a point on the face come from the three
texels around it. Every tet has its own texture on each face, for what lies behind the face in that tet.

Axes: M points.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.interpolation import Address, Coordinates, Corners, Node, Points
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.types import FaceLayout

ONE_LEVEL = EncodingConfig(num_levels=1)


def num_texels(resolutions: Int[np.ndarray, "*batch"]) -> Int[np.ndarray, "*batch"]:
    """Of textures of n texels' distance along an edge."""
    return (resolutions + 1) * (resolutions + 2) // 2


def build_face_layout(resolutions: Int[np.ndarray, "T 4"]) -> FaceLayout:
    """The layout for given resolutions, all at least 1. Host code."""
    resolutions = np.asarray(resolutions, np.int64)
    counts = num_texels(resolutions).reshape(-1)
    starts = (np.cumsum(counts) - counts).reshape(resolutions.shape)
    return FaceLayout(
        starts=jnp.asarray(starts, jnp.int32), resolutions=jnp.asarray(resolutions, jnp.int32)
    )


def face_of(lambdas: Float[Array, "M 4"]) -> Int[Array, " M"]:
    """The face on which points lie, by the corner opposite; any one of two on an edge.

    By selections, since XLA's CPU back end computes `jnp.argmin` item by item.
    """
    least, face = lambdas[:, 0], jnp.zeros(lambdas.shape[0], jnp.int32)
    for corner in range(1, 4):
        face = jnp.where(lambdas[:, corner] < least, corner, face)
        least = jnp.minimum(least, lambdas[:, corner])
    return face


@dataclass(frozen=True)
class FaceGrid:
    """The textures of all faces."""

    config: EncodingConfig
    layout: FaceLayout

    @property
    def runs(self) -> tuple[tuple[int, Address], ...]:
        """One level, with an entry for every node."""
        return ((1, self.dense_address),)

    def prepare(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Points:
        """What every level needs of points in tets."""
        face = 4 * tet_ids + face_of(lambdas)
        places = tuple(x.reshape(-1)[face] for x in (self.layout.starts, self.layout.resolutions))
        return Points(tet_ids=tet_ids, coordinates=self.coordinates(tet_ids, lambdas), places=places)

    def coordinates(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Coordinates:
        """Cumulative weights of the face's corners, in texels; of the face on which a point lies."""
        face = face_of(lambdas)
        first, second = (
            jnp.take_along_axis(lambdas, jnp.asarray(FACES, jnp.int32)[face, i][:, None], axis=1)[:, 0]
            for i in range(2)
        )
        extent = self.layout.resolutions.reshape(-1)[4 * tet_ids + face].astype(lambdas.dtype)
        first = jnp.clip(first, 0, 1)
        both = jnp.clip(first + second, first, 1)
        # Points on the far side belong to the last cell.
        return first * extent, both * extent, jnp.maximum(extent - 1, 0)

    def corners(self, resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
        """Weights and nodes (row and place in it) around each point: Kuhn's triangles (`interpolation`)."""
        *scaled, last = coordinates
        cells = [jnp.clip(jnp.floor(jax.lax.stop_gradient(c)), 0, last) for c in scaled]
        f1, f2 = (c - cell for c, cell in zip(scaled, cells, strict=True))
        i, j = (cell.astype(jnp.int32) for cell in cells)
        second_first = f2 >= f1
        weights = [1 - jnp.maximum(f1, f2), jnp.abs(f1 - f2), jnp.minimum(f1, f2)]
        return weights, [[i, j], [i + ~second_first, j + second_first], [i + 1, j + 1]]

    def dense_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of texels."""
        place, row = node
        texels = points.places[0] + row * (row + 1) // 2 + place
        return texels if self.layout.rows is None else self.layout.rows[texels]


def texels_around(
    layout: FaceLayout, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> tuple[list[Float[Array, " M"]], list[Int[Array, " M"]]]:
    """Weights and table entries of the three texels around points on faces."""
    grid, level = FaceGrid(ONE_LEVEL, layout), jnp.int32(0)
    points = grid.prepare(tet_ids, lambdas)
    weights, nodes = grid.corners(level, points.coordinates)
    return weights, [grid.dense_address(level, level, points, node) for node in nodes]
