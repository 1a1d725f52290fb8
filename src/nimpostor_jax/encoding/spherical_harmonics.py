"""Real spherical harmonics of a unit direction, Cartesian form (E_d of Eq. 6)."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float


def spherical_harmonics(
    directions: Float[Array, "*batch 3"], degree: int
) -> Float[Array, "*batch degree**2"]:
    """The first degree**2 orthonormal basis functions (bands 0 to degree - 1; degree at most 4)."""
    if not 0 <= degree <= 4:
        raise ValueError(f"degree must be in [0, 4], got {degree}")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    pi = math.pi
    basis = [jnp.full_like(x, math.sqrt(1 / (4 * pi)))]
    first = math.sqrt(3 / (4 * pi))
    basis += [first * y, first * z, first * x]
    second = math.sqrt(15 / (4 * pi))
    basis += [
        second * x * y,
        second * y * z,
        math.sqrt(5 / (16 * pi)) * (3 * z * z - 1),
        second * x * z,
        second / 2 * (x * x - y * y),
    ]
    outer, middle, inner = (
        math.sqrt(35 / (32 * pi)),
        math.sqrt(105 / (4 * pi)),
        math.sqrt(21 / (32 * pi)),
    )
    basis += [
        outer * y * (3 * x * x - y * y),
        middle * x * y * z,
        inner * y * (5 * z * z - 1),
        math.sqrt(7 / (16 * pi)) * z * (5 * z * z - 3),
        inner * x * (5 * z * z - 1),
        middle / 2 * z * (x * x - y * y),
        outer * x * (x * x - 3 * y * y),
    ]
    if degree == 0:
        return jnp.zeros((*directions.shape[:-1], 0), directions.dtype)
    return jnp.stack(basis[: degree**2], axis=-1)
