"""Where rays enter the cage: the front-facing boundary faces on each ray's line, in order.

A tile of rays culls clusters of boundary faces together, with a cone around all of its rays. Where more than
`MAX_CULLED` are left, since the rays have no order, or there are more than `MAX_FLAGGED` to begin with, every
ray descends a tree of boxes on its own, whose leaves the clusters are.

Axes: B entries, T tets; rays are lanes, the last axis.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry import box_tree
from nimpostor_jax.geometry.intersect import (
    face_weights,
    passes_left,
    project,
    quick_face_weights,
    quick_passes_left,
)

MAX_CULLED = 512  # clusters that a tile tests one by one; more would cost each ray T^(2/3)
MAX_FLAGGED = 1 << 13  # clusters that a tile holds against its cone; of more, rays descend the tree


@struct.dataclass
class MarchTables:
    """The mesh's current geometry, rearranged for marching: made once, used for many calls."""

    corners: Float[Array, "3 4T"]  # positions of the corners, column 4 tet + corner
    next_holds: Int[Array, " 36T"]  # by code: 4 * (4 tet + f) + r on the other side; -1 outside
    face_corners: Float[Array, "clusters width 3 3"]  # boundary faces, as seen from outside
    face_holds: Int[Array, "clusters width"]  # 4 * (4 tet + f); -1 pads
    cluster_centers: Float[Array, "clusters 3"]
    cluster_radii: Float[Array, " clusters"]  # negative for empty clusters
    node_low: Float[Array, "nodes 3"]  # boxes of the tree whose leaves are the clusters (`box_tree`)
    node_high: Float[Array, "nodes 3"]


Points = Sequence[tuple[Array, ...]]


def mended(doubt: Bool[Array, " lanes"], careful: Callable[[], Any], quick: Any) -> Any:
    """What was found quickly, and in lanes of doubt what is found with care: they are rare, and care is dear.

    Accelerators compute both, since a branch would have the host wait.
    """

    def mend() -> Any:
        return jax.tree.map(partial(jnp.where, doubt), careful(), quick)

    return jax.lax.cond(jnp.any(doubt), mend, lambda: quick) if jax.default_backend() == "cpu" else mend()


def careful_sides(starts: Points, ends: Points) -> list[Bool[Array, " lanes"]]:
    """`passes_left` of each edge; stacked, as it is seldom asked for and would be compiled once for each."""
    u, v = ([jnp.stack([point[i] for point in points]) for i in range(2)] for points in (starts, ends))
    return list(passes_left(u, v))


def met_at(
    a: Sequence[Array], b: Sequence[Array], c: Sequence[Array], asked: Bool[Array, " lanes"]
) -> tuple[Float[Array, " lanes"], ...]:
    """t at which the line meets a projected triangle, and the weights of its first two corners.

    Lanes that are not asked for may have any numbers.
    """
    quick, flat = quick_face_weights(a, b, c)
    wa, wb, wc = mended(asked & flat, lambda: face_weights(a, b, c), quick)
    return wa * a[2] + wb * b[2] + wc * c[2], wa, wb


def search_entries(
    tables: MarchTables, config: MarchConfig, origin: tuple, axes: tuple
) -> tuple[Int[Array, "B lanes"], Int[Array, " lanes"]]:
    """The front-facing boundary faces on each lane's line by t: their holds (-1 pads), and count."""
    lanes, slots = origin[0].shape[0], config.max_entries_per_ray
    dtype = origin[0].dtype

    def test_face(corners: Sequence[tuple], hold: Int[Array, "*lanes"], found: tuple) -> tuple:
        a, b, c = (project(corner, origin, axes) for corner in corners)
        # Counter-clockwise from outside is clockwise along a ray that comes from outside.
        tests = [quick_passes_left(*edge) for edge in ((a, b), (b, c), (c, a))]
        quick, close = zip(*tests, strict=True)
        possible = (hold >= 0) & ((a[0] != b[0]) | (a[1] != b[1]))  # a point has no left and right
        possible &= ~(quick[0] | quick[1] | quick[2])  # nor is a tie left, quickly tested

        def insert() -> tuple:
            doubt = possible & (close[0] | close[1] | close[2])
            left = mended(doubt, lambda: careful_sides((a, b, c), (b, c, a)), list(quick))
            hit = possible & ~left[0] & ~left[1] & ~left[2]
            return _insert(found, jnp.where(hit, met_at(a, b, c, hit)[0], jnp.inf), hold)

        return jax.lax.cond(jnp.any(possible), insert, lambda: found)

    empty = (
        jnp.full((slots, lanes), jnp.inf, dtype),
        jnp.full((slots, lanes), -1, jnp.int32),
        jnp.zeros(lanes, jnp.int32),
    )
    clusters = tables.face_holds.shape[0]

    def by_lanes() -> tuple:
        return _entries_of_lanes(tables, origin, axes, test_face, empty)

    if clusters > MAX_FLAGGED:
        found = by_lanes()
    else:
        near = _near_clusters(tables, origin, axes[2])
        by_tile = partial(_entries_of_tile, tables, near, test_face, empty)
        few = jnp.sum(near) <= MAX_CULLED
        found = by_tile() if clusters <= MAX_CULLED else jax.lax.cond(few, by_tile, by_lanes)
    _, holds, count = found
    return holds, count


def _entries_of_tile(
    tables: MarchTables, near: Bool[Array, " clusters"], test_face: Callable[..., tuple], found: tuple
) -> tuple:
    """Fold `test_face` over the clusters near any of the tile's lines: all lanes test the same face."""
    clusters, width = tables.face_holds.shape
    words = _pack_bits(near)

    def test_cluster(cluster: Int[Array, ""], found: tuple) -> tuple:
        def test(i: Int[Array, ""], found: tuple) -> tuple:
            corners = [tuple(corner) for corner in tables.face_corners[cluster, i]]
            return test_face(corners, tables.face_holds[cluster, i], found)

        return jax.lax.fori_loop(0, width, test, found)

    def test_next_cluster(state: tuple) -> tuple:
        word, bits, found = state
        lowest = jax.lax.population_count(~bits & (bits - 1)).astype(jnp.int32)
        cluster = jnp.minimum(32 * word + lowest, clusters - 1)
        found = jax.lax.cond(bits != 0, lambda: test_cluster(cluster, found), lambda: found)
        bits = bits & (bits - 1)
        word = jnp.where(bits == 0, word + 1, word)
        bits = jnp.where(bits == 0, words[jnp.minimum(word, len(words) - 1)], bits)
        return word, bits, found

    start = (jnp.zeros((), jnp.int32), words[0], found)
    return jax.lax.while_loop(lambda s: s[0] < len(words), test_next_cluster, start)[2]


def _entries_of_lanes(
    tables: MarchTables, origin: tuple, axes: tuple, test_face: Callable[..., tuple], found: tuple
) -> tuple:
    """Fold `test_face` over the clusters near each lane's line: lanes descend the tree on their own.

    They wait for each other at leaves only, where the faces are tested.
    """
    clusters, width = tables.face_holds.shape
    middle = (tables.node_low + tables.node_high) / 2
    half = (tables.node_high - tables.node_low) / 2  # negative for nodes without faces
    columns = [(middle[:, i], half[:, i]) for i in range(3)]
    spans = [[jnp.abs(part) for part in axis] for axis in axes[:2]]

    def near(node: Int[Array, " lanes"]) -> Bool[Array, " lanes"]:
        """Whether the line passes through the box's bounding rectangle, as seen along it."""
        offset = [center[node] - o for (center, _), o in zip(columns, origin, strict=True)]
        size = [extent[node] for _, extent in columns]
        # Rounding of a projection; the box has a margin for what is in its own coordinates
        rounding = 16 * jnp.finfo(size[0].dtype).eps * sum(jnp.abs(o) for o in offset)
        inside = size[0] >= 0
        for axis, span in zip(axes[:2], spans, strict=True):
            across = sum(a * o for a, o in zip(axis, offset, strict=True))
            inside &= jnp.abs(across) <= sum(s * h for s, h in zip(span, size, strict=True)) + rounding
        return inside

    def descend(state: tuple) -> tuple:
        node, ready = state
        hit = near(node)
        leaf = node >= clusters
        after = box_tree.skip(node)
        moved = jnp.where(hit, 2 * node, jnp.where(after > 1, after, 0))
        stays = ready | (node == 0)
        return jnp.where(stays | (hit & leaf), node, moved), ready | (hit & leaf)

    def test_next_leaves(state: tuple) -> tuple:
        node, found = state
        waiting = (node, jnp.zeros(node.shape, bool))
        node, ready = jax.lax.while_loop(lambda s: jnp.any((s[0] > 0) & ~s[1]), descend, waiting)
        cluster = jnp.where(ready, node - clusters, 0)
        for i in range(width):
            face = tables.face_corners[:, i].reshape(clusters, 9)
            corners = [tuple(face[cluster, 3 * j + k] for k in range(3)) for j in range(3)]
            hold = jnp.where(ready, tables.face_holds[cluster, i], -1)
            found = test_face(corners, hold, found)
        after = box_tree.skip(node)
        return jnp.where(ready & (after > 1), after, 0), found

    start = (jnp.ones(origin[0].shape, jnp.int32), found)
    return jax.lax.while_loop(lambda s: jnp.any(s[0] > 0), test_next_leaves, start)[1]


def _near_clusters(tables: MarchTables, origin: tuple, direction: tuple) -> Bool[Array, " clusters"]:
    """Clusters that some line of the tile may meet: their spheres against a double cone around all lines.

    A line at angle alpha to the cone's axis, through a point within rho of its apex, is at most
    rho + (|s| + rho) tan(alpha) from the axis at height s. A sphere adds its radius to both lengths.
    """
    apex = [jnp.mean(o) for o in origin]
    mean = [jnp.mean(d) for d in direction]
    length = jnp.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2)
    axis = [m / jnp.maximum(length, 1e-6) for m in mean]
    cosine = jnp.min(sum(d * a for d, a in zip(direction, axis, strict=True)))
    tangent = jnp.sqrt(jnp.maximum(1 - cosine**2, 0)) / jnp.maximum(cosine, 1e-6)
    rho = jnp.sqrt(jnp.max(sum((o - a) ** 2 for o, a in zip(origin, apex, strict=True))))

    offset = [tables.cluster_centers[:, i] - apex[i] for i in range(3)]
    height = sum(o * a for o, a in zip(offset, axis, strict=True))
    squared = sum((o - height * a) ** 2 for o, a in zip(offset, axis, strict=True))
    margin = 1e-4 * (jnp.abs(height) + tables.cluster_radii)  # rounding of cosine and height, generously
    reach = tables.cluster_radii + rho
    far = jnp.sqrt(squared) > margin + reach + (jnp.abs(height) + reach) * (tangent + 1e-3)
    # One ray that is not finite makes all of this NaN, which is not far.
    return (~far | (cosine < 0.1)) & (tables.cluster_radii >= 0)


def _pack_bits(flags: Bool[Array, " n"]) -> Array:
    """Flags as words of 32 bits, the first flag lowest."""
    rows = jnp.pad(flags, (0, -len(flags) % 32)).reshape(-1, 32).astype(jnp.uint32)
    return jnp.sum(rows << jnp.arange(32, dtype=jnp.uint32), axis=1, dtype=jnp.uint32)


def _insert(found: tuple, t: Float[Array, " lanes"], hold: Int[Array, "*lanes"]) -> tuple:
    """Insert hits (t is inf elsewhere) into the lanes' lists, sorted by t; what falls off is only counted."""
    ts, holds, count = found
    count = count + (t < jnp.inf).astype(jnp.int32)
    hold = jnp.broadcast_to(hold, t.shape)
    new_ts, new_holds = [], []
    for old_t, old_hold in zip(ts, holds, strict=True):
        before = t < old_t
        new_ts.append(jnp.where(before, t, old_t))
        new_holds.append(jnp.where(before, hold, old_hold))
        t, hold = jnp.where(before, old_t, t), jnp.where(before, old_hold, hold)
    return jnp.stack(new_ts), jnp.stack(new_holds), count
