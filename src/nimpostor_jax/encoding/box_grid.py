"""Instant-NGP's grid: one, over the bounding cube of the cage at rest (Mueller et al. 2022, Sec. 3).

The baseline NGP-Bounded. A point in a tet is looked up where it is while the cage is at rest, so that the
field follows a deformed cage as the others do. Levels that fit into the table are stored densely; of the
others, nodes share entries by their hash.

Axes: M points.
"""

import itertools
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.interpolation import (
    Address,
    Coordinates,
    Corners,
    Node,
    Points,
    kuhn_corners,
    multilinear_corners,
)
from nimpostor_jax.encoding.layout import NGP_PRIMES
from nimpostor_jax.types import BoxLayout


def build_box_layout(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], config: EncodingConfig
) -> BoxLayout:
    """The layout for a cage at rest: 2**`log2_table_size` entries a level at most. Host code."""
    vertices, table = np.asarray(vertices, np.float64), 1 << config.log2_table_size
    used = vertices[np.unique(tets)]
    low = used.min(axis=0)
    side = (used.max(axis=0) - low).max()
    nodes = [(resolution + 1) ** 3 for resolution in config.resolutions]
    return BoxLayout(
        starts=jnp.asarray([0, *itertools.accumulate(min(n, table) for n in nodes)], jnp.int32),
        corners=jnp.asarray(((vertices - low) / side)[np.asarray(tets)], jnp.float32),
    )


@dataclass(frozen=True)
class BoxGrid:
    """One grid over the bounding cube."""

    config: EncodingConfig
    layout: BoxLayout

    @property
    def runs(self) -> tuple[tuple[int, Address], ...]:
        """Levels with an entry for every node, and hashed ones."""
        table = 1 << self.config.log2_table_size
        num_dense = sum((resolution + 1) ** 3 <= table for resolution in self.config.resolutions)
        return (
            (num_dense, self.dense_address),
            (self.config.num_levels - num_dense, self.hashed_address),
        )

    def prepare(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Points:
        """What every level needs of points in tets."""
        return Points(tet_ids=tet_ids, coordinates=self.coordinates(tet_ids, lambdas), places=())

    def coordinates(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Coordinates:
        """Cartesian, in the cage at rest, in units of the cube."""
        corners = self.layout.corners.astype(lambdas.dtype)
        return tuple(
            jnp.clip(sum(lambdas[:, i] * corners[:, i, axis][tet_ids] for i in range(4)), 0, 1)
            for axis in range(3)
        )

    def corners(self, resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
        """Weights and nodes (three coordinates) around each point: of its voxel, or of a simplex in it."""
        of = multilinear_corners if self.config.interpolation == "grid" else kuhn_corners
        return of(resolution, coordinates)

    def dense_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of nodes at a densely stored level."""
        stride = resolution + 1
        return self.layout.starts[level] + (node[2] * stride + node[1]) * stride + node[0]

    def hashed_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of nodes at a hashed level."""
        mixed = [u.astype(jnp.uint32) * jnp.uint32(p) for u, p in zip(node, NGP_PRIMES[:3], strict=True)]
        hashed = mixed[0] ^ mixed[1] ^ mixed[2]
        local = hashed & jnp.uint32((1 << self.config.log2_table_size) - 1)
        return self.layout.starts[level] + local.astype(jnp.int32)
