"""Multi-resolution features of barycentric coordinates (E_p of Eq. 6, Sec. 3.3).

Each level interpolates the features of nearby nodes of a grid over the tet's four coordinates: the 16 corners
of the enclosing 4D voxel (`grid`, the paper's), or the 4 corners of the enclosing simplex of the tet's
edgewise subdivision (`simplex`). Which table entry a node owns is the layout's business (`layout.py`).

Axes: M points, L levels, F features per level.
"""

import itertools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.layout import SIZE_BITS
from nimpostor_jax.types import HashLayout, HashTables

Coordinates = list[Float[Array, " M"]]
Nodes = list[Int[Array, " M"]]


def init_features(key: Array, entries: tuple[int, ...], config: EncodingConfig) -> tuple[Array, ...]:
    """Small uniform features for every level's table."""
    keys = jax.random.split(key, len(entries))
    shape = config.features_per_level
    return tuple(
        jax.random.uniform(k, (n, shape), minval=-config.init_scale, maxval=config.init_scale)
        for k, n in zip(keys, entries, strict=True)
    )


def encode(
    tables: HashTables,
    config: EncodingConfig,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
) -> Float[Array, "M L*F"]:
    """Features f_p of points given by tet and barycentric coordinates, all levels concatenated (Eq. 6).

    Differentiable in the tables and, between grid nodes, in the coordinates.
    """
    coordinates = _canonical(tables.layout, config, tet_ids, lambdas)
    interpolate = _grid_corners if config.interpolation == "grid" else _simplex_corners
    levels = []
    for level, resolution in enumerate(config.resolutions):
        entries, weights = interpolate(tables.layout, level, resolution, tet_ids, coordinates)
        levels.append(_interpolate(tables.features[level], entries, weights))
    return jnp.concatenate(levels, axis=-1)


def _canonical(
    layout: HashLayout,
    config: EncodingConfig,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
) -> Coordinates:
    """Coordinates by ascending vertex id where neighbours share nodes, clipped to the simplex's range."""
    lambdas = jnp.clip(lambdas, 0, 1)
    if config.layout == "per_tet":
        return [lambdas[:, i] for i in range(4)]
    shifts = jnp.arange(0, 8, 2)
    packed = jnp.sum(layout.corner_order << shifts, axis=1)[tet_ids]  # four times 2 bits: one gather
    columns = []
    for i in range(4):
        corner = (packed >> (2 * i)) & 3
        low = jnp.where(corner == 1, lambdas[:, 1], lambdas[:, 0])
        high = jnp.where(corner == 3, lambdas[:, 3], lambdas[:, 2])
        columns.append(jnp.where(corner >= 2, high, low))
    return columns


def _interpolate(
    features: Float[Array, "entries F"],
    entries: list[Int[Array, " M"]],
    weights: list[Float[Array, " M"]],
) -> Float[Array, "M F"]:
    """Weighted sum of table rows; one gather a corner, accumulated, is what XLA's CPU back end does best."""
    return _gather_sum(features, tuple(entries), tuple(weights))


@jax.custom_vjp
def _gather_sum(features, entries, weights):  # type: ignore[no-untyped-def]
    total = jnp.zeros((entries[0].shape[0], features.shape[1]), features.dtype)
    for index, weight in zip(entries, weights, strict=True):
        total += weight[:, None] * features.at[index].get(mode="promise_in_bounds")
    return total


def _gather_sum_forward(features, entries, weights):  # type: ignore[no-untyped-def]
    return _gather_sum(features, entries, weights), (features, entries, weights)


def _gather_sum_backward(residuals, cotangent):  # type: ignore[no-untyped-def]
    features, entries, weights = residuals
    d_features = jnp.zeros_like(features)
    d_weights = []
    for index, weight in zip(entries, weights, strict=True):
        rows = features.at[index].get(mode="promise_in_bounds")
        d_weights.append(jnp.sum(rows * cotangent, axis=-1).astype(weight.dtype))
        d_features = d_features.at[index].add(weight[:, None] * cotangent, mode="promise_in_bounds")
    return d_features, tuple(None for _ in entries), tuple(d_weights)


_gather_sum.defvjp(_gather_sum_forward, _gather_sum_backward)


def _grid_corners(
    layout: HashLayout,
    level: int,
    resolution: int,
    tet_ids: Int[Array, " M"],
    coordinates: Coordinates,
) -> tuple[list, list]:
    """Table entries and 4-linear weights of the 16 corners of each point's voxel."""
    low, fractions = [], []
    for coordinate in coordinates:
        scaled = coordinate * resolution
        cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(scaled)), 0, resolution - 1)
        low.append(cell.astype(jnp.int32))
        fractions.append(scaled - cell)
    address = _addressing(layout, level, resolution, tet_ids)
    entries, weights = [], []
    for bits in itertools.product((0, 1), repeat=4):
        entries.append(address([u + b for u, b in zip(low, bits, strict=True)]))
        sides = [f if b else 1 - f for f, b in zip(fractions, bits, strict=True)]
        weights.append((sides[0] * sides[1]) * (sides[2] * sides[3]))
    return entries, weights


def _simplex_corners(
    layout: HashLayout,
    level: int,
    resolution: int,
    tet_ids: Int[Array, " M"],
    coordinates: Coordinates,
) -> tuple[list, list]:
    """Table entries and weights of the 4 corners of each point's simplex in the edgewise subdivision.

    In the cumulative coordinates N (l0, l0 + l1, l0 + l1 + l2) the subdivision is Kuhn's: within a unit cube
    the path from the lowest corner to the highest takes the axes by descending fraction. Ties take the
    later axis first, which keeps the cumulative coordinates ascending and hence all nodes valid.
    """
    l0, l1, l2, _ = coordinates
    cumulative = [resolution * l0, resolution * (l0 + l1), resolution * (l0 + l1 + l2)]
    cumulative = [jnp.minimum(c, resolution) for c in cumulative]
    cells = [jnp.clip(jnp.floor(jax.lax.stop_gradient(c)), 0, resolution - 1) for c in cumulative]
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
    address = _addressing(layout, level, resolution, tet_ids)
    entries = []
    for taken in range(4):
        y1, y2, y3 = (cell + (rank < taken) for cell, rank in zip(low, ranks, strict=True))
        entries.append(address([y1, y2 - y1, y3 - y2, resolution - y3]))
    return entries, weights


def _addressing(layout: HashLayout, level: int, resolution: int, tet_ids: Int[Array, " M"]):  # type: ignore[no-untyped-def]
    """A function from nodes (four integer coordinates) to table entries of the level."""
    regions, ranks = layout.regions[level], layout.dense_ranks[level]
    num_masks = regions.shape[1]
    flat_regions, base = regions.reshape(-1), tet_ids * num_masks
    multipliers = [layout.multipliers[:, i][tet_ids] for i in range(4)] if ranks is None else []

    def address(node: Nodes) -> Int[Array, " M"]:
        if num_masks == 1:
            region = flat_regions[base]
        else:
            mask = sum((u > 0).astype(jnp.int32) << i for i, u in enumerate(node))
            region = flat_regions.at[base + mask].get(mode="promise_in_bounds")
        if ranks is not None:
            stride = resolution + 1
            local = ranks[((node[3] * stride + node[2]) * stride + node[1]) * stride + node[0]]
        else:
            mixed = [u.astype(jnp.uint32) * m for u, m in zip(node, multipliers, strict=True)]
            hashed = (mixed[0] ^ mixed[1]) ^ (mixed[2] ^ mixed[3])
            log2 = (region & ((1 << SIZE_BITS) - 1)).astype(jnp.uint32)
            local = (hashed & ((jnp.uint32(1) << log2) - 1)).astype(jnp.int32)
        return (region >> SIZE_BITS) + local

    return address
