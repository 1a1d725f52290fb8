"""Barycentric coordinates of points in tetrahedra (Eq. 2): p = sum_i lambda_i v_i, sum_i lambda_i = 1."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from nimpostor_jax.geometry.tetrahedron import cross


def barycentric(
    points: Float[Array, "*batch 3"], corner_positions: Float[Array, "*batch 4 3"]
) -> Float[Array, "*batch 4"]:
    """Coordinates of points with respect to tets; negative outside.

    A tet without volume has no such coordinates: there the result is (1/4, 1/4, 1/4, 1/4), with zero
    gradient, and `tetrahedron.num_inverted` tells. Differentiable in points and corners.
    """
    a, b, c, d = (corner_positions[..., i, :] for i in range(4))
    # Relative to the point, so that the coordinates lose no digits to the distance from the origin.
    a, b, c, d = a - points, b - points, c - points, d - points
    bc, da = cross(b, c), cross(d, a)
    weights = jnp.stack(
        [
            jnp.sum(bc * d, axis=-1),  # det(b, c, d)
            -jnp.sum(cross(a, c) * d, axis=-1),
            jnp.sum(da * b, axis=-1),  # det(d, a, b) = det(a, b, d)
            -jnp.sum(bc * a, axis=-1),
        ],
        axis=-1,
    )
    total = jnp.sum(weights, axis=-1, keepdims=True)
    valid = total != 0
    return jnp.where(valid, weights / jnp.where(valid, total, 1), 0.25)


def interpolate(
    weights: Float[Array, "*batch 4"], corner_values: Float[Array, "*batch 4 C"]
) -> Float[Array, "*batch C"]:
    """Affine combination of corner values, for instance positions (p = Lambda V, Eq. 2)."""
    return jnp.sum(weights[..., None] * corner_values, axis=-2)
