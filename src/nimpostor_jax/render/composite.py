"""Volume rendering quadrature (Eq. 1, with the transmittance's sum made exclusive), on packed samples.

Axes: M samples, ordered by ray and along each ray. The optical depth of an interval is its density, per unit
of the density measure, times its length in that measure.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import ROW, default_chunk, for_chunks, map_used, pad_items, put, running, take


def transmittance(
    optical_depth: Float[Array, " M"], rays: Int[Array, " M"], num_used: Int[Array, ""] | None = None
) -> Float[Array, " M"]:
    """Light that reaches each interval's start: exp of minus the optical depth before it on its ray."""
    return jnp.exp(-sum_before(optical_depth, rays, num_used))


def sample_weights(
    optical_depth: Float[Array, " M"], rays: Int[Array, " M"], num_used: Int[Array, ""] | None = None
) -> Float[Array, " M"]:
    """Share of the ray's light that each interval contributes: T_i (1 - exp(-sigma_i delta_i))."""
    return transmittance(optical_depth, rays, num_used) * -jnp.expm1(-optical_depth)


def sum_before(
    values: Float[Array, " M"], rays: Int[Array, " M"], num_used: Int[Array, ""] | None = None
) -> Float[Array, " M"]:
    """Sum of the earlier values with the same ray; equal rays stand together. Differentiable in reverse mode.

    Each ray is summed on its own: differences of one running sum over all rays would cancel. Where only the
    first `num_used` values matter, no more than their chunks are summed; the rest is 0.
    """
    count = values.shape[0]
    used = jnp.asarray(count if num_used is None else num_used, jnp.int32)
    return _sum_before(values, rays, used) if count else values


@jax.custom_vjp
def _sum_before(values: Float[Array, " M"], rays: Int[Array, " M"], num_used: Array) -> Float[Array, " M"]:
    return _sum_chunks(values, rays, num_used, reverse=False)


def _sum_before_forward(values: Array, rays: Array, num_used: Array) -> tuple[Array, tuple]:
    return _sum_before(values, rays, num_used), (rays, num_used)


def _sum_before_backward(residuals: tuple, cotangent: Array) -> tuple[Array, None, None]:
    return _sum_chunks(cotangent, *residuals, reverse=True), None, None  # what follows is before, in reverse


_sum_before.defvjp(_sum_before_forward, _sum_before_backward)


def _sum_chunks(
    values: Float[Array, " M"], rays: Int[Array, " M"], num_used: Array, *, reverse: bool
) -> Float[Array, " M"]:
    """Chunk by chunk, from the first or from the last; a chunk hands on what its last ray has gathered."""
    count = values.shape[0]
    chunk, on_cpu = default_chunk(count), jax.default_backend() == "cpu"
    values, rays = pad_items((values, rays), chunk)
    last_start = jnp.maximum(num_used - 1, 0) // chunk * chunk

    def body(start: Array, carry: tuple) -> tuple:
        sums, ray, total = carry
        start = last_start - start if reverse else start
        part, ids = take((values, rays), start, chunk)
        part = jnp.where(start + jnp.arange(chunk) < num_used, part, 0)
        if reverse:
            part, ids = part[::-1], ids[::-1]
        before = _sum_rows(part, ids) if on_cpu else _sum_tree(part, ids)
        before += jnp.where((ids == ids[0]) & (ids[0] == ray), total, 0)
        sums = put(sums, start, before[::-1] if reverse else before)
        return sums, ids[-1], before[-1] + part[-1]

    carry = jnp.zeros_like(values), jnp.full((), -1, rays.dtype), jnp.zeros((), values.dtype)
    return for_chunks(num_used, count, chunk, body, carry)[0][:count]


def _sum_rows(values: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """By rows of `ROW` samples: first within each row, then with what the rows before bring in."""
    count = values.shape[0]
    padding = (0, -count % ROW)
    rows = jnp.pad(values, padding).reshape(-1, ROW).T  # [ROW, rows]
    ids = jnp.pad(rays, padding, mode="edge").reshape(-1, ROW).T
    same = ids[1:] == ids[:-1]

    def step(before: Array, part: tuple) -> tuple[Array, Array]:
        value, goes_on = part
        total = jnp.where(goes_on, before + value, 0)
        return total, total

    last, sums = jax.lax.scan(step, jnp.zeros_like(rows[0]), (rows[:-1], same))
    sums = jnp.concatenate([jnp.zeros_like(rows[:1]), sums])
    if rows.shape[1] > 1:
        # A row leaves its last ray's sum to the next; where that ray fills the row, with all that came in.
        left = last + rows[-1]
        joined = jnp.pad(ids[0, 1:] == ids[-1, :-1], (1, 0))
        passes = jnp.all(same, axis=0) & joined
        runs = running(jnp.maximum, jnp.where(passes, 0, jnp.arange(len(left), dtype=jnp.int32)), 0)
        after = _sum_rows(left, runs) + left
        incoming = jnp.where(joined, jnp.pad(after[:-1], (1, 0)), 0)
        sums += jnp.where(ids == ids[:1], incoming, 0)
    return sums.T.reshape(-1)[:count]


def _sum_tree(values: Float[Array, " M"], rays: Int[Array, " M"]) -> Float[Array, " M"]:
    """The same in a logarithmic number of steps, as accelerators want them: each launches kernels."""
    first = jnp.pad(rays[1:] != rays[:-1], (1, 0), constant_values=True)

    def join(left: tuple, right: tuple) -> tuple:
        (left_starts, left_sum), (starts, total) = left, right
        return left_starts | starts, jnp.where(starts, total, left_sum + total)

    _, until = jax.lax.associative_scan(join, (first, values))
    return jnp.where(first, 0, jnp.pad(until[:-1], (1, 0)))


def sum_by_ray(
    weights: Float[Array, " M"],
    values: Float[Array, "M C"],
    rays: Int[Array, " M"],
    num_rays: int,
    num_used: Int[Array, ""],
) -> Float[Array, "R C"]:
    """Each ray's sum of weighted values over the first `num_used` samples; differentiable in reverse mode."""
    return _sum_by_ray(num_rays, weights, values, rays, num_used)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _sum_by_ray(num_rays: int, weights: Array, values: Array, rays: Array, num_used: Array) -> Array:
    chunk = default_chunk(len(weights))
    items = pad_items((weights, values, rays), chunk)

    def add(start: Array, sums: Array) -> Array:
        weight, value, ray = take(items, start, chunk)
        used = start + jnp.arange(chunk) < num_used
        return sums.at[ray].add(jnp.where(used[:, None], weight[:, None] * value, 0))

    sums = jnp.zeros((num_rays, values.shape[1]), values.dtype)
    return for_chunks(num_used, len(weights), chunk, add, sums)


def _sum_by_ray_forward(num_rays: int, *arguments: Array) -> tuple[Array, tuple]:
    return _sum_by_ray(num_rays, *arguments), arguments


def _sum_by_ray_backward(num_rays: int, arguments: tuple, cotangent: Array) -> tuple:
    weights, values, rays, num_used = arguments

    def pull(cotangent: Array, part: tuple) -> tuple[Array, Array]:
        weight, value, ray = part
        mine = cotangent[ray]
        return jnp.sum(mine * value, axis=1), weight[:, None] * mine

    d_weights, d_values = map_used(pull, cotangent, (weights, values, rays), num_used)
    used = jnp.arange(len(weights)) < num_used
    return jnp.where(used, d_weights, 0), jnp.where(used[:, None], d_values, 0), None, None


_sum_by_ray.defvjp(_sum_by_ray_forward, _sum_by_ray_backward)


def blend_background(
    color: Float[Array, "*batch 3"],
    opacity: Float[Array, "*batch"],
    background: Float[Array, "*#batch 3"],
) -> Float[Array, "*batch 3"]:
    """Premultiplied colour over a background."""
    return color + (1 - opacity)[..., None] * background
