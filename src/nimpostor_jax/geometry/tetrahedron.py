"""Volumes and affine barycentric maps of tetrahedra.

Axes: V vertices, T tets. Corner `i` of a tet faces the triangle of the other three, `FACES[i]`, which is
listed counter-clockwise seen from outside when the tet is positively oriented.

Geometry uses elementwise products and sums only: a float32 `dot` runs in TF32 or bfloat16 on accelerators.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

FACES = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))


def cross(a: Float[Array, "*batch 3"], b: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Cross product by components (jnp.cross builds longer graphs)."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def corners(
    vertices: Float[Array, "V 3"], tets: Int[Array, "*batch 4"]
) -> Float[Array, "*batch 4 3"]:
    """Positions of the four corners of each tet."""
    return vertices[tets]


def signed_volumes(corner_positions: Float[Array, "*batch 4 3"]) -> Float[Array, "*batch"]:
    """Signed volume; positive where corner 3 lies on the side of (0, 1, 2) that its normal points to."""
    edges = corner_positions[..., 1:, :] - corner_positions[..., :1, :]
    return jnp.sum(cross(edges[..., 0, :], edges[..., 1, :]) * edges[..., 2, :], axis=-1) / 6


def num_inverted(vertices: Float[Array, "V 3"], tets: Int[Array, "T 4"]) -> Int[Array, ""]:
    """How many tets have no positive volume: the status of a deformation (0 is healthy)."""
    return jnp.sum(signed_volumes(corners(vertices, tets)) <= 0)


def deformation_gradients(
    rest: Float[Array, "*batch 4 3"], moved: Float[Array, "*batch 4 3"]
) -> Float[Array, "*batch 3 3"]:
    """F with moved edges = F rest edges, for each tet; the identity where it is flat at rest.

    The sum of the identity and of what the corners' displacements add: exact where nothing has moved.
    """
    edges = rest[..., 1:, :] - rest[..., :1, :]
    change = (moved - rest)[..., 1:, :] - (moved - rest)[..., :1, :]
    a, b, c = (edges[..., i, :] for i in range(3))
    duals = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=-2)
    volume = jnp.sum(a * duals[..., 0, :], axis=-1)[..., None, None]
    slopes = jnp.where(volume != 0, duals / jnp.where(volume != 0, volume, 1), 0)
    turned = jnp.sum(change[..., :, :, None] * slopes[..., :, None, :], axis=-3)
    return jnp.eye(3, dtype=rest.dtype) + turned
