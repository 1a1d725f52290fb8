"""Several levels of a simplex-interpolated encoding as one: the same features from fewer lookups.

Where each grid refines the one before, features are linear within every simplex of the finest. Its nodes'
features, of all levels, therefore say all: a point takes 4 rows of one table instead of 4 of each level's.
Levels are put into chains of such grids (1, 2, 4, 8, ... and 3, 6, 12, ...). Nodes are stored tet by tet, in
order of their cumulative coordinates y1 <= y2 <= y3 (`tet_grid`), so that a node's number is arithmetic. For
rendering only: nothing here is trained.

Axes: M points, T tets, n = (N + 1)(N + 2)(N + 3) / 6 nodes of a tet, L levels, F features per level.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import default_chunk, for_chunks, pad_items, put, take
from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.encoding.interpolation import kuhn_corners
from nimpostor_jax.encoding.tet_grid import by_vertex
from nimpostor_jax.types import HashLayout, HashTables, MergedTables

POINTS = 1 << 18  # that are encoded at once, to find the nodes' features
Chains = tuple[tuple[int, ...], ...]


def merge_levels(
    tables: HashTables, config: EncodingConfig, max_megabytes: float = 256
) -> HashTables | MergedTables:
    """The tables with as many of the coarsest levels merged as fit; as they are where that spares no lookup.

    Exact up to rounding. Features come in another order: `feature_order`. Interpolation must be `simplex`.
    """
    chains = _chains(tables, config, max_megabytes)
    count = sum(map(len, chains))
    if count == len(chains):
        return tables
    layout: HashLayout = tables.layout  # type: ignore[assignment]
    return MergedTables(
        nodes=tuple(_node_features(tables, config, chain) for chain in chains),
        corner_order=_orders(layout, config),
        finer=tables if count < config.num_levels else None,
        chains=chains,
    )


def _chains(tables: HashTables, config: EncodingConfig, max_megabytes: float) -> Chains:
    """Levels whose resolutions divide one another, from the coarsest on, as many as fit into the memory."""
    if config.interpolation != "simplex" or not isinstance(tables.layout, HashLayout):
        return ()
    row = tables.layout.corner_order.shape[0] * config.features_per_level * tables.features.itemsize
    resolutions = config.resolutions
    chains: list[list[int]] = []
    for level, resolution in enumerate(resolutions):
        grown = [list(chain) for chain in chains]
        for chain in grown:
            if resolution % resolutions[chain[-1]] == 0:
                chain.append(level)
                break
        else:
            grown.append([level])
        if row * sum(len(c) * num_nodes(resolutions[c[-1]]) for c in grown) > max_megabytes * 2**20:
            break
        chains = grown
    return tuple(map(tuple, chains))


def feature_order(tables: HashTables | MergedTables, config: EncodingConfig) -> Int[np.ndarray, " L*F"]:
    """Where a point's features stand in those of the tables that were merged."""
    levels = list(range(config.num_levels))
    if isinstance(tables, MergedTables):
        merged = [level for chain in tables.chains for level in chain]
        levels = [*merged, *levels[len(merged) :]]
    width = config.features_per_level
    return (np.array(levels)[:, None] * width + np.arange(width)).ravel()


def num_nodes(resolution: int) -> int:
    """n."""
    return (resolution + 1) * (resolution + 2) * (resolution + 3) // 6


def node_coordinates(resolution: int) -> Int[np.ndarray, "n 3"]:
    """Cumulative coordinates of a tet's nodes, by number."""
    span = range(resolution + 1)
    return np.array([(y1, y2, y3) for y3 in span for y2 in range(y3 + 1) for y1 in range(y2 + 1)])


def node_number(y1: Int[Array, " M"], y2: Int[Array, " M"], y3: Int[Array, " M"]) -> Int[Array, " M"]:
    """Inverse of `node_coordinates`: the combinatorial number system."""
    return y3 * (y3 + 1) * (y3 + 2) // 6 + y2 * (y2 + 1) // 2 + y1


def _node_features(
    tables: HashTables, config: EncodingConfig, chain: tuple[int, ...]
) -> Float[Array, "T*n C"]:
    """What the chain's levels have at the nodes of the finest."""
    resolution, layout = config.resolutions[chain[-1]], tables.layout
    nodes = node_coordinates(resolution)
    steps = np.diff(nodes, axis=1, prepend=0, append=resolution)  # by ascending vertex id
    weights = jnp.asarray(steps / resolution, jnp.result_type(tables.features, jnp.float32))
    num_points = layout.corner_order.shape[0] * len(nodes)  # type: ignore[union-attr]
    per_call = max(1, POINTS // len(nodes)) * len(nodes)
    features = [
        _features_at(tables, config, chain, weights, jnp.int32(start), per_call)
        for start in range(0, num_points, per_call)
    ]
    return jnp.concatenate(features)[:num_points]


@partial(jax.jit, static_argnames=("config", "chain", "count"))
def _features_at(
    tables: HashTables,
    config: EncodingConfig,
    chain: tuple[int, ...],
    weights: Float[Array, "n 4"],
    start: Array,
    count: int,
) -> Float[Array, "count C"]:
    """Features of nodes, numbered over all tets, from `start` on."""
    numbers = start + jnp.arange(count, dtype=jnp.int32)
    layout: HashLayout = tables.layout  # type: ignore[assignment]
    tets = jnp.minimum(numbers // len(weights), layout.corner_order.shape[0] - 1)
    ranks = jnp.argsort(_orders(layout, config), axis=1)[tets]
    lambdas = jnp.take_along_axis(weights[numbers % len(weights)], ranks, axis=1)
    features = encode(tables, config, tets, lambdas).reshape(count, config.num_levels, -1)
    return features[:, np.array(chain)].reshape(count, -1).astype(tables.features.dtype)


def _orders(layout: HashLayout, config: EncodingConfig) -> Int[Array, "T 4"]:
    """The order in which the encoding takes a tet's corners."""
    own = jnp.broadcast_to(jnp.arange(4, dtype=jnp.int32), layout.corner_order.shape)
    return own if config.layout == "per_tet" else layout.corner_order


def encode_merged(
    tables: MergedTables,
    config: EncodingConfig,
    tet_ids: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
    num_used: Int[Array, ""] | None = None,
) -> Float[Array, "M L*F"]:
    """As `hash_grid.encode` of the tables that were merged, in `feature_order`; `config` is theirs.

    Not differentiable in reverse mode.
    """
    num_points, chunk = tet_ids.shape[0], default_chunk(tet_ids.shape[0])
    used = jnp.asarray(num_points if num_used is None else num_used, jnp.int32)
    items, parts = pad_items((tet_ids, lambdas), chunk), []
    for chain, nodes in zip(tables.chains, tables.nodes, strict=True):
        resolution = config.resolutions[chain[-1]]
        encode_chunk = partial(_encode_chunk, tables.corner_order, nodes, resolution, items, chunk)
        shape = (len(items[0]), nodes.shape[1])
        out = jnp.zeros(shape, jnp.result_type(nodes, lambdas))
        out = for_chunks(used, num_points, chunk, encode_chunk, out)
        parts.append(out[:num_points])
    if tables.finer is not None:
        count = sum(map(len, tables.chains))
        finer = encode(tables.finer, config, tet_ids, lambdas, num_used, first_level=count)
        parts.append(finer[:, count * config.features_per_level :])
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=1)


def _encode_chunk(
    corner_order: Int[Array, "T 4"],
    nodes: Float[Array, "T*n C"],
    resolution: int,
    items: tuple,
    chunk: int,
    start: Array,
    out: Float[Array, "M C"],
) -> Float[Array, "M C"]:
    tets, places = take(items, start, chunk)
    l0, l1, l2, _ = by_vertex(corner_order, tets, jnp.clip(places, 0, 1))
    weights, corners = kuhn_corners(jnp.int32(resolution), (l0, l0 + l1, l0 + l1 + l2))
    first = tets * num_nodes(resolution)
    rows = (nodes.at[first + node_number(*y)].get(mode="promise_in_bounds") for y in corners)
    return put(out, start, sum(w[:, None] * row for w, row in zip(weights, rows, strict=True)))
