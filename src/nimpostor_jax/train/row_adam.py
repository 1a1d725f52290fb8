"""Adam for tables of which a batch touches few rows: the others are not read and do not move.

Kingma and Ba (2015), with the constants of `train.step.make_optimizer`. Moments of a row decay with
the steps that touch it, as in PyTorch's SparseAdam. Axes: N rows, F numbers each; M rows of a batch.
"""

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from nimpostor_jax.chunks import default_chunk, for_chunks, pad_items, take
from nimpostor_jax.train.step import B1, B2, EPSILON


@struct.dataclass
class RowMoments:
    """What Adam keeps of a table."""

    first: Float[Array, "N F"]
    second: Float[Array, "N F"]
    steps: Int[Array, ""]


def no_row_moments(table: Float[Array, "N F"]) -> RowMoments:
    """Before the first step."""
    return RowMoments(
        first=jnp.zeros_like(table), second=jnp.zeros_like(table), steps=jnp.zeros((), jnp.int32)
    )


def update_rows(
    table: Float[Array, "N F"],
    moments: RowMoments,
    rows: Int[Array, " M"],
    gradient: Float[Array, "M F"],
    num_used: Int[Array, ""],
    rate: Float[Array, ""],
) -> tuple[Float[Array, "N F"], RowMoments]:
    """The table after a step at a learning rate, from the gradient of its first `num_used` `rows`. Pure.

    These are all different. The others stay as they are, and so do those of which the gradient is 0.
    """
    count, chunk = rows.size, default_chunk(rows.size)
    rows, gradient = pad_items((rows, gradient), chunk)
    steps = moments.steps + 1
    unbiased = [1 - b ** steps.astype(table.dtype) for b in (B1, B2)]
    order = jnp.arange(chunk, dtype=jnp.int32)

    def update(start: Int[Array, ""], tables: tuple) -> tuple:
        table, first, second = tables
        at, slope = take((rows, gradient), start, chunk)
        touched = jnp.any(slope != 0, axis=1) & (start + order < num_used)
        at = jnp.where(touched, at, table.shape[0])
        one, two = (x.at[at].get(mode="fill", fill_value=0) for x in (first, second))
        one = B1 * one + (1 - B1) * slope
        two = B2 * two + (1 - B2) * slope**2
        moved = rate * (one / unbiased[0]) / (jnp.sqrt(two / unbiased[1]) + EPSILON)
        return (
            table.at[at].add(-moved, mode="drop"),
            first.at[at].set(one, mode="drop"),
            second.at[at].set(two, mode="drop"),
        )

    tables = table, moments.first, moments.second
    table, first, second = for_chunks(num_used, count, chunk, update, tables)
    return table, RowMoments(first=first, second=second, steps=steps)
