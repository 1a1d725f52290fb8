"""Multi-resolution features of barycentric coordinates (E_p of Eq. 6, Sec. 3.3).

Each level interpolates the features of nearby nodes of a grid over the tet's four coordinates: the 16 corners
of the enclosing 4D voxel (`grid`, the paper's), or the 4 corners of the enclosing simplex of the tet's
edgewise subdivision (`simplex`). Which table entry a node owns is the layout's business (`layout.py`).

Levels are taken one after another by a loop. XLA would otherwise fuse them all into one kernel that computes
shared coordinates and addresses anew for every output: three times slower on a CPU, and slow to compile.

Axes: M points, L levels, F features per level.
"""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.custom_derivatives import custom_vjp_primal_tree_values
from jaxtyping import Array, Float, Int, UInt

from nimpostor_jax.chunks import (
    default_chunk,
    for_chunks,
    join_moving,
    materialize,
    pad_items,
    put,
    split_moving,
    take,
)
from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.layout import SIZE_BITS
from nimpostor_jax.types import HashLayout, HashTables

Coordinates = tuple[Float[Array, " M"], ...]
Nodes = list[Int[Array, " M"]]
Corners = tuple[list[Float[Array, " M"]], list[Nodes]]
_CornersOf = Callable[[Coordinates], Corners]
_AddressOf = Callable[[Nodes], Int[Array, " M"]]


def init_features(key: Array, num_entries: int, config: EncodingConfig) -> Float[Array, "entries F"]:
    """Small uniform features for all levels' tables."""
    shape, scale = (num_entries, config.features_per_level), config.init_scale
    return jax.random.uniform(key, shape, minval=-scale, maxval=scale)


def encode(
    tables: HashTables,
    config: EncodingConfig,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""] | int | None = None,
    known: Float[Array, "M L*F"] | None = None,
) -> Float[Array, "M L*F"]:
    """Features f_p of points given by tet and barycentric coordinates, all levels concatenated (Eq. 6).

    Differentiable in the tables and, between grid nodes, in the coordinates, in reverse mode. Where only the
    first `num_used` points matter, no more than their chunks are computed; the rest is 0. Where the result is
    `known` from an earlier pass, it is returned as it is, and only its gradient is left to compute.
    """
    num_points = tet_ids.shape[0]
    chunk = default_chunk(num_points)
    used = jnp.asarray(num_points if num_used is None else num_used, jnp.int32)
    tet_ids, lambdas = pad_items((tet_ids, lambdas), chunk)
    known = known if known is None else pad_items(known, chunk)
    return _encode(config, chunk, tables.features, tables.layout, tet_ids, lambdas, used, known)[:num_points]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _encode(
    config: EncodingConfig,
    chunk: int,
    features: Float[Array, "entries F"],
    layout: HashLayout,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""],
    known: Float[Array, "M L*F"] | None,
) -> Float[Array, "M L*F"]:
    """Weighted sums of table rows: one gather a corner, accumulated, is what XLA's CPU back end does best."""
    if known is not None:
        return known

    def encode_chunk(start: Array, out: Array) -> Array:
        points = _points(layout, take(tet_ids, start, chunk))
        coordinates = _canonical(layout, config, points.tet_ids, take(lambdas, start, chunk))

        def add_level(level: Array, corners: _CornersOf, address: _AddressOf, part: Array) -> Array:
            weights, nodes = corners(coordinates)
            rows = (_rows(features, address(node)) for node in nodes)
            total = sum(w[:, None] * row for w, row in zip(weights, rows, strict=True))
            return jax.lax.dynamic_update_index_in_dim(part, total, level, 1)

        part = jnp.zeros((chunk, config.num_levels, features.shape[1]), features.dtype)
        part = _for_levels(config, layout, points, add_level, part)
        return put(out, start, part.reshape(chunk, -1))

    shape = (tet_ids.shape[0], config.num_levels * features.shape[1])
    return for_chunks(num_used, chunk, encode_chunk, jnp.zeros(shape, features.dtype))


def _encode_forward(config: EncodingConfig, chunk: int, *arguments: Any) -> tuple[Array, tuple]:
    values = custom_vjp_primal_tree_values(arguments)
    moving, fixed = split_moving((arguments[0], arguments[3]))  # tables and coordinates
    return _encode(config, chunk, *values), (moving, fixed, values[1], values[2], values[4])


def _encode_backward(
    config: EncodingConfig, chunk: int, residuals: tuple, cotangent: Float[Array, "M L*F"]
) -> tuple:
    moving, fixed, layout, tet_ids, num_used = residuals
    features, lambdas = join_moving(moving, fixed)
    cotangent = materialize(cotangent)

    def encode_chunk(start: Array, sums: tuple) -> tuple:
        d_features, d_lambdas = sums
        points = _points(layout, take(tet_ids, start, chunk))
        canonical = partial(_canonical, layout, config, points.tet_ids)
        coordinates, pull_coordinates = jax.vjp(canonical, take(lambdas, start, chunk))
        d_part = take(cotangent, start, chunk).reshape(chunk, config.num_levels, -1)

        def add_level(level: Array, corners: _CornersOf, address: _AddressOf, sums: tuple) -> tuple:
            d_features, d_coordinates = sums
            weights, pull, nodes = jax.vjp(corners, coordinates, has_aux=True)
            d_level = jax.lax.dynamic_index_in_dim(d_part, level, 1, keepdims=False)
            d_weights = []
            for weight, node in zip(weights, nodes, strict=True):
                entries = address(node)
                if d_coordinates is not None:
                    products = _rows(features, entries) * d_level
                    d_weights.append(jnp.sum(products, axis=-1).astype(weight.dtype))
                if d_features is not None:
                    d_rows = weight[:, None] * d_level
                    d_features = d_features.at[entries].add(d_rows, mode="promise_in_bounds")
            if d_coordinates is not None:
                d_coordinates = jax.tree.map(jnp.add, d_coordinates, *pull(d_weights))
            return d_features, d_coordinates

        zeros = None if d_lambdas is None else jax.tree.map(jnp.zeros_like, coordinates)
        d_features, d_coordinates = _for_levels(config, layout, points, add_level, (d_features, zeros))
        if d_lambdas is not None:
            d_lambdas = put(d_lambdas, start, *pull_coordinates(d_coordinates))
        return d_features, d_lambdas

    zeros = jax.tree.map(jnp.zeros_like, moving)
    d_features, d_lambdas = for_chunks(num_used, chunk, encode_chunk, zeros)
    return d_features, None, None, d_lambdas, None, None


_encode.defvjp(_encode_forward, _encode_backward, symbolic_zeros=True)


@struct.dataclass
class _Points:
    """What addresses need of a chunk's points at every level."""

    tet_ids: Int[Array, " M"]
    multipliers: tuple[UInt[Array, " M"], ...]  # of the tet's four corners


def _points(layout: HashLayout, tet_ids: Int[Array, " M"]) -> _Points:
    return _Points(tet_ids=tet_ids, multipliers=tuple(layout.multipliers[:, i][tet_ids] for i in range(4)))


def _canonical(
    layout: HashLayout,
    config: EncodingConfig,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
) -> Coordinates:
    """Coordinates by ascending vertex id where neighbours share nodes, clipped to the simplex's range."""
    lambdas = jnp.clip(lambdas, 0, 1)
    if config.layout == "per_tet":
        return tuple(lambdas[:, i] for i in range(4))
    shifts = jnp.arange(0, 8, 2)
    packed = jnp.sum(layout.corner_order << shifts, axis=1)[tet_ids]  # four times 2 bits: one gather
    columns = []
    for i in range(4):
        corner = (packed >> (2 * i)) & 3
        low = jnp.where(corner == 1, lambdas[:, 1], lambdas[:, 0])
        high = jnp.where(corner == 3, lambdas[:, 3], lambdas[:, 2])
        columns.append(jnp.where(corner >= 2, high, low))
    return tuple(columns)


def _rows(features: Float[Array, "entries F"], entries: Int[Array, " M"]) -> Float[Array, "M F"]:
    return features.at[entries].get(mode="promise_in_bounds")


def _for_levels(
    config: EncodingConfig, layout: HashLayout, points: _Points, add_level: Callable, carry: Any
) -> Any:
    """Fold `add_level` over the levels: first the densely stored, then the hashed ones."""
    corners = _grid_corners if config.interpolation == "grid" else _simplex_corners
    resolutions = jnp.asarray(config.resolutions, jnp.int32)
    num_dense = layout.rank_starts.shape[0] - 1

    def body(level: Array, carry: Any, dense: bool) -> Any:
        resolution = resolutions[level]
        address = _dense_address if dense else _hashed_address
        return add_level(
            level, partial(corners, resolution), partial(address, layout, points, level, resolution), carry
        )

    carry = jax.lax.fori_loop(0, num_dense, partial(body, dense=True), carry)
    return jax.lax.fori_loop(num_dense, config.num_levels, partial(body, dense=False), carry)


def _grid_corners(resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
    """4-linear weights and nodes of the 16 corners of each point's voxel."""
    low, fractions = [], []
    for coordinate in coordinates:
        scaled = coordinate * resolution.astype(coordinate.dtype)
        cell = _cell(scaled, resolution)
        low.append(cell.astype(jnp.int32))
        fractions.append(scaled - cell)
    weights, nodes = [], []
    for bits in itertools.product((0, 1), repeat=4):
        sides = [f if b else 1 - f for f, b in zip(fractions, bits, strict=True)]
        weights.append((sides[0] * sides[1]) * (sides[2] * sides[3]))
        nodes.append([u + b for u, b in zip(low, bits, strict=True)])
    return weights, nodes


def _simplex_corners(resolution: Int[Array, ""], coordinates: Coordinates) -> Corners:
    """Weights and nodes of the 4 corners of each point's simplex in the edgewise subdivision.

    In the cumulative coordinates N (l0, l0 + l1, l0 + l1 + l2) the subdivision is Kuhn's: within a unit cube
    the path from the lowest corner to the highest takes the axes by descending fraction. Ties take the
    later axis first, which keeps the cumulative coordinates ascending and hence all nodes valid.
    """
    l0, l1, l2, _ = coordinates
    extent = resolution.astype(l0.dtype)
    cumulative = [jnp.minimum(extent * c, extent) for c in (l0, l0 + l1, l0 + l1 + l2)]
    cells = [_cell(c, resolution) for c in cumulative]
    f1, f2, f3 = (c - cell for c, cell in zip(cumulative, cells, strict=True))
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
    nodes = []
    for taken in range(4):
        y1, y2, y3 = (cell + (rank < taken) for cell, rank in zip(low, ranks, strict=True))
        nodes.append([y1, y2 - y1, y3 - y2, resolution - y3])
    return weights, nodes


def _cell(scaled: Float[Array, " M"], resolution: Int[Array, ""]) -> Float[Array, " M"]:
    """The integer below, of a grid's cells; constant between nodes."""
    last = (resolution - 1).astype(scaled.dtype)
    return jnp.clip(jnp.floor(jax.lax.stop_gradient(scaled)), 0, last)


def _dense_address(
    layout: HashLayout, points: _Points, level: Int[Array, ""], resolution: Int[Array, ""], node: Nodes
) -> Int[Array, " M"]:
    """Table entries of nodes (four integer coordinates) at a densely stored level."""
    stride = resolution + 1
    index = ((node[3] * stride + node[2]) * stride + node[1]) * stride + node[0]
    rank = layout.dense_ranks.at[layout.rank_starts[level] + index].get(mode="promise_in_bounds")
    return layout.starts[level] + (_region(layout, points, level, node) >> SIZE_BITS) + rank


def _hashed_address(
    layout: HashLayout, points: _Points, level: Int[Array, ""], resolution: Int[Array, ""], node: Nodes
) -> Int[Array, " M"]:
    """Table entries of nodes at a hashed level."""
    region = _region(layout, points, level, node)
    mixed = [u.astype(jnp.uint32) * m for u, m in zip(node, points.multipliers, strict=True)]
    hashed = (mixed[0] ^ mixed[1]) ^ (mixed[2] ^ mixed[3])
    log2 = (region & ((1 << SIZE_BITS) - 1)).astype(jnp.uint32)
    local = (hashed & ((jnp.uint32(1) << log2) - 1)).astype(jnp.int32)
    return layout.starts[level] + (region >> SIZE_BITS) + local


def _region(layout: HashLayout, points: _Points, level: Int[Array, ""], node: Nodes) -> Int[Array, " M"]:
    """The packed region of each node: of the tet, or of the sub-simplex that its nonzero coordinates name."""
    _, num_tets, num_masks = layout.regions.shape
    index = (level * num_tets + points.tet_ids) * num_masks
    if num_masks > 1:
        index += sum((u > 0).astype(jnp.int32) << i for i, u in enumerate(node))
    return layout.regions.reshape(-1).at[index].get(mode="promise_in_bounds")
