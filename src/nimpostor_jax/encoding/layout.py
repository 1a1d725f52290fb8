"""Who owns a grid node: packed table regions per tet, or per vertex, edge, face and tet (Sec. 3.3).

Level l puts a 4D grid of resolution N over the barycentric coordinates of every tet. Only nodes near the
plane sum(u) = N are ever read: N - 3 <= sum(u) <= N + 3 by the 16 corners of a voxel, sum(u) = N by the
4 corners of a simplex. The set of a node's nonzero coordinates, its 4-bit mask, names the sub-simplex of the
tet on which it lies. `per_tet` gives all masks of a tet one region (the paper's tables); `per_simplex` gives
one to each sub-simplex of the mesh, which all tets around it share: the field is then continuous.

Nodes of a level that fit are numbered without collisions (`dense_ranks`); otherwise they are hashed within
their region. A sub-simplex' region is the larger, the larger the tets around it are. Host code, NumPy.
"""

import itertools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from nimpostor_jax.config import EncodingConfig
from nimpostor_jax.types import HashLayout

NGP_PRIMES = (
    1,
    2654435761,
    805459861,
    3674653429,
)  # Instant-NGP's, and one more for the fourth coordinate
DENSE_RESOLUTION_LIMIT = 16  # (N + 1)^4 numbers a level must stay small beside the tables
SIZE_BITS = 5  # a region is packed as offset << SIZE_BITS | log2(size)
DENSE = (1 << SIZE_BITS) - 1  # in the place of log2(size), of a region that is dense at a mixed level


def slab_half_width(config: EncodingConfig) -> int:
    """How far from the plane sum(u) = N the interpolation reads."""
    return 3 if config.interpolation == "grid" else 0


def build_layout(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], config: EncodingConfig
) -> HashLayout:
    """The layout for a mesh, in the pose in which its field is trained: only proportions of volumes matter.

    Raises ValueError where entries cannot be addressed in 32 bits. Host code.
    """
    vertices, tets = np.asarray(vertices, np.float64), np.asarray(tets)
    if config.layout == "per_tet":
        regions, entries, ranks = _per_tet(len(tets), config)
        multipliers = np.broadcast_to(np.array(NGP_PRIMES, np.uint32), tets.shape)
        order = np.broadcast_to(np.arange(4), tets.shape)
    else:
        order = np.argsort(tets, axis=1)
        ascending = np.take_along_axis(tets, order, axis=1)
        regions, entries, ranks = _per_simplex(vertices, ascending, config)
        multipliers = _vertex_multipliers(ascending)
    _check_addresses(entries, len(tets))
    dense = [rank for rank in ranks if rank is not None]  # the coarsest levels: nodes grow with them
    return HashLayout(
        starts=jnp.asarray([0, *itertools.accumulate(entries)], jnp.int32),
        regions=jnp.asarray(np.stack(regions), jnp.int32),
        multipliers=jnp.asarray(multipliers, jnp.uint32),
        corner_order=jnp.asarray(order, jnp.int32),
        dense_ranks=jnp.asarray(np.concatenate([*dense, np.zeros(0, np.int64)]), jnp.int32),
        rank_starts=jnp.asarray([0, *itertools.accumulate(map(len, dense))], jnp.int32),
    )


def _check_addresses(entries: list[int], num_tets: int) -> None:
    """Raise ValueError where so many entries by level cannot be addressed."""
    if max(entries) > 1 << (31 - SIZE_BITS) or sum(entries) >= 1 << 31:
        raise ValueError(
            f"{sum(entries):,} table entries for {num_tets} tets, {max(entries):,} of them in one level, "
            f"cannot be addressed (2**31, and 2**{31 - SIZE_BITS} a level); "
            "lower EncodingConfig.log2_table_size, its limits a tet, or log2_tet_table"
        )


def join_layouts(layouts: Sequence[HashLayout]) -> HashLayout:
    """One layout for the tets of several, of one config but for sizes and the number of levels.

    Level by level the entries of all layouts follow each other. Where one has fewer levels, a single entry
    stands for it. Levels that are dense in some layouts and hashed in others become mixed. Raises ValueError
    as `build_layout`.
    """
    num_levels = max(layout.regions.shape[0] for layout in layouts)
    num_dense = [layout.rank_starts.shape[0] - 1 for layout in layouts]
    always_dense = min(d - layout.num_mixed for d, layout in zip(num_dense, layouts, strict=True))
    regions, entries = [], []
    for level in range(num_levels):
        columns, count = [], 0
        for layout, dense in zip(layouts, num_dense, strict=True):
            if level < layout.regions.shape[0]:
                packed = np.asarray(layout.regions[level], np.int64)
                size = int(layout.starts[level + 1] - layout.starts[level])
                if always_dense <= level < dense - layout.num_mixed:
                    packed = packed | DENSE
            else:
                packed, size = np.zeros(layout.regions.shape[1:], np.int64), 1
            columns.append(packed + (count << SIZE_BITS))
            count += size
        regions.append(np.concatenate(columns))
        entries.append(count)
    _check_addresses(entries, len(regions[0]))
    most = layouts[int(np.argmax(num_dense))]
    return HashLayout(
        starts=jnp.asarray([0, *itertools.accumulate(entries)], jnp.int32),
        regions=jnp.asarray(np.stack(regions), jnp.int32),
        multipliers=jnp.concatenate([layout.multipliers for layout in layouts]),
        corner_order=jnp.concatenate([layout.corner_order for layout in layouts]),
        dense_ranks=most.dense_ranks,
        rank_starts=most.rank_starts,
        num_mixed=max(num_dense) - always_dense,
    )


def _per_tet(num_tets: int, config: EncodingConfig) -> tuple[list, list, list]:
    size = config.tet_table_size(num_tets)
    regions, entries, ranks = [], [], []
    for resolution in config.resolutions:
        rank = _dense_ranks(resolution, slab_half_width(config), by_mask=False)
        if rank is not None and rank.max() < size:
            count, log2 = int(rank.max()) + 1, 0
        else:
            rank, count, log2 = None, size, size.bit_length() - 1
        regions.append(((np.arange(num_tets) * count) << SIZE_BITS | log2)[:, None])
        entries.append(num_tets * count)
        ranks.append(rank)
    return regions, entries, ranks


def _per_simplex(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], config: EncodingConfig
) -> tuple[list, list, list]:
    """Regions [T, 16] by mask. A level has the budget at most, but an entry for each sub-simplex."""
    ids, counts = _sub_simplices(tets)
    areas = _areas_around(vertices, tets, ids, sum(counts))
    dimensions = np.repeat(np.arange(4), counts)
    budget = config.level_budget(len(tets))
    regions, entries, ranks = [], [], []
    for resolution in config.resolutions:
        by_dimension = _nodes_by_dimension(resolution, slab_half_width(config))
        nodes = np.array(by_dimension, np.float64)[dimensions]
        rank = _dense_ranks(resolution, slab_half_width(config), by_mask=True)
        if rank is not None and 1 + nodes.sum() <= budget:
            log2, sizes = np.zeros(len(nodes), np.int64), nodes.astype(np.int64)
        else:
            rank, log2 = None, _hashed_sizes(nodes, nodes * areas, budget - 1)
            sizes = np.int64(1) << log2
        offsets = 1 + np.cumsum(sizes) - sizes  # entry 0 of the level is the all-zero node's, mask 0
        packed = np.zeros((len(tets), 16), np.int64)
        packed[:, 1:] = (offsets << SIZE_BITS | log2)[ids[:, 1:]]
        regions.append(packed)
        entries.append(int(1 + sizes.sum()))
        ranks.append(rank)
    return regions, entries, ranks


def _areas_around(
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    ids: Int[np.ndarray, "T 16"],
    count: int,
) -> Float[np.ndarray, " S"]:
    """How large the largest tet around each sub-simplex looks: its volume**(2/3).

    A sixteenth of the median at least, so that flat tets have tables, too. Rounded, so that congruent tets
    are equal, and in the same order, on every machine.
    """
    corners = vertices[tets]
    areas = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) ** (2 / 3)
    areas = np.maximum(areas, np.median(areas) / 16).astype(np.float32)
    largest = np.zeros(count)
    np.maximum.at(largest, ids[:, 1:], areas[:, None])
    return largest


def _hashed_sizes(
    nodes: Float[np.ndarray, " S"], demand: Float[np.ndarray, " S"], budget: int
) -> Int[np.ndarray, " S"]:
    """log2 of each region's size: they double in turn, always the one with most demand for each entry.

    None gets more than its nodes need, and together they have the budget at most, or one entry each. A region
    whose doubling does not fit any more stays as it is; smaller ones may go on.
    """
    needed = np.ceil(np.log2(np.maximum(nodes, 1))).astype(np.int64)  # doublings of a single entry
    which = np.repeat(np.arange(len(nodes)), needed)
    doublings = np.arange(len(which)) - np.repeat(np.cumsum(needed) - needed, needed)
    turns = np.argsort(-demand[which] / 2.0**doublings, kind="stable")
    costs = np.int64(1) << doublings[turns]
    left = budget - len(nodes) - np.cumsum(costs)  # after each turn
    fits = left >= 0
    spare = int(left[fits][-1]) if fits.any() else budget - len(nodes)
    for turn in np.flatnonzero(~fits & (costs <= spare)):
        if costs[turn] <= spare:
            fits[turn] = True
            spare -= costs[turn]
    return np.bincount(which[turns[fits]], minlength=len(nodes))


def _sub_simplices(tets: Int[np.ndarray, "T 4"]) -> tuple[Int[np.ndarray, "T 16"], list[int]]:
    """The number of each tet's sub-simplex by mask, vertices first, and how many each dimension has."""
    ids = np.zeros((len(tets), 16), np.int64)
    counts: list[int] = []
    for size in range(1, 5):
        masks = [sum(1 << i for i in corners) for corners in itertools.combinations(range(4), size)]
        corners = [list(c) for c in itertools.combinations(range(4), size)]
        simplices = np.stack([tets[:, c] for c in corners], axis=1).reshape(-1, size)
        unique, inverse = np.unique(simplices, axis=0, return_inverse=True)
        ids[:, masks] = sum(counts) + inverse.reshape(len(tets), len(masks))
        counts.append(len(unique))
    return ids, counts


def _nodes_by_dimension(resolution: int, half_width: int) -> list[int]:
    """How many nodes near the plane have 1, 2, 3, 4 given coordinates nonzero (each at most N)."""
    counts = []
    ways = np.array([1], dtype=object)  # ways[s]: tuples with sum s
    single = np.array([0] + [1] * resolution, dtype=object)
    for _ in range(4):
        ways = np.convolve(ways, single)
        counts.append(int(sum(ways[max(resolution - half_width, 0) : resolution + half_width + 1])))
    return counts


def _dense_ranks(resolution: int, half_width: int, by_mask: bool) -> Int[np.ndarray, " nodes"] | None:
    """A number for every node of the (N+1)^4 grid, flattened with the first coordinate fastest.

    Nodes near the plane are counted from 0, within their mask where `by_mask`; others get 0. Equal nonzero
    coordinates get equal numbers whatever the mask, so tets on two sides of a face agree. None if N is large.
    """
    if resolution > DENSE_RESOLUTION_LIMIT:
        return None
    axis = np.arange(resolution + 1)
    nodes = np.stack(np.meshgrid(axis, axis, axis, axis, indexing="ij")[::-1], axis=-1).reshape(-1, 4)
    reachable = np.abs(nodes.sum(axis=1) - resolution) <= half_width
    masks = (nodes > 0) @ (1 << np.arange(4))
    ranks = np.zeros(len(nodes), np.int64)
    for mask in range(16) if by_mask else [None]:
        chosen = np.flatnonzero(reachable & (masks == mask) if by_mask else reachable)
        ranks[chosen] = np.arange(len(chosen))
    return ranks


def _vertex_multipliers(tets: Int[np.ndarray, "T 4"]) -> np.ndarray:
    """A hash factor per mesh vertex, odd: a sub-simplex then hashes alike from all tets around it."""
    bits = tets.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in (
        (30, 0xBF58476D1CE4E5B9),
        (27, 0x94D049BB133111EB),
    ):  # splitmix64's finaliser
        bits = (bits ^ (bits >> np.uint64(shift))) * np.uint64(factor)
    return ((bits ^ (bits >> np.uint64(31))) & np.uint64(0xFFFFFFFF)).astype(np.uint32) | np.uint32(1)
