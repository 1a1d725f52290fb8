"""Volume rendering quadrature (Eq. 1, with the transmittance's sum made exclusive).

Axes: S samples of a ray. The optical depth of an interval is its density, per unit of the density measure,
times its length in that measure.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def transmittance(optical_depth: Float[Array, "*batch S"]) -> Float[Array, "*batch S"]:
    """Light that reaches each interval's start: exp of minus the optical depth before it."""
    before = jnp.cumsum(optical_depth[..., :-1], axis=-1)
    return jnp.exp(-jnp.concatenate([jnp.zeros_like(optical_depth[..., :1]), before], axis=-1))


def sample_weights(optical_depth: Float[Array, "*batch S"]) -> Float[Array, "*batch S"]:
    """Share of the ray's light that each interval contributes: T_i (1 - exp(-sigma_i delta_i))."""
    return transmittance(optical_depth) * -jnp.expm1(-optical_depth)


def blend_background(
    color: Float[Array, "*batch 3"],
    opacity: Float[Array, "*batch"],
    background: Float[Array, "*#batch 3"],
) -> Float[Array, "*batch 3"]:
    """Premultiplied colour over a background."""
    return color + (1 - opacity)[..., None] * background
