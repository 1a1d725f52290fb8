"""Where each ray enters and leaves its tets: differentiable (in reverse mode) in vertices and rays (Eq. 3).

Barycentric coordinates of the entry and exit points are those within the faces that the ray passes, never
derived from the tet's volume, so that slivers cost no precision.

Axes: R rays, K tet slots of a ray, N packed segments.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import default_chunk, map_used, running
from nimpostor_jax.config import RenderConfig
from nimpostor_jax.geometry.intersect import face_weights, project, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.traverse import (
    CODES_PER_TET,
    EXIT_TRIANGLES,
    Crossings,
    Entries,
    MarchTables,
    march_tables,
    traverse,
)
from nimpostor_jax.types import Embedding, Rays, TetMesh, TetSegments

DERIVED_CHUNK = 64  # segments that CPUs differentiate at a time: all at once take several times as long
ROUNDING = 8  # units in the last place of t by which a walk may go back unnoticed
_CODES = np.arange(CODES_PER_TET)
ENTRY_TRIANGLES = np.array([np.roll(FACES[c // 9], -(c // 3 % 3)) for c in _CODES], np.int32)
Ends = tuple[Float[Array, " N"], Float[Array, " N"], Float[Array, "N 4"], Float[Array, "N 4"]]


def locate_segments(
    mesh: TetMesh,
    rays: Rays,
    crossings: Crossings,
    near: Float[Array, ""] | float = 0.0,
    capacity: int | None = None,
) -> TetSegments:
    """Ends of the crossed segments beyond `near` (in the mesh's frame), as t and as barycentric coordinates.

    Segments without length (grazed corners, folded tets) and those before `near` become empty slots. Where a
    walk goes back, through inverted tets or along faces seen edge-on, the line is not covered twice: what it
    passes again begins where it had been before. Rays whose crossings do not fit into `capacity` slots, by
    default as many as `crossings` has, are flagged.
    """
    num_slots, num_rays = crossings.codes.shape
    packed = _pack(crossings, num_slots * num_rays if capacity is None else capacity)
    owners, codes = packed.rays, packed.codes
    geometry = (mesh.vertices, rays.origins, rays.directions)
    t_enter, t_exit, lambda_enter, lambda_exit = _ends(
        geometry, mesh.tets, owners, codes, packed.places, crossings.ends
    )
    rounding = ROUNDING * jnp.finfo(t_exit.dtype).eps * (1 + jnp.abs(t_enter))
    covered = _covered(owners, codes >= 0, t_enter, t_exit, rounding)
    behind = jnp.maximum(covered, near)
    used = (codes >= 0) & (t_exit > jnp.maximum(t_enter, behind))
    cut = used & (t_enter < behind)  # a division only where it counts: lengths may be next to 0
    skipped = jnp.where(cut, behind - t_enter, 0) / jnp.where(cut, t_exit - t_enter, 1)
    skipped = skipped[:, None]  # share of the segment before that
    return TetSegments(
        rays=owners,
        tet_ids=jnp.where(used, codes // CODES_PER_TET, -1),
        t_enter=jnp.where(used, jnp.maximum(t_enter, behind), 0),
        t_exit=jnp.where(used, t_exit, 0),
        lambda_enter=jnp.where(used[:, None], lambda_enter + skipped * (lambda_exit - lambda_enter), 0),
        lambda_exit=jnp.where(used[:, None], lambda_exit, 0),
        overflow=packed.overflow,
        disordered=_disordered(packed, jnp.maximum(t_enter, covered), jnp.maximum(t_exit, covered), rounding),
    )


def _disordered(
    packed: "_Packed", t_enter: Float[Array, " N"], t_exit: Float[Array, " N"], rounding: Float[Array, " N"]
) -> Bool[Array, " R"]:
    """Walks come in the order of their entries, each without gaps: overlap shows between neighbours.

    Exits are the furthest that walks have been: one that ends on its way back has covered what lies beyond.
    """
    rays, ordered = packed.rays, jnp.zeros_like(packed.overflow)
    back = (packed.codes[1:] >= 0) & (rays[1:] == rays[:-1]) & (t_enter[1:] < t_exit[:-1] - rounding[1:])
    return jax.lax.cond(jnp.any(back), lambda: ordered.at[rays[1:]].max(back), lambda: ordered)


def march_segments(
    mesh: TetMesh,
    rays: Rays,
    config: RenderConfig,
    tables: MarchTables | None = None,
    entries: Entries | None = None,
) -> TetSegments:
    """The tets that rays [R] in the mesh's frame cross beyond the config's `near`, in buffers of its sizes.

    `tables` and `entries` as in `traverse`; tables are made where there are none.
    """
    crossings = traverse(march_tables(mesh) if tables is None else tables, rays, config.march, entries)
    slots = config.march.capacity_per_ray or config.march.max_tets_per_ray
    return locate_segments(mesh, rays, crossings, config.near / mesh.scale, slots * rays.origins.shape[0])


def in_cells(segments: TetSegments, embedding: Embedding | None) -> TetSegments:
    """The same segments in the cells and coordinates of a field."""
    if embedding is None:
        return segments
    tets = jnp.maximum(segments.tet_ids, 0)
    corners = embedding.lambdas[tets]

    def within(lambdas: Float[Array, "N 4"]) -> Float[Array, "N 4"]:
        return jnp.sum(lambdas[:, :, None] * corners, axis=1)

    return dataclasses.replace(
        segments,
        tet_ids=jnp.where(segments.tet_ids >= 0, embedding.cells[tets], -1),
        lambda_enter=within(segments.lambda_enter),
        lambda_exit=within(segments.lambda_exit),
        mesh_tets=segments.tet_ids,
    )


class _Packed(NamedTuple):
    """Crossings by ray, then along each ray: few rays cross as many tets as there are slots."""

    rays: Int[Array, " N"]
    codes: Int[Array, " N"]
    places: Int[Array, " N"]  # among all of the crossings' slots
    overflow: Bool[Array, " R"]


def _pack(crossings: Crossings, capacity: int) -> _Packed:
    num_slots, num_rays = crossings.codes.shape
    lengths = jnp.sum(crossings.codes >= 0, axis=0, dtype=jnp.int32)  # walks fill slots from the first on
    firsts = jnp.cumsum(lengths) - lengths
    counts = jnp.clip(capacity - firsts, 0, lengths)
    # Rays that cross anything mark their first place; a running maximum spreads the marks, which ascend.
    starts = jnp.where(counts > 0, firsts, capacity)
    marks = jnp.zeros(capacity, jnp.int32).at[starts].set(jnp.arange(num_rays, dtype=jnp.int32), mode="drop")
    rays = running(jnp.maximum, marks, 0)
    order = jnp.arange(capacity, dtype=jnp.int32)
    places = jnp.clip(order - firsts[rays], 0, num_slots - 1) * num_rays + rays
    return _Packed(
        rays=rays,
        codes=jnp.where(order < jnp.sum(counts), crossings.codes.reshape(-1)[places], -1),
        places=places,
        overflow=crossings.overflow | (counts < lengths),
    )


def _covered(
    rays: Int[Array, " N"],
    used: Bool[Array, " N"],
    t_enter: Float[Array, " N"],
    t_exit: Float[Array, " N"],
    rounding: Float[Array, " N"],
) -> Float[Array, " N"]:
    """The t up to which a slot's walk has covered the line before it; t_enter where it has not gone back."""
    if not rays.size:
        return t_enter

    def furthest() -> Float[Array, " N"]:
        # Crossings of one walk share their ends to the last bit.
        starts = (t_enter[1:] != t_exit[:-1]) | (rays[1:] != rays[:-1])
        starts = jnp.pad(starts, (1, 0), constant_values=True)

        walks, t = running(jnp.add, starts.astype(jnp.int32), 0), jax.lax.stop_gradient(t_exit)

        def further(i: Int[Array, " n"], j: Int[Array, " n"]) -> Int[Array, " n"]:
            return jnp.where((walks[i] == walks[j]) & (t[i] > t[j]), i, j)

        reached = running(further, jnp.arange(len(t), dtype=jnp.int32), 0)  # the slot that went furthest
        before = jnp.concatenate([t_enter[:1], t_exit[reached[:-1]]])
        return jnp.where(starts, t_enter, before)

    return jax.lax.cond(jnp.any(used & (t_enter - t_exit > rounding)), furthest, lambda: t_enter)


@jax.custom_vjp
def _ends(
    geometry: tuple,
    tets: Int[Array, "T 4"],
    rays: Int[Array, " N"],
    codes: Int[Array, " N"],
    places: Int[Array, " N"],
    marched: tuple[Float[Array, "K R"], ...],
) -> Ends:
    """t and coordinates at both ends, as marched; the derivatives are those of `_recomputed_ends`."""
    columns = tuple(x.reshape(-1) for x in marched)
    count = jnp.sum(codes >= 0, dtype=jnp.int32)  # used slots come first
    return map_used(_marched_ends, columns, (codes, places), count)


def _marched_ends(columns: tuple[Float[Array, " KR"], ...], items: tuple) -> Ends:
    codes, places = items
    local = jnp.maximum(codes, 0) % CODES_PER_TET
    t_enter, *before, t_exit, after_a, after_b = (x[places] for x in columns)
    lambda_enter = _spread(jnp.asarray(ENTRY_TRIANGLES)[local], *before)
    return t_enter, t_exit, lambda_enter, _spread(jnp.asarray(EXIT_TRIANGLES)[local], after_a, after_b)


def _ends_forward(
    geometry: tuple, tets: Array, rays: Array, codes: Array, places: Array, marched: tuple[Array, ...]
) -> tuple[Ends, tuple]:
    return _ends(geometry, tets, rays, codes, places, marched), (geometry, tets, rays, codes)


def _ends_backward(arguments: tuple, cotangents: Ends) -> tuple:
    geometry, *constants = arguments
    _, pull = jax.vjp(lambda moving: _recomputed_ends(moving, *constants), geometry)
    return *pull(cotangents), None, None, None, None, None


_ends.defvjp(_ends_forward, _ends_backward)


def _recomputed_ends(
    geometry: tuple, tets: Int[Array, "T 4"], rays: Int[Array, " N"], codes: Int[Array, " N"]
) -> Ends:
    """What the march computed, as a differentiable function of vertices, origins and directions."""
    vertices, origins, directions = geometry
    count, codes = jnp.sum(codes >= 0, dtype=jnp.int32), jnp.maximum(codes, 0)  # used slots come first
    tet_ids, local = codes // CODES_PER_TET, codes % CODES_PER_TET
    ts, lambdas = [], []
    for triangles in (ENTRY_TRIANGLES, EXIT_TRIANGLES):
        triangle = jnp.asarray(triangles)[local]
        corners = vertices[jnp.take_along_axis(tets[tet_ids], triangle, axis=1)]
        items, chunk = (corners, origins[rays], directions[rays]), default_chunk(len(codes), DERIVED_CHUNK)
        t, wa, wb = map_used(_place_in_face, None, items, count, chunk)
        ts.append(t)
        lambdas.append(_spread(triangle, wa, wb))
    return ts[0], ts[1], lambdas[0], lambdas[1]


def _place_in_face(_: None, items: tuple) -> tuple[Float[Array, " n"], ...]:
    """t at which rays pass faces, and the weights of the first two corners there."""
    corners, origins, directions = items
    origin, direction = (tuple(x[..., i] for i in range(3)) for x in (origins, directions))
    axes = ray_frame(direction)
    a, b, c = (project(tuple(corners[..., j, i] for i in range(3)), origin, axes) for j in range(3))
    wa, wb, wc = face_weights(a, b, c)
    return wa * a[2] + wb * b[2] + wc * c[2], wa, wb


def _spread(
    triangle: Int[Array, "N 3"], wa: Float[Array, " N"], wb: Float[Array, " N"]
) -> Float[Array, "N 4"]:
    """The tet's four coordinates from weights of three of its corners."""
    columns = []
    for i in range(4):
        a, b, c = (triangle[..., j] == i for j in range(3))
        columns.append(jnp.where(a, wa, jnp.where(b, wb, jnp.where(c, 1 - wa - wb, 0))))
    return jnp.stack(columns, axis=-1)
