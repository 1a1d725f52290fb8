"""Interpolation between the nodes of regular grids, and what a grid must tell the encoding about itself.

Axes: M points.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, UInt

Coordinates = tuple[Float[Array, " M"], ...]
Node = list[Int[Array, " M"]]  # one of each point's, by its integer coordinates
Corners = tuple[list[Float[Array, " M"]], list[Node]]  # weights and nodes


@struct.dataclass
class Points:
    """What every level needs of the points."""

    tet_ids: Int[Array, " M"]
    coordinates: Coordinates
    places: tuple[Int[Array, " M"] | UInt[Array, " M"], ...]  # what else addresses depend on


# Level, resolution, points, nodes to table entries [M].
Address = Callable[[Int[Array, ""], Int[Array, ""], Points, Node], Int[Array, " M"]]


class Grid(Protocol):
    """A multi-resolution grid: the points' coordinates, the nodes around them, and the nodes' entries."""

    @property
    def runs(self) -> Sequence[tuple[int, Address]]:
        """How many levels in a row, from the coarsest on, and how their nodes' table entries are found."""

    def coordinates(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Coordinates:
        """Of points in tets."""

    def prepare(self, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"]) -> Points:
        """What every level needs of points in tets."""

    def corners(self, resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
        """Weights, differentiable, and nodes around each point."""


def multilinear_corners(resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
    """Weights and nodes of the 2^D corners of each point's voxel; coordinates are in [0, 1]."""
    low, fractions = [], []
    for coordinate in coordinates:
        scaled = coordinate * resolution.astype(coordinate.dtype)
        cell = _cell(scaled, resolution)
        low.append(cell.astype(jnp.int32))
        fractions.append(scaled - cell)
    weights, nodes = [], []
    for bits in itertools.product((0, 1), repeat=len(coordinates)):
        sides = [f if b else 1 - f for f, b in zip(fractions, bits, strict=True)]
        while len(sides) > 1:  # in pairs: shorter chains of products
            sides = [a * b for a, b in zip(sides[::2], sides[1::2], strict=False)] + sides[len(sides) & ~1 :]
        weights.append(sides[0])
        nodes.append([u + b for u, b in zip(low, bits, strict=True)])
    return weights, nodes


def kuhn_corners(resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
    """Weights and nodes of the 4 corners of each point's Kuhn simplex in a 3D grid over [0, 1].

    Within a unit cube the path from the lowest corner to the highest takes the axes by descending fraction.
    Ties take the later axis first: where coordinates ascend, those of all nodes then ascend too.
    """
    extent = resolution.astype(coordinates[0].dtype)
    scaled = [jnp.minimum(extent * c, extent) for c in coordinates]
    cells = [_cell(c, resolution) for c in scaled]
    f1, f2, f3 = (c - cell for c, cell in zip(scaled, cells, strict=True))
    low = [cell.astype(jnp.int32) for cell in cells]
    ahead_21, ahead_31, ahead_32 = f2 >= f1, f3 >= f1, f3 >= f2
    ranks = [
        ahead_21.astype(jnp.int32) + ahead_31,
        (~ahead_21).astype(jnp.int32) + ahead_32,
        (~ahead_31).astype(jnp.int32) + ~ahead_32,
    ]
    largest, smallest = jnp.maximum(jnp.maximum(f1, f2), f3), jnp.minimum(jnp.minimum(f1, f2), f3)
    median = jnp.maximum(jnp.minimum(f1, f2), jnp.minimum(jnp.maximum(f1, f2), f3))
    weights = [1 - largest, largest - median, median - smallest, smallest]
    nodes = [[cell + (rank < taken) for cell, rank in zip(low, ranks, strict=True)] for taken in range(4)]
    return weights, nodes


def _cell(scaled: Float[Array, " M"], resolution: Int[Array, ""]) -> Float[Array, " M"]:
    """The integer below, of a grid's cells; constant between nodes."""
    last = (resolution - 1).astype(scaled.dtype)
    return jnp.clip(jnp.floor(jax.lax.stop_gradient(scaled)), 0, last)
