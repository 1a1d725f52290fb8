"""The query Q of Eq. 2: which tet holds a point, and the point's barycentric coordinates there.

A coarse grid over the cage names a tet near each point, or that there is none; from there a walk
crosses the face that the point lies farthest behind. It ends in the point's tet, or beyond a face
of the cage's convex hull. A few steps settle most points; the others are gathered and walk on.
What even this does not settle (it left a cage that is not convex, ran in a circle, or ended within
rounding of a face) descends the binary tree over tets, which finds every candidate. All tables
follow from the current vertices in a few reductions and scatters.

Axes: N points, T tets. Containment is decided by distances to the faces' planes: their rounding
errors are of one size everywhere, whatever the tet's shape, and two tets see their common face in
the same plane bit for bit.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int

from nimpostor_jax.geometry import box_tree
from nimpostor_jax.geometry.barycentric import barycentric
from nimpostor_jax.geometry.tetrahedron import FACES, corners, cross, signed_volumes
from nimpostor_jax.types import TetMesh

TOLERANCE = 8  # units in the last place of the cage's extent: how far outside a point may round to
CELLS_PER_TET = 8
MAX_RESOLUTION = 96  # cells a side
FLOOD_ROUNDS = 4
WALK_STEPS = 4  # of all points: the few that need more are cheaper gathered
LONG_WALK_STEPS = 40  # of gathered points; then they run in a circle
CPU_TILE = 512  # gathered points that walk on or descend the tree together
HULL_TESTS = 1 << 25  # boundary faces times vertices: for larger meshes the test costs more than the tree
_UNSETTLED = -2  # the walk holds -2 - tet while it goes on, the tet when settled, -1 outside


@struct.dataclass
class LocateTables:
    """The mesh's current geometry, rearranged for `locate`: made once, used for many calls."""

    planes: Float[Array, " 16T"]  # at 16 tet + 4 corner: the face opposite, inward normal and offset
    neighbors: Int[Array, " 4T"]
    hull_faces: Int[Array, " T"]  # bit i: nothing of the mesh lies beyond the face opposite corner i
    seeds: Int[Array, " cells"]  # a tet near the cell's centre; -1 where no tet can reach the cell
    low: Float[Array, " 3"]  # box of the cage
    high: Float[Array, " 3"]
    node_low: Float[Array, "nodes 3"]  # binary tree of boxes, one tet a leaf
    node_high: Float[Array, "nodes 3"]
    leaf_tets: Int[Array, " leaves"]  # -1 pads
    tolerance: Float[Array, ""]


@jax.jit
def locate_tables(mesh: TetMesh) -> LocateTables:
    """What `locate` reads from the mesh; call again when vertices have moved."""
    vertices = jax.lax.stop_gradient(mesh.vertices)
    positions = corners(vertices, mesh.tets)
    low, high = jnp.min(positions, axis=1), jnp.max(positions, axis=1)
    extent = jnp.max(jnp.abs(positions))
    tolerance = (TOLERANCE * jnp.finfo(vertices.dtype).eps * extent).astype(vertices.dtype)

    width = mesh.tet_leaves.shape[1]
    padding = (1 << (width - 1).bit_length()) - width
    leaf_tets = jnp.pad(mesh.tet_leaves, ((0, 0), (0, padding)), constant_values=-1).reshape(-1)
    used = (leaf_tets >= 0)[:, None]
    node_low, node_high = box_tree.refit(
        jnp.where(used, low[leaf_tets], jnp.inf), jnp.where(used, high[leaf_tets], -jnp.inf)
    )
    box_low, box_high = jnp.min(low, axis=0), jnp.max(high, axis=0)
    planes = _planes(vertices, mesh.tets)
    return LocateTables(
        planes=planes.reshape(-1),
        neighbors=mesh.neighbors.reshape(-1),
        hull_faces=_hull_faces(mesh, vertices, planes, tolerance),
        seeds=_seeds(positions, low - tolerance, high + tolerance, box_low, box_high),
        low=box_low,
        high=box_high,
        node_low=node_low,
        node_high=node_high,
        leaf_tets=leaf_tets,
        tolerance=tolerance,
    )


def _planes(vertices: Float[Array, "V 3"], tets: Int[Array, "T 4"]) -> Float[Array, "T 4 4"]:
    """Unit normal and offset of each face; positive distances lie on the side of the opposite
    corner.

    Computed from the face's corners by ascending vertex id: the other tet of the face gets the same
    numbers with the other sign. A face without area belongs to a tet without volume: its offset
    keeps all points out.
    """
    faces = tets[:, np.array(FACES)]
    ordered = jnp.sort(faces, axis=-1)
    a, b, c = (faces[..., i] for i in range(3))
    even = ((a < b) & (b < c)) | ((b < c) & (c < a)) | ((c < a) & (a < b))
    inverted = signed_volumes(corners(vertices, tets))[:, None] < 0
    first, second, third = (vertices[ordered[..., i]] for i in range(3))
    edges = second - first, third - first
    normal = cross(*edges)
    squared = jnp.sum(normal * normal, axis=-1, keepdims=True)
    # The normal of a face without area is rounding, which compiled programs leave where others cancel.
    rounding = (TOLERANCE * jnp.finfo(vertices.dtype).eps) ** 2
    across, along = (jnp.sum(edge * edge, axis=-1, keepdims=True) for edge in edges)
    valid = squared > rounding * across * along
    # FACES are counter-clockwise seen from outside a tet that is not inverted.
    outward = jnp.where(even ^ inverted, 1, -1).astype(vertices.dtype)[..., None]
    normal = -outward * normal / jnp.sqrt(jnp.where(valid, squared, 1))
    offset = -jnp.sum(normal * first, axis=-1, keepdims=True)
    return jnp.concatenate([normal, jnp.where(valid, offset, -jnp.inf)], axis=-1)


def _hull_faces(
    mesh: TetMesh, vertices: Float[Array, "V 3"], planes: Float[Array, "T 4 4"], tolerance: Float[Array, ""]
) -> Int[Array, " T"]:
    """For each tet the boundary faces, as bits, whose planes have all vertices on one side.

    A point beyond such a face is outside, convex mesh or not, and need not descend the tree.
    """
    tets, local = mesh.boundary.tets.reshape(-1), mesh.boundary.corners.reshape(-1)
    none = jnp.zeros(len(mesh.tets), jnp.int32)
    if tets.shape[0] * vertices.shape[0] > HULL_TESTS:
        return none
    plane = planes[jnp.maximum(tets, 0), jnp.maximum(local, 0)][:, :, None]  # [faces, 4, 1]
    x, y, z = (vertices[:, i] for i in range(3))
    lowest = jnp.min(plane[:, 0] * x + plane[:, 1] * y + plane[:, 2] * z + plane[:, 3], axis=1)
    on_hull = (tets >= 0) & (lowest >= -tolerance / 2)
    return none.at[jnp.where(on_hull, tets, len(none))].add(1 << local, mode="drop")


def _seeds(
    positions: Float[Array, "T 4 3"],
    low: Float[Array, "T 3"],
    high: Float[Array, "T 3"],
    grid_low: Float[Array, " 3"],
    grid_high: Float[Array, " 3"],
) -> Int[Array, " cells"]:
    """For each grid cell a tet near its centre, -1 where no tet's box (low, high) reaches it."""
    num_tets = positions.shape[0]
    side = min(max(1, round((CELLS_PER_TET * num_tets) ** (1 / 3))), MAX_RESOLUTION)

    # Boxes over each cell: +-1 at the corners of every tet's range of cells, then running sums.
    first = _cells(low, grid_low, grid_high, side)
    last = _cells(high, grid_low, grid_high, side) + 1
    picks = np.array(list(np.ndindex(2, 2, 2)))
    ends = jnp.where(picks[:, None, :] == 1, last, first)  # [8, T, 3]
    signs = jnp.asarray((-1.0) ** picks.sum(axis=1), jnp.float32)[:, None]
    counts = jnp.zeros((side + 1,) * 3, jnp.float32)
    counts = counts.at[ends[..., 0], ends[..., 1], ends[..., 2]].add(signs)
    running = jnp.tri(side + 1, dtype=jnp.float32)  # sums of integers below 2**24: exact
    for _ in range(3):
        counts = jnp.tensordot(counts, running, (0, 1), precision="highest")  # rotates the axes

    centroids = jnp.mean(positions, axis=1, keepdims=True)
    samples = jnp.concatenate([centroids, (centroids + positions) / 2], axis=1)
    cells = _cells(samples, grid_low, grid_high, side)
    tets = jnp.arange(num_tets, dtype=jnp.int32)[:, None]
    seeds = jnp.full((side,) * 3, -1, jnp.int32)
    seeds = seeds.at[cells[..., 0], cells[..., 1], cells[..., 2]].max(tets)

    def flood(_: Int[Array, ""], seeds: Int[Array, "side side side"]) -> Int[Array, "side side side"]:
        # A tet that comes around the grid's edge is a bad hint, not a wrong answer.
        for axis in range(3):
            sides = jnp.maximum(jnp.roll(seeds, 1, axis), jnp.roll(seeds, -1, axis))
            seeds = jnp.where(seeds < 0, sides, seeds)
        return seeds

    seeds = jax.lax.fori_loop(0, FLOOD_ROUNDS, flood, seeds)
    return jnp.where(counts[:-1, :-1, :-1] > 0, jnp.maximum(seeds, 0), -1).reshape(-1)


def _cells(
    points: Float[Array, "*batch 3"], low: Float[Array, " 3"], high: Float[Array, " 3"], side: int
) -> Int[Array, "*batch 3"]:
    """Grid cell of each point along each axis; monotone in the point, rounding included."""
    size = high - low
    cells = jnp.floor((points - low) * (side / jnp.where(size > 0, size, 1)))
    return jnp.clip(cells, 0, side - 1).astype(jnp.int32)


@jax.jit
def find_tets(tables: LocateTables, points: Float[Array, "N 3"]) -> Int[Array, " N"]:
    """The tet of each point, -1 outside; points in the mesh's own frame."""
    if not points.shape[0]:
        return jnp.zeros(0, jnp.int32)
    points = jax.lax.stop_gradient(points)
    columns = tuple(points[:, i] for i in range(3))
    state = _start(tables, points)
    state = jax.lax.fori_loop(0, WALK_STEPS, lambda _, state: _step(tables, columns, state), state)
    return _settle(tables, columns, _settle(tables, columns, state, _walk_on), _search_tree)


def _start(tables: LocateTables, points: Float[Array, "N 3"]) -> Int[Array, " N"]:
    """The walk's state at the seeds."""
    low, high = tables.low - tables.tolerance, tables.high + tables.tolerance
    near = jnp.all((points >= low) & (points <= high), axis=1)
    side = round(tables.seeds.shape[0] ** (1 / 3))
    cells = _cells(points, tables.low, tables.high, side)
    seeds = tables.seeds[(cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2]]

    return jnp.where(near & (seeds >= 0), _UNSETTLED - seeds, -1)


def _step(tables: LocateTables, columns: tuple, state: Int[Array, " N"]) -> Int[Array, " N"]:
    """Across the face that the point lies farthest behind.

    One array of state: XLA would compute the distances again for a second one.
    """
    tet = jnp.maximum(_UNSETTLED - state, 0)
    distances = _distances(tables, columns, tet)
    depth, nearest = distances[0], jnp.asarray(0, jnp.int32)
    for corner in range(1, 4):
        nearest = jnp.where(distances[corner] < depth, corner, nearest)
        depth = jnp.minimum(distances[corner], depth)
    # Twice: vertices are beyond by half a tolerance at most, so the point is by more than one.
    behind = sum((d < -2 * tables.tolerance).astype(jnp.int32) << i for i, d in enumerate(distances))
    neighbor = tables.neighbors[4 * tet + nearest]
    moved = jnp.where(neighbor >= 0, _UNSETTLED - neighbor, state)
    moved = jnp.where((behind & tables.hull_faces[tet]) != 0, -1, moved)
    moved = jnp.where(depth >= tables.tolerance, tet, moved)
    return jnp.where(state <= _UNSETTLED, moved, state)


def _walk_on(tables: LocateTables, columns: tuple, state: Int[Array, " lanes"]) -> Int[Array, " lanes"]:
    """More steps, as long as they lead anywhere."""

    def step(carry: tuple) -> tuple:
        count, state, _ = carry
        moved = _step(tables, columns, state)
        return count + 1, moved, jnp.any(moved != state)

    start = (jnp.zeros((), jnp.int32), state, jnp.asarray(True))
    return jax.lax.while_loop(lambda carry: (carry[0] < LONG_WALK_STEPS) & carry[2], step, start)[1]


def _distances(tables: LocateTables, columns: tuple, tets: Int[Array, " N"]) -> list[Float[Array, " N"]]:
    """Distances to the planes of the tet's four faces, negative outside."""
    x, y, z = columns
    distances = []
    for corner in range(4):
        plane = [tables.planes[16 * tets + (4 * corner + i)] for i in range(4)]
        distances.append(plane[0] * x + plane[1] * y + plane[2] * z + plane[3])
    return distances


def _settle(
    tables: LocateTables, columns: tuple, walked: Int[Array, " N"], method: Callable[..., Array]
) -> Int[Array, " N"]:
    """The state after `method` on the points not settled yet, `CPU_TILE` gathered ones at a time."""
    unsettled = walked <= _UNSETTLED
    num_points = walked.shape[0]
    on_cpu = jax.default_backend() == "cpu"
    tile = min(num_points, CPU_TILE) if on_cpu else num_points
    ranks = jnp.cumsum(unsettled, dtype=jnp.int32) - 1
    queue = jnp.full(num_points + tile, num_points, jnp.int32)  # past its end: points that are none
    queue = queue.at[jnp.where(unsettled, ranks, num_points + tile)].set(
        jnp.arange(num_points, dtype=jnp.int32), mode="drop"
    )

    def body(state: tuple) -> tuple:
        start, settled = state
        chosen = jax.lax.dynamic_slice(queue, (start,), (tile,))
        held = jnp.minimum(chosen, num_points - 1)
        found = method(tables, tuple(column[held] for column in columns), settled[held])
        return start + tile, settled.at[chosen].set(found, mode="drop")

    start = (jnp.zeros((), jnp.int32), walked)
    return jax.lax.while_loop(lambda state: state[0] <= ranks[-1], body, start)[1]


def _search_tree(tables: LocateTables, columns: tuple, _: Int[Array, " lanes"]) -> Int[Array, " lanes"]:
    """Of the tets that hold a point up to the tolerance, that in which it lies deepest; else -1."""
    num_leaves = tables.leaf_tets.shape[0]
    boxes = [(tables.node_low[:, i], tables.node_high[:, i]) for i in range(3)]
    lanes = columns[0].shape

    def step(state: tuple) -> tuple:
        node, best, found = state
        hit = node > 0
        for (low, high), x in zip(boxes, columns, strict=True):
            hit &= (low[node] <= x) & (x <= high[node])
        leaf = node - num_leaves
        tet = tables.leaf_tets[jnp.maximum(leaf, 0)]
        distances = _distances(tables, columns, jnp.maximum(tet, 0))
        depth = jnp.minimum(jnp.minimum(*distances[:2]), jnp.minimum(*distances[2:]))
        better = (depth > best) | ((depth == best) & (tet < found))
        better &= hit & (leaf >= 0) & (tet >= 0)
        best, found = jnp.where(better, depth, best), jnp.where(better, tet, found)
        after = box_tree.skip(node)
        after = jnp.where(hit & (leaf < 0), 2 * node, jnp.where(after > 1, after, 0))
        return jnp.where((node > 0) & (best < tables.tolerance), after, 0), best, found

    start = (
        jnp.ones(lanes, jnp.int32),
        jnp.full(lanes, -jnp.inf, columns[0].dtype),
        jnp.full(lanes, -1, jnp.int32),
    )
    _, best, found = jax.lax.while_loop(lambda state: jnp.any(state[0] > 0), step, start)
    return jnp.where(best >= -tables.tolerance, found, -1)


@jax.jit
def locate(
    mesh: TetMesh, points: Float[Array, "*batch 3"], tables: LocateTables | None = None
) -> tuple[Int[Array, "*batch"], Float[Array, "*batch 4"]]:
    """Tet and barycentric coordinates of points in world units (Eq. 2); -1 and zeros outside.

    Differentiable in points and vertices. A point on a common face, edge or vertex belongs to the
    tet in which it lies deepest after rounding, of equals the first: a function of mesh and point
    alone. Points up to `TOLERANCE` units in the last place of the cage's extent outside of it count
    as inside, so that none of its points is lost to rounding; coordinates may be negative by as
    much. Where a folded cage covers a point several times, one of the tets is returned. Non-finite
    points are outside.

    `tables`: `locate_tables(mesh)`, to share over several calls. Memory is points + tets.
    """
    local = (points - mesh.center) / mesh.scale
    flat = local.reshape(-1, 3)
    tets = find_tets(locate_tables(mesh) if tables is None else tables, flat)
    inside = tets >= 0
    held = jnp.maximum(tets, 0)
    positions = corners(mesh.vertices, mesh.tets[held])
    held_points = jnp.where(inside[:, None], flat, positions[:, 0])  # outside: finite gradients too
    lambdas = jnp.where(inside[:, None], barycentric(held_points, positions), 0)
    return tets.reshape(points.shape[:-1]), lambdas.reshape(*points.shape[:-1], 4)
