"""Where each ray enters and leaves its tets: differentiable in vertices and rays (Eq. 3).

Axes: K tet slots, R rays. Barycentric coordinates of the entry and exit points are those within the faces
that the ray passes, never derived from the tet's volume, so that slivers cost no precision.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.geometry.intersect import face_weights, project, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.traverse import CODES_PER_TET, EXIT_TRIANGLES, Crossings
from nimpostor_jax.types import Rays, TetMesh, TetSegments

ROUNDING = 8  # units in the last place of t by which a walk may go back unnoticed
_CODES = np.arange(CODES_PER_TET)
ENTRY_TRIANGLES = np.array([np.roll(FACES[c // 9], -(c // 3 % 3)) for c in _CODES], np.int32)
Ends = tuple[Float[Array, "K R"], Float[Array, "K R"], Float[Array, "K R 4"], Float[Array, "K R 4"]]


def locate_segments(
    mesh: TetMesh, rays: Rays, crossings: Crossings, near: Float[Array, ""] | float = 0.0
) -> TetSegments:
    """Ends of the crossed segments beyond `near` (in the mesh's frame), as t and as barycentric coordinates.

    Segments without length (grazed corners, folded tets) and those before `near` become empty slots. Where a
    walk goes back, through inverted tets or along faces seen edge-on, the line is not covered twice: what it
    passes again begins where it had been before.
    """
    geometry = (mesh.vertices, rays.origins, rays.directions)
    t_enter, t_exit, lambda_enter, lambda_exit = _ends(geometry, mesh.tets, crossings.codes, crossings.ends)
    behind = jnp.maximum(_covered(crossings.codes >= 0, t_enter, t_exit), near)
    used = (crossings.codes >= 0) & (t_exit > jnp.maximum(t_enter, behind))
    cut = used & (t_enter < behind)  # a division only where it counts: lengths may be next to 0
    skipped = jnp.where(cut, behind - t_enter, 0) / jnp.where(cut, t_exit - t_enter, 1)
    skipped = skipped[..., None]  # share of the segment before that
    return TetSegments(
        tet_ids=jnp.where(used, crossings.codes // CODES_PER_TET, -1),
        t_enter=jnp.where(used, jnp.maximum(t_enter, behind), 0),
        t_exit=jnp.where(used, t_exit, 0),
        lambda_enter=jnp.where(used[..., None], lambda_enter + skipped * (lambda_exit - lambda_enter), 0),
        lambda_exit=jnp.where(used[..., None], lambda_exit, 0),
        overflow=crossings.overflow,
    )


def _covered(
    used: Bool[Array, "K R"], t_enter: Float[Array, "K R"], t_exit: Float[Array, "K R"]
) -> Float[Array, "K R"]:
    """The t up to which a slot's walk has covered the line before it; t_enter where it has not gone back."""
    rounding = ROUNDING * jnp.finfo(t_exit.dtype).eps * (1 + jnp.abs(t_enter))

    def furthest() -> Float[Array, "K R"]:
        # Crossings of one walk share their ends to the last bit.
        starts = jnp.pad(t_enter[1:] != t_exit[:-1], ((1, 0), (0, 0)), constant_values=True)

        def join(left: tuple, right: tuple) -> tuple:
            (t, start), (next_t, next_start) = left, right
            return jnp.where(next_start, next_t, jnp.maximum(t, next_t)), start | next_start

        reached, _ = jax.lax.associative_scan(join, (t_exit, starts))
        before = jnp.concatenate([t_enter[:1], reached[:-1]])
        return jnp.where(starts, t_enter, before)

    return jax.lax.cond(jnp.any(used & (t_enter - t_exit > rounding)), furthest, lambda: t_enter)


@jax.custom_jvp
def _ends(
    geometry: tuple, tets: Int[Array, "T 4"], codes: Int[Array, "K R"], ends: tuple[Float[Array, "K R"], ...]
) -> Ends:
    """t and coordinates at both ends, as marched; the derivatives are those of `_recomputed_ends`."""
    local = jnp.maximum(codes, 0) % CODES_PER_TET
    lambdas = [
        _spread(jnp.asarray(triangles)[local], ends[start + 1], ends[start + 2])
        for start, triangles in ((0, ENTRY_TRIANGLES), (3, EXIT_TRIANGLES))
    ]
    return ends[0], ends[3], lambdas[0], lambdas[1]


@_ends.defjvp
def _ends_jvp(primals: tuple, tangents: tuple) -> tuple[Ends, Ends]:
    geometry, tets, codes, _ = primals
    _, tangents_out = jax.jvp(lambda g: _recomputed_ends(g, tets, codes), (geometry,), (tangents[0],))
    return _ends(*primals), tangents_out


def _recomputed_ends(geometry: tuple, tets: Int[Array, "T 4"], codes: Int[Array, "K R"]) -> Ends:
    """What the march computed, as a differentiable function of vertices, origins and directions."""
    vertices, origins, directions = geometry
    codes = jnp.maximum(codes, 0)
    tet_ids, local = codes // CODES_PER_TET, codes % CODES_PER_TET
    origin = tuple(origins[:, i] for i in range(3))
    axes = ray_frame(tuple(directions[:, i] for i in range(3)))
    ts, lambdas = [], []
    for triangles in (ENTRY_TRIANGLES, EXIT_TRIANGLES):
        triangle = jnp.asarray(triangles)[local]
        corners = [vertices[tets[tet_ids, triangle[..., j]]] for j in range(3)]
        a, b, c = (project(tuple(corner[..., i] for i in range(3)), origin, axes) for corner in corners)
        wa, wb, wc = face_weights(a, b, c)
        ts.append(wa * a[2] + wb * b[2] + wc * c[2])
        lambdas.append(_spread(triangle, wa, wb))
    return ts[0], ts[1], lambdas[0], lambdas[1]


def _spread(
    triangle: Int[Array, "K R 3"], wa: Float[Array, "K R"], wb: Float[Array, "K R"]
) -> Float[Array, "K R 4"]:
    """The tet's four coordinates from weights of three of its corners."""
    columns = []
    for i in range(4):
        a, b, c = (triangle[..., j] == i for j in range(3))
        columns.append(jnp.where(a, wa, jnp.where(b, wb, jnp.where(c, 1 - wa - wb, 0))))
    return jnp.stack(columns, axis=-1)
