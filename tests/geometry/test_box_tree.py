"""geometry.box_tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nimpostor_jax.geometry.box_tree import refit, skip


@pytest.mark.parametrize("leaves", [1, 2, 8])
def test_every_box_holds_the_boxes_below_and_little_more(leaves, rng):
    low = rng.normal(size=(leaves, 3)).astype(np.float32)
    high = low + rng.uniform(0.1, 1, size=low.shape).astype(np.float32)
    nodes_low, nodes_high = map(np.asarray, refit(jnp.asarray(low), jnp.asarray(high)))
    assert len(nodes_low) == 2 * leaves
    for node in range(1, 2 * leaves):
        below = [n - leaves for n in range(leaves, 2 * leaves) if bin(n).startswith(bin(node))]
        assert np.all(nodes_low[node] < low[below].min(axis=0))
        assert np.all(nodes_high[node] > high[below].max(axis=0))
        assert np.all(nodes_low[node] > low[below].min(axis=0) - 1e-4)
        assert np.all(nodes_high[node] < high[below].max(axis=0) + 1e-4)


def test_empty_leaves_do_not_spoil_their_ancestors():
    low = jnp.array([[0.0, 0, 0], [jnp.inf, jnp.inf, jnp.inf]])
    high = jnp.array([[1.0, 1, 1], [-jnp.inf, -jnp.inf, -jnp.inf]])
    nodes_low, nodes_high = refit(low, high)
    assert np.all(np.isfinite(nodes_low[1:3]))
    assert np.all(nodes_low[3] > nodes_high[3])  # nothing is inside


def test_skip_walks_the_tree_depth_first():
    depth = 4

    def preorder(node):
        return [node] if node >= 1 << depth else [node, *preorder(2 * node), *preorder(2 * node + 1)]

    order = preorder(1)
    for i, node in enumerate(order):
        subtree = len(preorder(node))
        expected = order[i + subtree] if i + subtree < len(order) else 1
        assert int(skip(jnp.int32(node))) == expected
    assert_array_equal(jax.vmap(skip)(jnp.array([1, 2, 3], jnp.int32)), [1, 3, 1])
