"""Volume rendering quadrature (Eq. 1, with the transmittance's sum made exclusive), on packed samples.

Axes: M samples, ordered by ray and along each ray. The optical depth of an interval is its density, per unit
of the density measure, times its length in that measure.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

ROW = 64  # samples summed one after another, in all rows at once


def transmittance(optical_depth: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """Light that reaches each interval's start: exp of minus the optical depth before it on its ray."""
    return jnp.exp(-sum_before(optical_depth, rays))


def sample_weights(optical_depth: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """Share of the ray's light that each interval contributes: T_i (1 - exp(-sigma_i delta_i))."""
    return transmittance(optical_depth, rays) * -jnp.expm1(-optical_depth)


@jax.custom_vjp
def sum_before(values: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """Sum of the earlier values with the same ray; equal rays stand together. Differentiable in reverse mode.

    Each ray is summed on its own: differences of one running sum over all rays would cancel.
    """
    return _sum_before(values, rays)


def _sum_before_forward(values: Array, rays: Array) -> tuple[Array, Array]:
    return _sum_before(values, rays), rays


def _sum_before_backward(rays: Array, cotangent: Array) -> tuple[Array, None]:
    return _sum_before(cotangent[::-1], rays[::-1])[::-1], None  # what follows is what is before, in reverse


sum_before.defvjp(_sum_before_forward, _sum_before_backward)


def _sum_before(values: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """By rows of `ROW` samples: first within each row, then with what the rows before bring in."""
    count = values.shape[0]
    padding = (0, -count % ROW)
    rows = jnp.pad(values, padding).reshape(-1, ROW).T  # [ROW, rows]
    ids = jnp.pad(rays, padding, mode="edge").reshape(-1, ROW).T if count else jnp.zeros((ROW, 0), rays.dtype)
    same = ids[1:] == ids[:-1]

    def step(before: Array, part: tuple) -> tuple[Array, Array]:
        value, goes_on = part
        total = jnp.where(goes_on, before + value, 0)
        return total, total

    last, sums = jax.lax.scan(step, jnp.zeros_like(rows[0]), (rows[:-1], same))
    sums = jnp.concatenate([jnp.zeros_like(rows[:1]), sums])
    # What a row leaves to the next: its last ray's sum, and all that came in if that ray fills the row.
    whole = jnp.all(same, axis=0)
    joined = jnp.concatenate([jnp.zeros(1, bool), ids[0, 1:] == ids[-1, :-1]])
    incoming = _carried(last + rows[-1], whole, joined)
    first_ray = ids == ids[:1]
    sums += jnp.where(first_ray & joined, incoming, 0)
    return sums.T.reshape(-1)[:count]


def _carried(left: Float[Array, " rows"], whole: Bool[Array, " rows"], joined: Bool[Array, " rows"]) -> Array:
    """What each row's first ray has gathered in the rows before."""

    def combine(a: tuple, b: tuple) -> tuple:
        return a[0] & b[0], jnp.where(b[0], a[1] + b[1], b[1])

    passes = whole & joined
    _, after = jax.lax.associative_scan(combine, (passes, left))
    before = jnp.concatenate([jnp.zeros_like(left[:1]), after[:-1]])
    return jnp.where(joined, before, 0)


def blend_background(
    color: Float[Array, "*batch 3"],
    opacity: Float[Array, "*batch"],
    background: Float[Array, "*#batch 3"],
) -> Float[Array, "*batch 3"]:
    """Premultiplied colour over a background."""
    return color + (1 - opacity)[..., None] * background
