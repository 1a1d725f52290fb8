"""A baked impostor with random textures, for the tests of marching and rasterizing it."""

import jax.numpy as jnp
import numpy as np
import scenes

from nimpostor_jax.encoding.face_grid import build_face_layout, num_texels
from nimpostor_jax.types import BakedImpostor, HashTables


def baked(name="blobs", dtype="float32", num_basis=4, seed=0, opacity=(0.0, 1.0)):
    """Textures of 1 to 8 texels along an edge, opacities between the given ones."""
    made = scenes.impostor(name, dtype)
    rng = np.random.default_rng(seed)
    resolutions = rng.integers(1, 9, (len(made.mesh.tets), 4))
    channels = 2 + made.config.encoding.feature_dim
    texels = rng.normal(size=(int(num_texels(resolutions).sum()), num_basis, channels))
    texels[..., 0] = rng.uniform(*opacity, texels.shape[:2])
    texels[..., 1] = texels[..., 0] * rng.uniform(size=texels.shape[:2])
    texels[..., 2:] *= texels[..., :1]
    features = jnp.asarray(texels.reshape(len(texels), -1), dtype)
    return BakedImpostor(
        mesh=made.mesh,
        textures=HashTables(features=features, layout=build_face_layout(resolutions)),
        decoders=made.decoders,
        decoder_index=made.decoder_index,
        config=made.config,
    )
