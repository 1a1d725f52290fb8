"""A baked impostor with random textures, for the tests of marching and rasterizing it."""

import jax.numpy as jnp
import numpy as np
import scenes

from nimpostor_jax.encoding.face_grid import NO_TEXELS, build_face_layout, num_texels
from nimpostor_jax.types import BakedImpostor, HashTables


def baked(name="blobs", dtype="float32", seed=0, opacity=(0.0, 1.0), empty=0.2):
    """Textures of 1 to 8 texels along an edge, opacities between the given ones; some tets without."""
    made = scenes.impostor(name, dtype)
    rng = np.random.default_rng(seed)
    resolutions = rng.integers(1, 9, (len(made.mesh.tets), 4))
    resolutions[rng.uniform(size=len(resolutions)) < empty] = 0
    layout = build_face_layout(resolutions)
    count = NO_TEXELS + int(num_texels(resolutions[resolutions > 0]).sum())

    def tables(texels):
        return HashTables(features=jnp.asarray(texels.reshape(count, -1), dtype), layout=layout)

    seen = rng.uniform(*opacity, (count, 4, 1))
    features = rng.normal(size=(count, 4, made.config.encoding.feature_dim))
    return BakedImpostor(
        mesh=made.mesh,
        depths=tables(rng.uniform(size=seen.shape)),
        textures=tables(np.concatenate([seen, features], axis=2)),
        decoders=made.decoders,
        decoder_index=made.decoder_index,
        config=made.config,
    )
