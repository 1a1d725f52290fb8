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
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int, UInt

from nimpostor_jax.chunks import default_chunk, for_chunks, pad_items, put, take
from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.layout import SIZE_BITS
from nimpostor_jax.types import HashLayout, HashTables

Coordinates = tuple[Float[Array, " M"], ...]
Nodes = list[Int[Array, " M"]]
Corners = tuple[list[Float[Array, " M"]], list[Nodes]]
_CornersOf = Callable[[Coordinates], Corners]
_AddressOf = Callable[[Any, Nodes], Int[Array, " M"]]


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
    first `num_used` points matter, no more than their chunks are computed; the rest is 0. Where the features
    are `known` from an earlier call, they are not computed again but given their derivatives.
    """
    num_points = tet_ids.shape[0]
    chunk = default_chunk(num_points)
    used = jnp.asarray(num_points if num_used is None else num_used, jnp.int32)
    tet_ids, lambdas, known = pad_items((tet_ids, lambdas, known), chunk)
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
    """Weighted sums of table rows: one gather a corner, accumulated, is what XLA's CPU back end does best.

    All chunks of a level come before the next level: its entries come into the cache once, not per chunk.
    """
    if known is not None:
        return known
    points = _points(config, chunk, layout, tet_ids, lambdas, num_used)

    def add_level(level: Array, corners: _CornersOf, address: _AddressOf, out: Array) -> Array:
        def encode_chunk(start: Array, out: Array) -> Array:
            part = take(points, start, chunk)
            weights, nodes = corners(part.coordinates)
            rows = (_rows(features, address(part, node)) for node in nodes)
            total = sum(w[:, None] * row for w, row in zip(weights, rows, strict=True))
            return jax.lax.dynamic_update_slice(out, jnp.expand_dims(total, 1), (start, level, jnp.int32(0)))

        return for_chunks(num_used, chunk, encode_chunk, out)

    shape = (tet_ids.shape[0], config.num_levels, features.shape[1])
    out = _for_levels(config, layout, add_level, jnp.zeros(shape, jnp.result_type(features, lambdas)))
    return out.reshape(shape[0], -1)


def _encode_forward(config: EncodingConfig, chunk: int, *primals: Any) -> tuple[Array, tuple]:
    """Keeps which gradients are asked for, as () or None: static, since an empty tuple holds no array."""
    arguments = jax.tree.map(lambda p: p.value, primals)
    wanted = tuple(() if primals[i].perturbed else None for i in (0, 3))
    return _encode(config, chunk, *arguments), ((*arguments[:5], None), wanted)


def _encode_backward(
    config: EncodingConfig, chunk: int, residuals: tuple, cotangent: Float[Array, "M L*F"] | SymbolicZero
) -> tuple:
    """Scatters into the tables, and gathers for the coordinates, only where that gradient is used."""
    (features, layout, tet_ids, lambdas, num_used, _), (of_features, of_lambdas) = residuals
    if isinstance(cotangent, SymbolicZero):
        return (None,) * 6
    points = _points(config, chunk, layout, tet_ids, lambdas, num_used)
    d_levels = cotangent.reshape(len(tet_ids), config.num_levels, -1)

    def add_level(level: Array, corners: _CornersOf, address: _AddressOf, sums: tuple) -> tuple:
        def encode_chunk(start: Array, sums: tuple) -> tuple:
            d_features, d_coordinates = sums
            part = take(points, start, chunk)
            weights, pull, nodes = jax.vjp(corners, part.coordinates, has_aux=True)
            d_level = jax.lax.dynamic_slice(
                d_levels, (start, level, jnp.int32(0)), (chunk, 1, d_levels.shape[2])
            )[:, 0]
            d_weights = []
            for weight, node in zip(weights, nodes, strict=True):
                entries = address(part, node)
                if of_lambdas is not None:
                    d_weight = jnp.sum(_rows(features, entries) * d_level, axis=-1)
                    d_weights.append(d_weight.astype(weight.dtype))
                if of_features is not None:
                    d_rows = weight[:, None] * d_level
                    d_features = d_features.at[entries].add(d_rows, mode="promise_in_bounds")
            if of_lambdas is not None:
                added = jax.tree.map(jnp.add, take(d_coordinates, start, chunk), *pull(d_weights))
                d_coordinates = put(d_coordinates, start, added)
            return d_features, d_coordinates

        return for_chunks(num_used, chunk, encode_chunk, sums)

    d_features = None if of_features is None else jnp.zeros_like(features)
    d_coordinates = None if of_lambdas is None else jax.tree.map(jnp.zeros_like, points.coordinates)
    d_features, d_coordinates = _for_levels(config, layout, add_level, (d_features, d_coordinates))
    if of_lambdas is None:
        return d_features, None, None, None, None, None

    def pull_chunk(start: Array, d_lambdas: Array) -> Array:
        canonical = partial(_canonical, layout, config, take(tet_ids, start, chunk))
        _, pull = jax.vjp(canonical, take(lambdas, start, chunk))
        return put(d_lambdas, start, *pull(take(d_coordinates, start, chunk)))

    d_lambdas = for_chunks(num_used, chunk, pull_chunk, jnp.zeros_like(lambdas))
    return d_features, None, None, d_lambdas, None, None


_encode.defvjp(_encode_forward, _encode_backward, symbolic_zeros=True)


@struct.dataclass
class _Points:
    """What every level needs of the points."""

    tet_ids: Int[Array, " M"]
    coordinates: Coordinates
    multipliers: tuple[UInt[Array, " M"], ...]  # of the tet's four corners


def _points(
    config: EncodingConfig,
    chunk: int,
    layout: HashLayout,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""],
) -> _Points:
    def prepare_chunk(start: Array, points: _Points) -> _Points:
        tets = take(tet_ids, start, chunk)
        coordinates = _canonical(layout, config, tets, take(lambdas, start, chunk))
        multipliers = tuple(layout.multipliers[:, i][tets] for i in range(4))
        return put(points, start, _Points(tet_ids=tets, coordinates=coordinates, multipliers=multipliers))

    num_points = tet_ids.shape[0]
    empty = _Points(
        tet_ids=tet_ids,
        coordinates=tuple(jnp.zeros(num_points, lambdas.dtype) for _ in range(4)),
        multipliers=tuple(jnp.zeros(num_points, layout.multipliers.dtype) for _ in range(4)),
    )
    return for_chunks(num_used, chunk, prepare_chunk, empty)


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


def _for_levels(config: EncodingConfig, layout: HashLayout, add_level: Callable[..., Any], carry: Any) -> Any:
    """Fold `add_level` over the levels: first the densely stored, then the hashed ones."""
    corners = _grid_corners if config.interpolation == "grid" else _simplex_corners
    resolutions = jnp.asarray(config.resolutions, jnp.int32)
    num_dense = layout.rank_starts.shape[0] - 1

    def body(level: Array, carry: Any, dense: bool) -> Any:
        level = level.astype(jnp.int32)  # as the chunks' starts: in x64 the loop counts in 64 bits
        resolution = resolutions[level]
        address = _dense_address if dense else _hashed_address
        return add_level(
            level, partial(corners, resolution), partial(address, layout, level, resolution), carry
        )

    if num_dense:  # a loop over none is traced too, and would read from empty ranks
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
    layout: HashLayout, level: Int[Array, ""], resolution: Int[Array, ""], points: _Points, node: Nodes
) -> Int[Array, " M"]:
    """Table entries of nodes (four integer coordinates) at a densely stored level."""
    stride = resolution + 1
    index = ((node[3] * stride + node[2]) * stride + node[1]) * stride + node[0]
    rank = layout.dense_ranks.at[layout.rank_starts[level] + index].get(mode="promise_in_bounds")
    return layout.starts[level] + (_region(layout, points, level, node) >> SIZE_BITS) + rank


def _hashed_address(
    layout: HashLayout, level: Int[Array, ""], resolution: Int[Array, ""], points: _Points, node: Nodes
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
