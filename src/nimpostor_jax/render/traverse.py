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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, packed_indices, padded_size, take
from nimpostor_jax.config import MarchConfig
from nimpostor_jax.geometry import box_tree
from nimpostor_jax.geometry.intersect import project, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.entries import MarchTables, met_at, search_entries, sides
from nimpostor_jax.types import Rays, TetMesh

CPU_TILE = 256  # an image tile: a larger one has a wider cone and waits longer for its last ray
CPU_CAREFUL_TILE = 16  # of the few rays that are marched again
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

    Finding them costs more than marching: find them once for rays that are cast again.
    """

    holds: Int[Array, "R B"]  # 4 * (4 tet + f) of the boundary face; -1 pads
    overflow: Bool[Array, " R"]  # more entries than slots
    unsure: Bool[Array, " R"]  # tests were too close for the quick way: march with care


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
    holds, count, unsure = jax.lax.map(
        lambda line: search_entries(tables, config, False, *_frame(*line)), lines
    )
    return Entries(
        holds=tiles.join(holds),
        overflow=tiles.join(count) > config.max_entries_per_ray,
        unsure=tiles.join(unsure),
    )


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
        rows, overflow, unsure = found
        line = [jax.lax.dynamic_index_in_dim(x, tile, keepdims=False) for x in parts]
        column = tile * tiles.size
        rows, full, doubt = _march_tile(tables, config, False, line[0], line[1], line[2], rows, column)
        overflow = jax.lax.dynamic_update_slice(overflow, full, (column,))
        return rows, overflow, jax.lax.dynamic_update_slice(unsure, doubt, (column,))

    # Tiles write into the rays' own columns: nothing is stacked, and nothing transposed.
    none = jnp.zeros(num_tiles * tiles.size, bool)
    found = (_empty_rows(slots, num_tiles * tiles.size, rays.origins.dtype), none, none)
    if num_tiles:  # a loop over none is traced too, and would read the first tile
        found = jax.lax.fori_loop(0, num_tiles, march, found)
    rows, overflow, unsure = jax.tree.map(lambda x: x[..., : tiles.num_rays], found)
    crossings = Crossings(codes=rows[0], ends=rows[1], overflow=overflow | entries.overflow)
    tile = default_chunk(tiles.size, CPU_CAREFUL_TILE)
    return _march_again(tables, rays, config, crossings, unsure | entries.unsure, tile)


def _empty_rows(slots: int, lanes: int, dtype: Any) -> tuple[Int[Array, "K lanes"], Ends]:
    """Codes and ends before the march."""
    return jnp.full((slots, lanes), -1, jnp.int32), tuple(jnp.zeros((slots, lanes), dtype) for _ in range(6))


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


def _march_again(
    tables: MarchTables,
    rays: Rays,
    config: MarchConfig,
    crossings: Crossings,
    unsure: Bool[Array, " R"],
    tile: int,
) -> Crossings:
    """The crossings, with those of unsure rays from careful marches: rare, and several times slower."""
    num_rays = unsure.shape[0]
    lines = jax.lax.stop_gradient((rays.origins, rays.directions))
    indices, count = packed_indices(unsure)
    again = jnp.where(jnp.arange(num_rays) < count, indices, num_rays)
    again = jnp.pad(again, (0, padded_size(num_rays, tile) - num_rays), constant_values=num_rays)

    def march(start: Array, found: Crossings) -> Crossings:
        chosen = take(again, start, tile)
        # Past the end: the tile's first ray once more, so that its cone stays narrow; nothing is written.
        read = jnp.where(chosen < num_rays, chosen, chosen[0])
        origins, directions = (x[read].T for x in lines)
        holds, count, _ = search_entries(tables, config, True, *_frame(origins, directions))
        rows = _empty_rows(config.max_tets_per_ray, tile, origins.dtype)
        (codes, ends), overflow, _ = _march_tile(tables, config, True, origins, directions, holds, rows, 0)
        overflow |= count > config.max_entries_per_ray
        return Crossings(
            codes=found.codes.at[:, chosen].set(codes, mode="drop"),
            ends=tuple(
                old.at[:, chosen].set(new, mode="drop") for old, new in zip(found.ends, ends, strict=True)
            ),
            overflow=found.overflow.at[chosen].set(overflow, mode="drop"),
        )

    if not num_rays:
        return crossings
    # A loop even where all rays are one tile: mostly there are none to march again.
    tiles = (count + tile - 1) // tile
    return jax.lax.fori_loop(0, tiles, lambda i, found: march(i * tile, found), crossings)


def _march_tile(
    tables: MarchTables,
    config: MarchConfig,
    careful: bool,
    origins: Float[Array, "3 lanes"],
    directions: Float[Array, "3 lanes"],
    entry_holds: Int[Array, "B lanes"],
    rows: tuple[Int[Array, "K R"], Ends],
    column: Int[Array, ""] | int,
) -> tuple[tuple[Int[Array, "K R"], Ends], Bool[Array, " lanes"], Bool[Array, " lanes"]]:
    """Codes and ends with this tile's written from `column` on; overflow; and the lanes on which tests were
    too close for the quick way.

    The next vertex is projected at the end of each step and carried into the next: XLA compiles a kernel
    for each of a step's results, and each would repeat a projection that is not carried. For the same reason
    nothing is stacked: points are three arrays each.
    """
    origin, axes = _frame(origins, directions)
    lanes, slots = origins.shape[1], config.max_tets_per_ray
    column = jnp.asarray(column).astype(jnp.int32)  # as the slot, in x64 too

    def corner(column: Int[Array, " lanes"]) -> Point:
        return project([row[column] for row in tables.corners], origin, axes)

    def held_triangle(hold: Int[Array, " lanes"]) -> tuple[tuple[Point, Point, Point], Point]:
        """The face that is entered, projected from scratch (at the cage's boundary), and where it is met.

        Whether it is seen edge-on has been noted when it was found.
        """
        face = hold >> 2
        held = jnp.asarray(FACES, jnp.int32)[face & 3]  # boundary faces are held unrotated
        a, b, c = (corner((face & ~3) + held[:, j]) for j in range(3))
        met, _ = met_at(a, b, c, careful)
        return (a, b, c), met

    def unfinished(state: tuple) -> Bool[Array, ""]:
        return (state[0] < slots) & jnp.any(state[1] >= 0)

    def step(state: tuple) -> tuple:
        slot, hold, new, (a, b, c), met, entry, rows, unsure = state
        active = hold >= 0
        left, close = sides([(new, a), (new, b), (new, c)], careful)
        # The way out is the new vertex's triangle around the ray: right of one held corner, left of the next.
        # If rounding leaves none (a sliver seen edge-on), any other face than the entry advances.
        exit_slot = jnp.where(~left[1] & left[2], 0, jnp.where(~left[2] & left[0], 1, 2))
        code = jnp.where(active, 9 * (hold >> 2) + 3 * (hold & 3) + exit_slot, -1)
        first = _choose(exit_slot, b, c, a)
        second = _choose(exit_slot, c, a, b)
        met_after, flat = met_at(new, first, second, careful)
        # Two tests decide. The third may be close, as that of an edge that points to the camera is.
        third = (exit_slot == 2) & left[1] & ~left[0]
        doubt = (close[0] & (exit_slot != 0)) | (close[1] & (exit_slot != 1)) | (close[2] & ~third)
        unsure |= active & (doubt | flat)
        values = code, (*met, *met_after)
        rows = jax.tree.map(
            lambda row, value: jax.lax.dynamic_update_slice(row, value[None], (slot, column)), rows, values
        )

        hold = jnp.where(active, tables.next_holds[jnp.maximum(code, 0)], -1)
        reenters = active & (hold < 0)
        hold = jnp.where(reenters, _pick(entry_holds, entry), hold)
        entry = entry + reenters.astype(jnp.int32)
        reenters &= hold >= 0

        def reenter() -> tuple:
            entered = held_triangle(jnp.maximum(hold, 0))
            return jax.tree.map(partial(jnp.where, reenters), entered, ((new, first, second), met_after))

        points, met = jax.lax.cond(
            jnp.any(reenters), reenter, lambda: ((new, first, second), met_after)
        )
        return slot + 1, hold, corner(jnp.maximum(hold, 0) >> 2), points, met, entry, rows, unsure

    first_hold = jnp.maximum(entry_holds[0], 0)
    start = (
        jnp.zeros((), jnp.int32),
        entry_holds[0],  # 4 * (4 tet + f) + r; -1 when the ray is done
        corner(first_hold >> 2),
        *held_triangle(first_hold),
        jnp.ones(lanes, jnp.int32),  # the next entry to take
        rows,
        jnp.zeros(lanes, bool),
    )
    _, hold, _, _, _, _, rows, unsure = jax.lax.while_loop(unfinished, step, start)
    return rows, hold >= 0, unsure


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
