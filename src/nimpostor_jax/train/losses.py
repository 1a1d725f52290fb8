"""Training losses: means over the leading ray axis, so that shards average to the whole."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def photometric(
    color: Float[Array, "R 3"], target: Float[Array, "R 3"], ignore: Bool[Array, " R"]
) -> Float[Array, ""]:
    """Mean squared colour error; `ignore`d rays (their buffers overflowed) count as zero."""
    squared = jnp.sum((color - target) ** 2, axis=-1) / 3
    return jnp.mean(jnp.where(ignore, 0, squared))
