"""A baked impostor with random textures, for the tests of marching and rasterizing it."""

import jax
import jax.numpy as jnp
import numpy as np
import scenes

from nimpostor_jax.encoding.face_grid import build_face_layout, num_texels
from nimpostor_jax.field.decoder import principal_channels
from nimpostor_jax.types import BakedImpostor, HashTables

CHANNELS = 3


def baked(name="blobs", dtype="float32", seed=0, opacity=(0.0, 1.0), depth=(0.0, 1.0), num_sets=1, finest=8):
    """Textures of 1 to `finest` texels along an edge, random opacities; decoder sets take turns."""
    made = scenes.impostor(name, dtype)
    rng = np.random.default_rng(seed)
    resolutions = rng.integers(1, finest + 1, (len(made.mesh.tets), 4))
    layout = build_face_layout(resolutions)
    count = int(num_texels(resolutions).sum())

    def tables(texels):
        return HashTables(features=jnp.asarray(texels.reshape(count, -1), dtype), layout=layout)

    seen = rng.uniform(*opacity, (count, 4, 1))
    size = made.config.encoding.feature_dim
    several = jax.tree.map(lambda x: jnp.concatenate([(1 - i) * x for i in range(num_sets)]), made.decoders)
    products = np.eye(size) * rng.uniform(1, 2, (num_sets, size, 1))
    decoders, _ = principal_channels(several, products, CHANNELS)
    return BakedImpostor(
        mesh=made.mesh,
        depths=tables(rng.uniform(*depth, seen.shape)),
        opacities=tables(seen),
        textures=tables(rng.normal(size=(count, 4, CHANNELS))),
        decoders=decoders,
        decoder_index=jnp.arange(len(resolutions), dtype=jnp.int32) % num_sets,
        config=made.config,
    )
