"""A tiny run: the built-in scene at 25 x 25 pixels in a cage of 6 tets around everything."""

import numpy as np
import pytest

from nimpostor_jax.gin_flags import load_config
from nimpostor_jax.io.mesh_files import save_tets

BINDINGS = (
    "DataConfig.resolution=25",
    "EncodingConfig.num_levels=3",
    "DecoderConfig.appearance_hidden=16",
    "SamplerConfig.step=0.25",
    "SamplerConfig.max_samples_per_ray=32",
    "MarchConfig.max_tets_per_ray=8",
    "MarchConfig.max_entries_per_ray=2",
    "TrainConfig.steps=6",
    "TrainConfig.rays_per_batch=256",
    "TrainConfig.warmup_steps=2",
    "TrainConfig.log_every=2",
    "TrainConfig.checkpoint_every=3",
)


@pytest.fixture(scope="session")
def bindings():
    return list(BINDINGS)


@pytest.fixture(scope="session")
def config(bindings):
    return load_config(bindings=bindings)


@pytest.fixture(scope="session")
def cage(tmp_path_factory):
    """The cube [-1.3, 1.3]^3 in six tets around its diagonal."""
    corners = np.array([[(i >> a) & 1 for a in range(3)] for i in range(8)], float) * 2.6 - 1.3
    tets = np.array([[0, 1, 3, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 6, 4, 7], [0, 4, 5, 7], [0, 5, 1, 7]])
    path = tmp_path_factory.mktemp("cage") / "cube.npz"
    save_tets(path, corners, tets)
    return path
