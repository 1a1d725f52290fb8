"""Tiny impostors, cameras and configs for the tests of the renderer and of training."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from meshes import MESHES
from rays import unit

from nimpostor_jax.config import (
    DecoderConfig,
    EncodingConfig,
    ImpostorConfig,
    MarchConfig,
    RenderConfig,
    SamplerConfig,
)
from nimpostor_jax.field.impostor import init_impostor
from nimpostor_jax.geometry.topology import build_tet_mesh
from nimpostor_jax.types import Camera

FIELD = ImpostorConfig(
    encoding=EncodingConfig(num_levels=2, growth=3.0, log2_tet_table=8),
    decoder=DecoderConfig(density_hidden=4, appearance_hidden=4, appearance_layers=1, sh_degree=2),
)
RENDER = RenderConfig(
    march=MarchConfig(max_tets_per_ray=8, max_entries_per_ray=2),
    sampler=SamplerConfig(step=0.5, max_samples_per_ray=16),
    min_weight=0.0,
    frame_refinement=1.0,
)


def exact(**changes):
    """RENDER with changes, of the sampler too (`step`, `measure`, ...)."""
    names = {f.name for f in dataclasses.fields(SamplerConfig)}
    sampler = dataclasses.replace(RENDER.sampler, **{k: v for k, v in changes.items() if k in names})
    return dataclasses.replace(
        RENDER, sampler=sampler, **{k: v for k, v in changes.items() if k not in names}
    )


def impostor(name="cube", dtype="float32", scale=1.0, offset=0.0, seed=0):
    """An impostor whose random field is far from constant: parameters of order 1, moderate densities."""
    vertices, tets = MESHES[name]()
    mesh = build_tet_mesh(vertices * scale + offset, tets, dtype=dtype)
    made = init_impostor(jax.random.key(seed), mesh, FIELD)
    rng = np.random.default_rng(seed)
    features = jnp.asarray(rng.normal(size=made.tables.features.shape), dtype)
    decoders = jax.tree.map(lambda x: jnp.asarray(0.7 * rng.normal(size=x.shape), dtype), made.decoders)
    decoders["density"][-1]["bias"] -= 1.5  # most rays neither empty nor opaque
    return made.replace(tables=made.tables.replace(features=features), decoders=decoders)


def constant_density(made, bias):
    """The impostor with density exp(bias) everywhere."""
    density = [*made.decoders["density"][:-1], jax.tree.map(jnp.zeros_like, made.decoders["density"][-1])]
    density[-1] = density[-1] | {"bias": density[-1]["bias"] + bias}
    return made.replace(decoders=made.decoders | {"density": density})


def pushed_together(impostor):
    """An impostor on "blobs", baked or not, with the second cloud moved into the first."""
    vertices = np.asarray(impostor.mesh.vertices)
    second = np.arange(len(vertices)) >= len(vertices) // 2
    shift = 0.9 * (vertices[second].mean(axis=0) - vertices[~second].mean(axis=0))
    moved = jnp.asarray(np.where(second[:, None], vertices - shift, vertices))
    return impostor.replace(mesh=impostor.mesh.replace(vertices=moved))


def look_at(position, target, dtype="float32"):
    """A camera-to-world matrix (OpenGL axes)."""
    back = unit(np.asarray(position, float) - np.asarray(target, float))
    right = unit(np.cross([0.1, 0.2, 1.0], back))
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = position
    return jnp.asarray(matrix, dtype)


def camera(width=12, height=9, position=(2.3, 1.4, 1.9), target=(0.5, 0.5, 0.5), dtype="float32"):
    return Camera(
        camera_to_world=look_at(position, target, dtype),
        focal=jnp.asarray([1.3 * width, 1.25 * width], dtype),
        principal=jnp.asarray([width / 2, height / 2], dtype),
        width=width,
        height=height,
    )
