"""Work in proportion to what fixed-size buffers hold: chunks of their used part, one after another.

Shapes are static, so a buffer has room for the worst case; a loop with a traced bound over chunks of it
computes the rest of the chunk in which the used part ends, and nothing beyond. On a CPU a chunk's arrays
also stay in the cache. On accelerators all buffers are one chunk, which is computed as a whole.
Axis: M items, used ones first.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.custom_derivatives import CustomVJPPrimal, SymbolicZero, custom_vjp_primal_tree_values
from jaxtyping import Array, Bool, Int

CPU_CHUNK = 4096  # items; accelerators want few large kernels and take all at once


def default_chunk(num_items: int, on_cpu: int | None = None) -> int:
    """Items a chunk on this back end, at least 1; on CPUs the given number, or `CPU_CHUNK`."""
    return max(1, min(num_items, on_cpu or CPU_CHUNK) if jax.default_backend() == "cpu" else num_items)


def _count(items: Any) -> int:
    return jax.tree.leaves(items)[0].shape[0]


def padded_size(num_items: int, chunk: int) -> int:
    """The next multiple of the chunk's size; at least one chunk, which is traced and may be computed."""
    return max(1, -(-num_items // chunk)) * chunk


def pad_items(items: Any, chunk: int) -> Any:
    """Arrays [M, ...] with zeros up to a multiple of the chunk's size."""
    return jax.tree.map(lambda x: _pad(x, padded_size(x.shape[0], chunk)), items)


def _pad(x: Array, size: int) -> Array:
    return jnp.pad(x, [(0, size - x.shape[0])] + [(0, 0)] * (x.ndim - 1))


def for_chunks(
    num_used: Int[Array, ""],
    num_items: int,
    chunk: int,
    body: Callable[[Int[Array, ""], Any], Any],
    carry: Any,
) -> Any:
    """Fold `body(start, carry)` over the chunks that hold the first `num_used` of all items.

    Where all are one chunk, as they are on accelerators, these compute it in any case: a loop would have the
    host wait for its bound.
    """
    if num_items <= chunk and jax.default_backend() != "cpu":
        return body(jnp.zeros((), jnp.int32), carry)
    num_chunks = (num_used + chunk - 1) // chunk
    return jax.lax.fori_loop(0, num_chunks, lambda i, carry: body(i * chunk, carry), carry)


def take(items: Any, start: Int[Array, ""], chunk: int) -> Any:
    """The chunk of arrays [M, ...] that begins at `start`."""
    return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, start, chunk), items)


def put(items: Any, start: Int[Array, ""], values: Any) -> Any:
    """Arrays [M, ...] with the chunk at `start` replaced."""
    return jax.tree.map(lambda x, v: jax.lax.dynamic_update_slice_in_dim(x, v, start, 0), items, values)


ROW = 64  # items folded one after another, in all rows at once


def running(combine: Callable[[Array, Array], Array], values: Int[Array, " M"], start: int) -> Array:
    """Each value combined with all before it, by an associative operation of which `start` is neutral.

    On CPUs rows are folded, then what they come to: two to four times faster than `jnp.cumsum` and
    `jax.lax.cummax`, and faster to compile. Accelerators, which would launch a kernel for each of a row's
    items, combine as a tree.
    """
    if jax.default_backend() != "cpu":
        return jax.lax.associative_scan(combine, values)
    count = values.shape[0]
    rows = jnp.pad(values, (0, -count % ROW), constant_values=start).reshape(-1, ROW).T

    def fold(total: Array, row: Array) -> tuple[Array, Array]:
        total = combine(total, row)
        return total, total

    in_rows, folded = jax.lax.scan(fold, jnp.full_like(rows[0], start), rows)
    if in_rows.shape[0] > 1:
        before = jnp.pad(running(combine, in_rows, start)[:-1], (1, 0), constant_values=start)
        folded = combine(before, folded)
    return folded.T.reshape(-1)[:count]


def packed_indices(keep: Bool[Array, " M"]) -> tuple[Int[Array, " M"], Int[Array, ""]]:
    """Where the flags are set, in order at the front (0 fills the rest), and how often.

    `jnp.nonzero` does the same in three times the time on a CPU.
    """
    count = keep.shape[0]
    until = running(jnp.add, keep.astype(jnp.int32), 0)
    order = jnp.arange(count, dtype=jnp.int32)
    indices = jnp.zeros(count, jnp.int32).at[jnp.where(keep, until - 1, count)].set(order, mode="drop")
    return indices, until[-1] if count else jnp.zeros((), jnp.int32)


def pack_where(
    function: Callable[[Any, Any], Bool[Array, " chunk"]],
    shared: Any,
    items: Any,
    num_used: Int[Array, ""],
) -> tuple[Int[Array, " M"], Int[Array, ""]]:
    """Which of the first `num_used` items `function(shared, items)` holds for, as `packed_indices`.

    Beyond them stand indices of any items.
    """
    num_items = _count(items)
    chunk = default_chunk(num_items)
    items = pad_items(items, chunk)
    order = jnp.arange(chunk, dtype=jnp.int32)

    def body(start: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        indices, count = found
        keep = function(shared, take(items, start, chunk)) & (start + order < num_used)
        chosen, more = packed_indices(keep)
        # What a chunk leaves free, the next overwrites.
        return put(indices, count, start + chosen), count + more

    none = jnp.zeros(padded_size(num_items, chunk), jnp.int32), jnp.zeros((), jnp.int32)
    indices, count = for_chunks(num_used, num_items, chunk, body, none) if num_items else none
    return jnp.minimum(indices[:num_items], num_items - 1), count


def rows_of(arrays: Any, indices: Int[Array, " n"]) -> Any:
    """Rows [n, ...] of arrays [M, ...]; as `map_used` wants its functions."""
    return jax.tree.map(lambda x: x[indices], arrays)


def map_used(
    function: Callable[[Any, Any], Any],
    shared: Any,
    items: Any,
    num_used: Int[Array, ""],
    chunk: int | None = None,
) -> Any:
    """`function(shared, items)` of arrays [M, ...] in chunks, for the first `num_used` items.

    `function` maps items one by one and closes over no traced value; its slopes must be finite for all
    items, since those behind the used ones may be computed too. What stands beyond the last chunk computed
    is 0. Differentiable in reverse mode in the floating-point leaves of `shared` and `items`: the
    backward pass computes the function again, chunk by chunk, so that nothing but its arguments is kept
    on CPUs.
    """
    num_items = _count(items)
    if num_items == 0:  # items may index what is shared, which is then as empty
        return function(shared, items)
    chunk = chunk or default_chunk(num_items)
    result = _map_used(function, chunk, shared, pad_items(items, chunk), num_used)
    return jax.tree.map(lambda x: x[:num_items], result)


@partial(jax.custom_vjp, nondiff_argnums=(0, 1))
def _map_used(function: Callable, chunk: int, shared: Any, items: Any, num_used: Array) -> Any:
    def body(start: Array, results: Any) -> Any:
        return put(results, start, function(shared, take(items, start, chunk)))

    shapes = jax.eval_shape(function, shared, items)
    empty = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return for_chunks(num_used, _count(items), chunk, body, empty)


def _map_used_forward(
    function: Callable, chunk: int, shared: Any, items: Any, num_used: Any
) -> tuple[Any, tuple]:
    values = custom_vjp_primal_tree_values((shared, items, num_used))
    return _map_used(function, chunk, *values), (*_split_moving((shared, items)), values[2])


def _map_used_backward(function: Callable, chunk: int, residuals: tuple, cotangents: Any) -> tuple:
    (d_shared, d_items), (fixed, fixed_items), num_used = residuals
    cotangents = _materialize(cotangents)

    def body(start: Array, sums: tuple) -> tuple:
        part, fixed_part = take((d_items, fixed_items), start, chunk)
        _, pull = jax.vjp(
            lambda s, p: function(_join_moving(s, fixed), _join_moving(p, fixed_part)), d_shared, part
        )
        of_shared, of_part = pull(take(cotangents, start, chunk))
        return jax.tree.map(jnp.add, sums[0], of_shared), put(sums[1], start, of_part)

    zeros = jax.tree.map(jnp.zeros_like, (d_shared, d_items))
    num_items = _count((d_items, fixed_items))
    return *for_chunks(num_used, num_items, chunk, body, zeros), None


# Symbolic zeros tell the rules which arguments are differentiated: the others' gradients are spared.
_map_used.defvjp(_map_used_forward, _map_used_backward, symbolic_zeros=True)


def _materialize(cotangents: Any) -> Any:
    """Cotangents of a custom VJP with arrays in the place of symbolic zeros."""
    return jax.tree.map(
        lambda x: jnp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x,
        cotangents,
        is_leaf=lambda x: isinstance(x, SymbolicZero),
    )


def _split_moving(arguments: Any) -> tuple[Any, Any]:
    """A custom VJP's arguments: leaves that are differentiated, and others; None in each other's place."""

    def part(keep: bool) -> Any:
        def choose(x: CustomVJPPrimal) -> Any:
            moves = x.perturbed and jnp.issubdtype(x.value.dtype, jnp.inexact)  # integers have no gradient
            return x.value if moves == keep else None

        return jax.tree.map(choose, arguments, is_leaf=lambda x: isinstance(x, CustomVJPPrimal))

    return part(True), part(False)


def _join_moving(moving: Any, fixed: Any) -> Any:
    """What `_split_moving` split."""
    return jax.tree.map(lambda x, y: y if x is None else x, moving, fixed, is_leaf=lambda x: x is None)
