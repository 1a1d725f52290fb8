"""Multi-resolution hash encoding of points in tets (E_p of Eq. 6, Sec. 3.3).

Each level interpolates the features of nearby nodes of a grid: over the tet's four barycentric coordinates
(`tet_grid.py`), or over the bounding box of the cage at rest (`box_grid.py`, Instant-NGP's).

Levels are taken one after another by a loop. XLA would otherwise fuse them all into one kernel that computes
shared coordinates and addresses anew for every output: three times slower on a CPU, and slow to compile.

Axes: M points, L levels, F features per level.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import default_chunk, for_chunks, pad_items, put, take
from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.box_grid import BoxGrid
from nimpostor_jax.encoding.face_grid import FaceGrid
from nimpostor_jax.encoding.interpolation import Address, Coordinates, Corners, Grid, Node, Points
from nimpostor_jax.encoding.tet_grid import TetGrid
from nimpostor_jax.types import BoxLayout, FaceLayout, HashLayout, HashTables

Layout = HashLayout | BoxLayout | FaceLayout
_CornersOf = Callable[[Coordinates], Corners]
_AddressOf = Callable[[Points, Node], Int[Array, " M"]]


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
    first_level: int = 0,
) -> Float[Array, "M L*F"]:
    """Features f_p of points given by tet and barycentric coordinates, all levels concatenated (Eq. 6).

    Differentiable in the tables and, between grid nodes, in the coordinates, in reverse mode. Where only the
    first `num_used` points matter, no more than their chunks are computed; the rest is 0. Where the features
    are `known` from an earlier call, they are not computed again but given their derivatives. Features of
    levels before `first_level` are left 0.
    """
    num_points = tet_ids.shape[0]
    chunk = default_chunk(num_points)
    used = jnp.asarray(num_points if num_used is None else num_used, jnp.int32)
    tet_ids, lambdas, known = pad_items((tet_ids, lambdas, known), chunk)
    arguments = tables.features, tables.layout, tet_ids, lambdas, used, known
    return _encode(config, chunk, first_level, *arguments)[:num_points]


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _encode(
    config: EncodingConfig,
    chunk: int,
    first_level: int,
    features: Float[Array, "entries F"],
    layout: Layout,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""],
    known: Float[Array, "M L*F"] | None,
) -> Float[Array, "M L*F"]:
    """Weighted sums of table rows: one gather a corner, accumulated, is what XLA's CPU back end does best.

    All chunks of a level come before the next level: its entries come into the cache once, not per chunk.
    Levels are put side by side at the end: written there at once, each would touch every cache line.
    """
    if known is not None:
        return known
    grid = _grid_of(config, layout)
    points = _points(grid, chunk, tet_ids, lambdas, num_used)

    def add_level(level: Array, corners: _CornersOf, address: _AddressOf, out: Array) -> Array:
        def encode_chunk(start: Array, out: Array) -> Array:
            part = take(points, start, chunk)
            weights, nodes = corners(part.coordinates)
            rows = (_rows(features, address(part, node)) for node in nodes)
            total = sum(w[:, None] * row for w, row in zip(weights, rows, strict=True))
            return jax.lax.dynamic_update_slice(out, jnp.expand_dims(total, 0), (level, start, jnp.int32(0)))

        return for_chunks(num_used, len(tet_ids), chunk, encode_chunk, out)

    shape = (config.num_levels, tet_ids.shape[0], features.shape[1])
    zeros = jnp.zeros(shape, jnp.result_type(features, lambdas))
    by_level = _for_levels(config, grid, first_level, add_level, zeros)
    if config.num_levels == 1:
        return by_level[0]

    def join_chunk(start: Array, out: Array) -> Array:
        part = jax.lax.dynamic_slice_in_dim(by_level, start, chunk, axis=1)
        return put(out, start, part.transpose(1, 0, 2).reshape(chunk, -1))

    out = jnp.zeros((shape[1], shape[0] * shape[2]), zeros.dtype)
    return for_chunks(num_used, len(tet_ids), chunk, join_chunk, out)


def _encode_forward(
    config: EncodingConfig, chunk: int, first_level: int, *primals: Any
) -> tuple[Array, tuple]:
    """Keeps which gradients are asked for, as () or None: static, since an empty tuple holds no array."""
    arguments = jax.tree.map(lambda p: p.value, primals)
    wanted = tuple(() if primals[i].perturbed else None for i in (0, 3))
    return _encode(config, chunk, first_level, *arguments), ((*arguments[:5], None), wanted)


def _encode_backward(
    config: EncodingConfig,
    chunk: int,
    first_level: int,
    residuals: tuple,
    cotangent: Float[Array, "M L*F"] | SymbolicZero,
) -> tuple:
    """Scatters into the tables, and gathers for the coordinates, only where that gradient is used."""
    (features, layout, tet_ids, lambdas, num_used, _), (of_features, of_lambdas) = residuals
    if isinstance(cotangent, SymbolicZero):
        return (None,) * 6
    grid = _grid_of(config, layout)
    points = _points(grid, chunk, tet_ids, lambdas, num_used)
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

        return for_chunks(num_used, len(tet_ids), chunk, encode_chunk, sums)

    d_features = None if of_features is None else jnp.zeros_like(features)
    d_coordinates = None if of_lambdas is None else jax.tree.map(jnp.zeros_like, points.coordinates)
    sums = d_features, d_coordinates
    d_features, d_coordinates = _for_levels(config, grid, first_level, add_level, sums)
    if of_lambdas is None:
        return d_features, None, None, None, None, None

    def pull_chunk(start: Array, d_lambdas: Array) -> Array:
        coordinates = partial(grid.coordinates, take(tet_ids, start, chunk))
        _, pull = jax.vjp(coordinates, take(lambdas, start, chunk))
        return put(d_lambdas, start, *pull(take(d_coordinates, start, chunk)))

    d_lambdas = for_chunks(num_used, len(tet_ids), chunk, pull_chunk, jnp.zeros_like(lambdas))
    return d_features, None, None, d_lambdas, None, None


_encode.defvjp(_encode_forward, _encode_backward, symbolic_zeros=True)


def _grid_of(config: EncodingConfig, layout: Layout) -> Grid:
    """Which nodes are near a point, and where their features are stored."""
    if isinstance(layout, FaceLayout):
        return FaceGrid(config, layout)
    return BoxGrid(config, layout) if isinstance(layout, BoxLayout) else TetGrid(config, layout)


def _points(
    grid: Grid, chunk: int, tet_ids: Int[Array, " M"], lambdas: Float[Array, "M 4"], num_used: Int[Array, ""]
) -> Points:
    """What every level needs of the points."""

    def prepare_chunk(start: Array, points: Points) -> Points:
        return put(points, start, grid.prepare(take(tet_ids, start, chunk), take(lambdas, start, chunk)))

    shapes = jax.eval_shape(grid.prepare, tet_ids, lambdas)
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return for_chunks(num_used, len(tet_ids), chunk, prepare_chunk, empty)


def _rows(features: Float[Array, "entries F"], entries: Int[Array, " M"]) -> Float[Array, "M F"]:
    return features.at[entries].get(mode="promise_in_bounds")


def _for_levels(
    config: EncodingConfig, grid: Grid, first_level: int, add_level: Callable[..., Any], carry: Any
) -> Any:
    """Fold `add_level` over the levels from the first on, one loop for each way of finding entries."""
    resolutions = jnp.asarray(config.resolutions, jnp.int32)
    first = 0
    for count, address in grid.runs:

        def body(level: Array, carry: Any, address: Address = address) -> Any:
            level = level.astype(jnp.int32)  # as the chunks' starts: in x64 the loop counts in 64 bits
            resolution = resolutions[level]
            entries = partial(address, level, resolution)
            return add_level(level, partial(grid.corners, resolution), entries, carry)

        begin, first = max(first, first_level), first + count
        if begin < first:  # a loop over none is traced too, and would read from empty ranks
            carry = jax.lax.fori_loop(begin, first, body, carry)
    return carry
