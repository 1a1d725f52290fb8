"""Grids over the barycentric coordinates of tets (Sec. 3.3): a `Grid` of the encoding.

A point's features come from the 16 corners of the enclosing 4D voxel (`grid`, the paper's), or from the 4
corners of the enclosing simplex of the tet's edgewise subdivision (`simplex`). Which table entry a node owns
is the layout's business (`layout.py`).

Axes: M points.
"""

from dataclasses import dataclass

import jax.numpy as jnp
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
from nimpostor_jax.encoding.layout import DENSE, SIZE_BITS
from nimpostor_jax.types import HashLayout


def by_vertex(
    corner_order: Int[Array, "T 4"], tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]
) -> Coordinates:
    """Barycentric coordinates in the order of their tets' corners."""
    shifts = jnp.arange(0, 8, 2)
    packed = jnp.sum(corner_order << shifts, axis=1)[tet_ids]  # four times 2 bits: one gather
    columns = []
    for i in range(4):
        corner = (packed >> (2 * i)) & 3
        low = jnp.where(corner == 1, lambdas[:, 1], lambdas[:, 0])
        high = jnp.where(corner == 3, lambdas[:, 3], lambdas[:, 2])
        columns.append(jnp.where(corner >= 2, high, low))
    return tuple(columns)


@dataclass(frozen=True)
class TetGrid:
    """The grids of all tets."""

    config: EncodingConfig
    layout: HashLayout

    @property
    def runs(self) -> tuple[tuple[int, Address], ...]:
        """Levels with an entry for every node, with one for every node of some tets, and hashed ones."""
        with_ranks, mixed = self.layout.rank_starts.shape[0] - 1, self.layout.num_mixed
        return (
            (with_ranks - mixed, self.dense_address),
            (mixed, self.mixed_address),
            (self.config.num_levels - with_ranks, self.hashed_address),
        )

    def prepare(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Points:
        """What every level needs of points in tets."""
        multipliers = tuple(self.layout.multipliers[:, i][tet_ids] for i in range(4))
        return Points(
            tet_ids=tet_ids, coordinates=self.coordinates(tet_ids, lambdas), places=multipliers
        )

    def coordinates(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Coordinates:
        """By ascending vertex id where neighbours share nodes, clipped to the simplex's range."""
        lambdas = jnp.clip(lambdas, 0, 1)
        if self.config.layout == "per_tet":
            return tuple(lambdas[:, i] for i in range(4))
        return by_vertex(self.layout.corner_order, tet_ids, lambdas)

    def corners(self, resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
        """Weights and nodes (four coordinates) around each point.

        In the cumulative coordinates N (l0, l0 + l1, l0 + l1 + l2) the edgewise subdivision is Kuhn's. They
        ascend, and those of its nodes do too: all nodes are in the tet.
        """
        if self.config.interpolation == "grid":
            return multilinear_corners(resolution, coordinates)
        l0, l1, l2, _ = coordinates
        weights, cumulative = kuhn_corners(resolution, (l0, l0 + l1, l0 + l1 + l2))
        return weights, [[y1, y2 - y1, y3 - y2, resolution - y3] for y1, y2, y3 in cumulative]

    def dense_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of nodes at a densely stored level."""
        layout, stride = self.layout, resolution + 1
        index = ((node[3] * stride + node[2]) * stride + node[1]) * stride + node[0]
        rank = layout.dense_ranks.at[layout.rank_starts[level] + index].get(mode="promise_in_bounds")
        return layout.starts[level] + (self._region(level, points, node) >> SIZE_BITS) + rank

    def hashed_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of nodes at a hashed level."""
        region = self._region(level, points, node)
        mixed = [u.astype(jnp.uint32) * m for u, m in zip(node, points.places, strict=True)]
        hashed = (mixed[0] ^ mixed[1]) ^ (mixed[2] ^ mixed[3])
        log2 = (region & ((1 << SIZE_BITS) - 1)).astype(jnp.uint32)
        local = (hashed & ((jnp.uint32(1) << log2) - 1)).astype(jnp.int32)
        return self.layout.starts[level] + (region >> SIZE_BITS) + local

    def mixed_address(
        self, level: Int[Array, ""], resolution: Int[Array, ""], points: Points, node: Node
    ) -> Int[Array, " M"]:
        """Table entries of nodes at a level that is dense in some tets and hashed in others."""
        dense = (self._region(level, points, node) & DENSE) == DENSE
        arguments = level, resolution, points, node
        return jnp.where(dense, self.dense_address(*arguments), self.hashed_address(*arguments))

    def _region(self, level: Int[Array, ""], points: Points, node: Node) -> Int[Array, " M"]:
        """Each node's packed region: of its tet, or of the sub-simplex that its nonzero coordinates name."""
        _, num_tets, num_masks = self.layout.regions.shape
        index = (level * num_tets + points.tet_ids) * num_masks
        if num_masks > 1:
            index += sum((u > 0).astype(jnp.int32) << i for i, u in enumerate(node))
        return self.layout.regions.reshape(-1).at[index].get(mode="promise_in_bounds")
