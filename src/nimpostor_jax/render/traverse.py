"""Ray traversal of a tetrahedral cage with fixed-size buffers (Sec. 3.4, Fig. 4).

A ray enters the cage through front-facing boundary faces (`entries.py`). From each entry it walks from tet to
tet through common faces (Fig. 4, adjacent), leaves through a boundary face and goes on at the next entry
(separated). The walk carries the triangle through which it came, projected along the ray: one new vertex and
three edge tests decide the way out (Aman et al. 2021), and since a tet is always left by another face than it
was entered by, flat and inverted tets are passed as well.

A crossing is coded as 9 * (4 tet + f) + 3 r + s: the tet was entered by the face opposite corner f, whose
corners the walk holds in the order FACES[f] rotated by r, and left by the face without the s-th of these.

Axes: K tet slots, R rays, B entries, T tets. Rays are the last axis, in tiles ("lanes") and in the result.
Nothing here is differentiable; `segments.locate_segments` makes differentiable coordinates of the result.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry import box_tree
from nimpostor_jax.geometry.intersect import project, quick_passes_left, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.entries import MarchTables, careful_sides, mended, met_at, search_entries
from nimpostor_jax.types import Rays, TetMesh

CPU_TILE = 256  # an image tile: a larger one has a wider cone and waits longer for its last ray
CODES_PER_TET = 36


def _code_tables() -> tuple[np.ndarray, np.ndarray]:
    """For the 36 codes of a tet: the face left, and the held corners after it, (new, next, next but one)."""
    exit_faces = np.zeros(CODES_PER_TET, np.int32)
    triangles = np.zeros((CODES_PER_TET, 3), np.int32)
    for face, rotation, slot in np.ndindex(4, 3, 3):
        held = np.roll(FACES[face], -rotation)
        code = 9 * face + 3 * rotation + slot
        exit_faces[code] = held[slot]
        triangles[code] = face, held[(slot + 1) % 3], held[(slot + 2) % 3]
    return exit_faces, triangles


EXIT_FACES, EXIT_TRIANGLES = _code_tables()


def _held_as() -> np.ndarray:
    """4 f + r of the face f with the given corners in its order, or from its r-th one on; [4, 4, 4]."""
    table = np.zeros((4, 4, 4), np.int32)
    for face, rotation in np.ndindex(4, 3):
        table[tuple(np.roll(FACES[face], -rotation))] = 4 * face + rotation
    return table


_HELD_AS = _held_as()


@struct.dataclass
class Entries:
    """Where each ray's line enters the cage from outside, in order along the line; a fact of mesh and ray.

    Finding them costs more than marching: find them once for rays that are cast again. They hold for the same
    bits: a ray through an edge that is rounded otherwise may enter by the face on its other side.
    """

    holds: Int[Array, "R B"]  # 4 * (4 tet + f) of the boundary face; -1 pads
    overflow: Bool[Array, " R"]  # more entries than slots


Point = tuple[Float[Array, " lanes"], ...]
Ends = tuple[Float[Array, "K R"], ...]  # six


@struct.dataclass
class Crossings:
    """The tets that each ray's line crosses, as codes, in order along the line.

    `ends` holds t and the weights of the first two corners of the triangle held before the crossing, then
    the same three numbers of the triangle after it (`EXIT_TRIANGLES`).
    """

    codes: Int[Array, "K R"]  # -1 marks an empty slot
    ends: Ends
    overflow: Bool[Array, " R"]  # more tets or entries than slots


@jax.jit
def march_tables(mesh: TetMesh) -> MarchTables:
    """Gather what `traverse` reads from the mesh; call again when vertices have moved."""
    vertices = jax.lax.stop_gradient(mesh.vertices)
    used = mesh.boundary.tets >= 0
    tets, corners = jnp.maximum(mesh.boundary.tets, 0), jnp.maximum(mesh.boundary.corners, 0)
    triangles = vertices[mesh.tets[tets[..., None], jnp.asarray(FACES, jnp.int32)[corners]]]
    mask = used[..., None, None]
    low = jnp.min(jnp.where(mask, triangles, jnp.inf), axis=(1, 2))
    high = jnp.max(jnp.where(mask, triangles, -jnp.inf), axis=(1, 2))
    occupied = jnp.any(used, axis=1)
    centers = jnp.where(occupied[:, None], (low + high) / 2, 0)
    radii = jnp.sqrt(jnp.sum(jnp.where(occupied[:, None], (high - low) / 2, 0) ** 2, axis=-1))
    node_low, node_high = box_tree.refit(low, high)
    return MarchTables(
        corners=vertices[mesh.tets.reshape(-1)].T,
        next_holds=_next_holds(mesh.tets, mesh.neighbors),
        face_corners=triangles,
        face_holds=jnp.where(used, 4 * (4 * tets + corners), -1),
        cluster_centers=centers,
        cluster_radii=jnp.where(occupied, radii, -1),
        node_low=node_low,
        node_high=node_high,
    )


def _next_holds(tets: Int[Array, "T 4"], neighbors: Int[Array, "T 4"]) -> Int[Array, " 36T"]:
    """Where each code leads: the neighbour, the face it is entered by, and the rotation of its corners."""
    around = tets[jnp.maximum(neighbors, 0)]  # [T, 4, 4]: the corners of the tets behind the four faces
    same = around[:, :, None, :] == tets[:, None, :, None]
    # [T, 4, 4]: which of them each corner is. Only those that both tets have are asked for.
    theirs = jnp.sum(jnp.where(same, jnp.arange(4), 0), axis=-1)
    first, second, third = (theirs[:, EXIT_FACES, EXIT_TRIANGLES[:, i]] for i in range(3))
    entered = 16 * neighbors[:, EXIT_FACES] + jnp.asarray(_HELD_AS)[first, second, third]
    return jnp.where(neighbors[:, EXIT_FACES] >= 0, entered, -1).reshape(-1).astype(jnp.int32)


def find_entries(tables: MarchTables, rays: Rays, config: MarchConfig) -> Entries:
    """The front-facing boundary faces on the line of each ray; rays [R] in the mesh's own frame."""
    tiles = _Tiles(rays.origins.shape[0], config)
    lines = tuple(map(tiles.split, (rays.origins, rays.directions)))
    holds, count = jax.lax.map(lambda line: search_entries(tables, config, *_frame(*line)), lines)
    return Entries(holds=tiles.join(holds), overflow=tiles.join(count) > config.max_entries_per_ray)


def traverse(
    tables: MarchTables, rays: Rays, config: MarchConfig, entries: Entries | None = None
) -> Crossings:
    """The tets that the line of each ray crosses, in order; rays [R] in the mesh's own frame.

    Memory is rays x slots, never rays x tets. `overflow` marks rays with more tets or entries than the
    config has slots for; their crossings are complete up to there. Tets behind a ray's origin use slots too.
    Pass the rays' `entries`, if they are known, to spare their search.
    """
    if entries is None:
        entries = find_entries(tables, rays, config)
    tiles, slots = _Tiles(rays.origins.shape[0], config), config.max_tets_per_ray
    parts = tuple(map(tiles.split, (rays.origins, rays.directions, entries.holds)))
    num_tiles = parts[0].shape[0]

    def march(tile: Int[Array, ""], found: tuple) -> tuple:
        rows, overflow = found
        line = [jax.lax.dynamic_index_in_dim(x, tile, keepdims=False) for x in parts]
        column = tile * tiles.size
        rows, full = _march_tile(tables, config, line[0], line[1], line[2], rows, column)
        return rows, jax.lax.dynamic_update_slice(overflow, full, (column,))

    # Tiles write into the rays' own columns: nothing is stacked, and nothing transposed.
    lanes, dtype = num_tiles * tiles.size, rays.origins.dtype
    rows = jnp.full((slots, lanes), -1, jnp.int32), tuple(jnp.zeros((slots, lanes), dtype) for _ in range(6))
    found = (rows, jnp.zeros(lanes, bool))
    if num_tiles:  # a loop over none is traced too, and would read the first tile
        found = jax.lax.fori_loop(0, num_tiles, march, found)
    (codes, ends), overflow = jax.tree.map(lambda x: x[..., : tiles.num_rays], found)
    return Crossings(codes=codes, ends=ends, overflow=overflow | entries.overflow)


class _Tiles:
    """Rays in tiles that are marched together: [R, rest] as [tiles, rest, lanes], and back."""

    def __init__(self, num_rays: int, config: MarchConfig):
        default = CPU_TILE if jax.default_backend() == "cpu" else num_rays
        self.num_rays, self.size = num_rays, max(1, min(config.tile_size or default, num_rays))

    def split(self, x: Array) -> Array:
        """Of rays to tiles; the last ray fills up the last tile."""
        padding = ((0, -self.num_rays % self.size), (0, 0))
        padded = jnp.pad(jax.lax.stop_gradient(x), padding, mode="edge") if self.num_rays else x
        return padded.reshape(-1, self.size, x.shape[1]).transpose(0, 2, 1)

    def join(self, x: Array) -> Array:
        """[tiles, (rest,) lanes] to [R, (rest)]."""
        lanes_second = jnp.moveaxis(x, -1, 1)
        return lanes_second.reshape(-1, *lanes_second.shape[2:])[: self.num_rays]


def _march_tile(
    tables: MarchTables,
    config: MarchConfig,
    origins: Float[Array, "3 lanes"],
    directions: Float[Array, "3 lanes"],
    entry_holds: Int[Array, "B lanes"],
    rows: tuple[Int[Array, "K R"], Ends],
    column: Int[Array, ""],
) -> tuple[tuple[Int[Array, "K R"], Ends], Bool[Array, " lanes"]]:
    """Codes and ends with this tile's written from `column` on, and overflow.

    The next vertex is projected at the end of each step and carried into the next: XLA compiles a kernel
    for each of a step's results, and each would repeat a projection that is not carried. For the same reason
    nothing is stacked but for careful tests: points are three arrays each.
    """
    origin, axes = _frame(origins, directions)
    lanes, slots = origins.shape[1], config.max_tets_per_ray
    column = jnp.asarray(column).astype(jnp.int32)  # as the slot, in x64 too

    def corner(column: Int[Array, " lanes"]) -> Point:
        return project([row[column] for row in tables.corners], origin, axes)

    def enter(hold: Int[Array, " lanes"], enters: Bool[Array, " lanes"], held: tuple) -> tuple:
        """The triangle held by lanes that enter the cage, projected from scratch, and where it is met."""
        face = jnp.maximum(hold, 0) >> 2
        corners = jnp.asarray(FACES, jnp.int32)[face & 3]  # boundary faces are held unrotated
        a, b, c = (corner((face & ~3) + corners[:, j]) for j in range(3))
        return jax.tree.map(partial(jnp.where, enters), ((a, b, c), met_at(a, b, c, enters)), held)

    def unfinished(state: tuple) -> Bool[Array, ""]:
        return (state[0] < slots) & jnp.any(state[1] >= 0)

    def step(state: tuple) -> tuple:
        slot, hold, new, enters, held, entry, rows = state
        active = hold >= 0
        held = jax.lax.cond(jnp.any(enters), lambda: enter(hold, enters, held), lambda: held)
        (a, b, c), met = held
        tests = [quick_passes_left(new, point) for point in (a, b, c)]
        left, close = zip(*tests, strict=True)
        exit_slot = _way_out(*left)
        # Two tests decide. The third may be close, as that of an edge that points to the camera is.
        third = (exit_slot == 2) & left[1] & ~left[0]
        doubt = (close[0] & (exit_slot != 0)) | (close[1] & (exit_slot != 1)) | (close[2] & ~third)
        careful = partial(careful_sides, (new, new, new), (a, b, c))
        exit_slot = mended(active & doubt, lambda: _way_out(*careful()), exit_slot)
        code = jnp.where(active, 9 * (hold >> 2) + 3 * (hold & 3) + exit_slot, -1)
        first = _choose(exit_slot, b, c, a)
        second = _choose(exit_slot, c, a, b)
        met_after = met_at(new, first, second, active)
        values = code, (*met, *met_after)
        rows = jax.tree.map(
            lambda row, value: jax.lax.dynamic_update_slice(row, value[None], (slot, column)), rows, values
        )

        hold = jnp.where(active, tables.next_holds[jnp.maximum(code, 0)], -1)
        leaves = active & (hold < 0)
        hold = jnp.where(leaves, _pick(entry_holds, entry), hold)
        entry = entry + leaves.astype(jnp.int32)
        held = ((new, first, second), met_after)
        new = corner(jnp.maximum(hold, 0) >> 2)
        return slot + 1, hold, new, leaves & (hold >= 0), held, entry, rows

    nothing = jnp.zeros(lanes, origins.dtype)
    point = (nothing, nothing, nothing)
    start = (
        jnp.zeros((), jnp.int32),
        entry_holds[0],  # 4 * (4 tet + f) + r; -1 when the ray is done
        corner(jnp.maximum(entry_holds[0], 0) >> 2),
        entry_holds[0] >= 0,  # lanes that enter the cage
        ((point, point, point), point),  # the triangle through which the walk comes, and where it is met
        jnp.ones(lanes, jnp.int32),  # the next entry to take
        rows,
    )
    _, hold, *_, rows = jax.lax.while_loop(unfinished, step, start)
    return rows, hold >= 0


def _way_out(*left: Bool[Array, " lanes"]) -> Int[Array, " lanes"]:
    """The face left: the new vertex's triangle around the ray, right of one held corner, left of the next.

    If rounding leaves none (a sliver seen edge-on), any other face than the entry advances.
    """
    return jnp.where(~left[1] & left[2], 0, jnp.where(~left[2] & left[0], 1, 2))


def _choose(slot: Int[Array, " lanes"], zero: Point, one: Point, two: Point) -> Point:
    """The point for each lane's slot."""
    return tuple(
        jnp.where(slot == 0, x, jnp.where(slot == 1, y, z)) for x, y, z in zip(zero, one, two, strict=True)
    )


def _frame(origins: Float[Array, "3 lanes"], directions: Float[Array, "3 lanes"]) -> tuple[tuple, tuple]:
    """Origin and axes to `project` on, computed once for all kernels that follow."""
    return tuple(origins), jax.lax.optimization_barrier(ray_frame(tuple(directions)))


def _pick(rows: Int[Array, "B lanes"], index: Int[Array, " lanes"]) -> Int[Array, " lanes"]:
    """rows[index[lane], lane] by selection; -1 past the end."""
    result = jnp.full_like(rows[0], -1)
    for i in range(1, rows.shape[0]):
        result = jnp.where(index == i, rows[i], result)
    return result
