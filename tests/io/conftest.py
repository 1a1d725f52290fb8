"""A nerf-synthetic folder and an impostor of every kind of leaf, for the tests of `io`."""

import dataclasses
import typing

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from scene_files import camera_to_world, write_transforms

from nimpostor_jax.config import EncodingConfig, ImpostorConfig
from nimpostor_jax.types import HashLayout, HashTables, NeuralImpostor, TetMesh


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def make_scene(tmp_path):
    """A function that writes a scene of uint8 images [H, W, 3 or 4] and gives its folder."""

    def make(images, split="train", **meta):
        folder = tmp_path / "scene"
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for i, pixels in enumerate(images):
            Image.fromarray(pixels).save(folder / split / f"r_{i}.png")
            matrix = camera_to_world(0.3 * i).tolist()
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrix})
        write_transforms(folder, split, {"camera_angle_x": 0.7, **meta, "frames": frames})
        return folder

    return make


@pytest.fixture
def rgba(rng):
    """A function that draws random straight-alpha pictures, alpha 0 and 255 among them."""

    def draw(height, width):
        pixels = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
        pixels[0, 0, 3], pixels[-1, -1, 3] = 0, 255
        return pixels

    return draw


def filled(cls, rng):
    """A record whose arrays are random int32, records inside it too."""
    hints = typing.get_type_hints(cls)
    parts = {}
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        inner = dataclasses.is_dataclass(hint)
        parts[field.name] = filled(hint, rng) if inner else jnp.asarray(rng.integers(0, 9, (3, 2)))
    return cls(**parts)


@pytest.fixture
def impostor(rng):
    """Not a valid field, but one of every container, dtype and odd bit that a file could lose."""
    floats = jnp.asarray(rng.normal(size=(6, 2)), jnp.float32).at[0].set(jnp.array([-0.0, 1e-42]))
    mesh = filled(TetMesh, rng).replace(
        vertices=floats[:, :1].repeat(3, 1), tets=jnp.array([[0, 1, 2, 3], [1, 2, 3, 4]], jnp.int32)
    )
    layout = HashLayout(
        starts=jnp.array([0, 2, 6]),
        regions=jnp.arange(4).reshape(2, 2, 1),
        multipliers=jnp.array([[1, 2654435761, 4294967295, 0]], jnp.uint32),
        corner_order=jnp.array([[3, 1, 0, 2]]),
        dense_ranks=(None, jnp.arange(3), jnp.zeros((2, 0), jnp.int32)),
        rank_starts=jnp.array([0]),
    )
    decoders = {
        "density": [{"kernel": floats[None], "bias": jnp.ones((1, 2), jnp.bfloat16)}],
        "appearance": (jnp.array([True, False]), jnp.float32(2.5)),
    }
    return NeuralImpostor(
        mesh=mesh,
        tables=HashTables(features=floats, layout=layout),
        decoders=decoders,
        decoder_index=jnp.zeros(2, jnp.int32),
        config=ImpostorConfig(encoding=EncodingConfig(num_levels=2, layout="per_tet")),
    )
