"""Where each ray enters and leaves its tets: differentiable in vertices and rays (Eq. 3).

Axes: R rays, K tet slots. Barycentric coordinates of the entry and exit points are computed within the faces
that the ray passes, never from the tet's volume, so that slivers cost no precision.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nimpostor_jax.geometry.intersect import face_weights, project, ray_frame
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.render.traverse import CODES_PER_TET, EXIT_FACES, Crossings
from nimpostor_jax.types import Rays, TetMesh, TetSegments


def locate_segments(
    mesh: TetMesh, rays: Rays, crossings: Crossings, near: Float[Array, ""] | float = 0.0
) -> TetSegments:
    """Ends of the crossed segments beyond `near` (in the mesh's frame), as t and as barycentric coordinates.

    Segments without length (grazed corners, folded tets) and those before `near` become empty slots.
    """
    used = crossings.codes >= 0
    codes = jnp.maximum(crossings.codes, 0)
    tet_ids = codes // CODES_PER_TET
    entry_faces = (codes // 9) % 4
    exit_faces = jnp.asarray(EXIT_FACES)[codes % CODES_PER_TET]

    origin = tuple(rays.origins[:, None, i] for i in range(3))
    axes = ray_frame(tuple(rays.directions[:, None, i] for i in range(3)))
    points = []
    for i in range(4):
        corner = [mesh.vertices[:, axis][mesh.tets[:, i]][tet_ids] for axis in range(3)]  # a gather a column
        points.append(project(tuple(corner), origin, axes))
    points = _materialize(points)
    per_face = [_face_coordinates(points, face) for face in FACES]
    lambda_enter, lambda_exit = _materialize((_select(per_face, entry_faces), _select(per_face, exit_faces)))
    t_enter = sum(weight * point[2] for weight, point in zip(lambda_enter, points, strict=True))
    t_exit = sum(weight * point[2] for weight, point in zip(lambda_exit, points, strict=True))

    used &= t_exit > jnp.maximum(t_enter, near)
    length = jnp.where(used, t_exit - t_enter, 1)
    skipped = jnp.clip((near - t_enter) / length, 0, 1)  # share of the segment that lies before `near`
    lambda_enter = [a + skipped * (b - a) for a, b in zip(lambda_enter, lambda_exit, strict=True)]
    return TetSegments(
        tet_ids=jnp.where(used, tet_ids, -1),
        t_enter=jnp.where(used, jnp.maximum(t_enter, near), 0),
        t_exit=jnp.where(used, t_exit, 0),
        lambda_enter=jnp.where(used[..., None], jnp.stack(lambda_enter, axis=-1), 0),
        lambda_exit=jnp.where(used[..., None], jnp.stack(lambda_exit, axis=-1), 0),
        overflow=crossings.overflow,
    )


# XLA's CPU back end copies a fused computation into each of its consumers: without these cuts, every
# output recomputes all four faces, for seven times the arithmetic.
_materialize = jax.lax.optimization_barrier


def _face_coordinates(points: list, face: tuple[int, int, int]) -> list[Float[Array, "R K"]]:
    """The tet's four coordinates of the point where the ray meets one of its faces."""
    weights = dict(zip(face, face_weights(*(points[i] for i in face)), strict=True))
    zero = jnp.zeros_like(points[0][0])
    return [weights.get(i, zero) for i in range(4)]


def _select(per_face: list, faces: Int[Array, "R K"]) -> list[Float[Array, "R K"]]:
    chosen = []
    for i in range(4):
        value = per_face[0][i]
        for face in range(1, 4):
            value = jnp.where(faces == face, per_face[face][i], value)
        chosen.append(value)
    return chosen
