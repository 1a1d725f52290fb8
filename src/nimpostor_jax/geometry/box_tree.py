"""Complete binary trees of axis-aligned boxes, in heap order: node n has children 2n and 2n + 1, the root is 1.

The topology is the leaves' order alone, so boxes are refitted from moved vertices in a few reductions,
and a traversal needs no stack: `skip` leads from a finished subtree to the next one.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def refit(
    low: Float[Array, "leaves 3"], high: Float[Array, "leaves 3"]
) -> tuple[Float[Array, "nodes 3"], Float[Array, "nodes 3"]]:
    """Boxes of all nodes from those of the leaves (a power of two); row n is node n, row 0 is unused.

    Every box grows by a few units in the last place: a test against it may then round either way.
    """
    lows, highs = [low], [high]
    while lows[0].shape[0] > 1:
        lows.insert(0, jnp.minimum(lows[0][0::2], lows[0][1::2]))
        highs.insert(0, jnp.maximum(highs[0][0::2], highs[0][1::2]))
    pad = jnp.zeros((1, 3), low.dtype)
    nodes_low, nodes_high = jnp.concatenate([pad, *lows]), jnp.concatenate([pad, *highs])
    extent = jnp.max(jnp.where(jnp.isfinite(nodes_high), jnp.abs(nodes_high), 0))
    extent = jnp.maximum(extent, jnp.max(jnp.where(jnp.isfinite(nodes_low), jnp.abs(nodes_low), 0)))
    margin = 16 * jnp.finfo(low.dtype).eps * extent
    return nodes_low - margin, nodes_high + margin


def skip(node: Int[Array, "*batch"]) -> Int[Array, "*batch"]:
    """The node after this node's subtree in depth-first order; 1 when the traversal is over.

    A left child is followed by its sibling; a right child by what follows its parent. In heap order that is
    node + 1 without its trailing zeros.
    """
    successor = node + 1
    trailing_zeros = jax.lax.population_count(~successor & (successor - 1))
    return jax.lax.shift_right_logical(successor, trailing_zeros)
