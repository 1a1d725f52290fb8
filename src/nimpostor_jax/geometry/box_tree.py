"""Complete binary trees of axis-aligned boxes in heap order.

The root is node 1, node n has the children 2n and 2n + 1. The topology is the leaves' order alone,
so boxes are refitted from moved vertices in a few reductions, and a traversal needs no stack:
`skip` leads from a finished subtree to the next one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def refit(
    low: Float[Array, "leaves 3"], high: Float[Array, "leaves 3"]
) -> tuple[Float[Array, "nodes 3"], Float[Array, "nodes 3"]]:
    """Boxes of all nodes from those of the leaves (a power of two); row n is node n, 0 unused.

    Every box grows by a few units in the last place: a test against it may then round either way.
    """
    levels = [jnp.concatenate([low, -high], axis=1)]  # both ends as minima
    while levels[0].shape[0] > 1:
        levels.insert(0, jnp.min(levels[0].reshape(-1, 2, 6), axis=1))
    nodes = jnp.concatenate([jnp.zeros((1, 6), low.dtype), *levels])
    extent = jnp.max(jnp.where(jnp.isfinite(nodes), jnp.abs(nodes), 0))
    margin = 16 * jnp.finfo(low.dtype).eps * extent
    return nodes[:, :3] - margin, margin - nodes[:, 3:]


def skip(node: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """The node after this node's subtree in depth-first order; 1 when the traversal is over.

    A left child is followed by its sibling; a right child by what follows its parent. In heap order
    that is node + 1 without its trailing zeros.
    """
    successor = node + 1
    trailing_zeros = jax.lax.population_count(~successor & (successor - 1))
    return jax.lax.shift_right_logical(successor, trailing_zeros)
