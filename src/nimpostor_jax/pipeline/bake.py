"""Baking a trained impostor onto the faces of its tets: resolutions, memory, fit, refinement."""

import dataclasses
import math
from collections.abc import Iterator
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from tqdm.auto import tqdm

from nimpostor_jax.config import BakeConfig, RenderConfig, TrainConfig
from nimpostor_jax.encoding.face_grid import NO_TEXELS, build_face_layout, num_texels
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.pipeline.prepare import Log, Scene
from nimpostor_jax.preprocess.subdivide import subdivide
from nimpostor_jax.preprocess.topology import build_tet_mesh, world_vertices
from nimpostor_jax.render.baked import HEAD
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.frame import refined
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.bake import (
    FineCage,
    add_moments,
    no_moments,
    refine_step,
    solve_moments,
    visible_opacity,
)
from nimpostor_jax.train.pool import PixelPool, build_pool, draw_batch
from nimpostor_jax.train.step import RayBatch, make_optimizer
from nimpostor_jax.types import BakedImpostor, HashTables, NeuralImpostor

FIT_RAYS = 8192  # a call
FIT_REFINEMENT = 4.0  # of training's steps: tets are small, and each should get some samples
FINAL_RATE = 0.1  # of the learning rate, at the end of the refinement
DECODER_RATE = 0.2  # of the textures' learning rate


def bake(impostor: NeuralImpostor, scene: Scene, config: BakeConfig, *, log: Log = print) -> BakedImpostor:
    """The impostor with what its tets show baked onto their faces; best trained with early integration.

    Halves the cage's tets, leaves out those in which nothing is seen, fits textures to what training rays
    gather in each of the others, and refines them on the training views. Raises ValueError where the textures
    would need more than `max_megabytes`, or faces have no area.
    """
    coarse, train = scene.impostor.mesh, scene.config.train
    vertices, tets = world_vertices(coarse), np.asarray(coarse.tets)
    pixels = face_pixels(vertices, tets, scene.train)
    times = max(0, math.ceil(math.log2(np.median(pixels) / config.tet_pixels)))
    fine = subdivide(vertices, tets, times)
    mesh = build_tet_mesh(fine.vertices, fine.tets)
    cage = FineCage(
        mesh=mesh,
        parents=jnp.asarray(fine.parents, jnp.int32),
        lambdas=jnp.asarray(fine.lambdas, jnp.float32),
    )
    pool, _ = build_pool(mesh, scene.train.cameras, scene.train.images, scene.config.render.march)
    key = jax.random.key(train.seed + 2)
    probe = draw_batch(key, 0, pool, min(FIT_RAYS, config.fit_rays), "white")
    render = dataclasses.replace(scene.config.render, frame_refinement=FIT_REFINEMENT)
    march = dataclasses.replace(render.march, max_entries_per_ray=pool.entries.holds.shape[1])
    render = refined(dataclasses.replace(render, march=march))
    render = fit_capacities(mesh, jax.jit(march_tables)(mesh), probe.rays, render)

    def batches(num_rays: int, text: str) -> Iterator[RayBatch]:
        rays = len(probe.jitter)
        for i in tqdm(range(-(-num_rays // rays)), desc=text, unit="batch", disable=None):
            yield draw_batch(key, i, pool, rays, "white")

    found = jnp.zeros((len(fine.tets), 2))
    look = jax.jit(visible_opacity, static_argnames="config", donate_argnums=0)
    for batch in batches(config.fit_rays // 4, "look"):
        found = look(found, impostor, cage, batch, config=render)
    light, taken = np.asarray(found).T
    shown = taken > config.min_opacity * np.maximum(light, 1e-3)
    resolutions = np.clip(
        np.ceil(config.texels_per_pixel * face_pixels(fine.vertices, fine.tets, scene.train)),
        1,
        config.max_resolution,
    ).astype(np.int64)
    resolutions[~shown] = 0

    num_basis = 4 if config.basis == "linear" else 1
    num_channels = HEAD + impostor.config.encoding.feature_dim
    counts = np.where(resolutions > 0, num_texels(resolutions), 0).reshape(-1)
    megabytes = counts.sum() * num_basis * num_channels * 4 / 1e6
    log(
        f"{len(fine.tets):,} tets, {shown.sum():,} of them with textures of at most {resolutions.max()} texels "
        f"along an edge; {counts.sum():,} texels of {num_basis * num_channels} numbers: {megabytes:.0f} MB"
    )
    if megabytes > config.max_megabytes:
        raise ValueError(
            f"the textures need {megabytes:.0f} MB, more than BakeConfig.max_megabytes = "
            f"{config.max_megabytes}; lower BakeConfig.texels_per_pixel or raise the limit"
        )
    layout = build_face_layout(resolutions)
    moments = no_moments(NO_TEXELS + int(counts.sum()), num_basis, num_channels)
    step = jax.jit(add_moments, static_argnames="config", donate_argnums=0)
    for batch in batches(config.fit_rays, "fit"):
        moments = step(moments, impostor, cage, layout, batch, config=render)
    faces = np.concatenate([np.zeros(NO_TEXELS, int), np.repeat(np.arange(counts.size), counts)])
    baked = BakedImpostor(
        mesh=mesh,
        textures=HashTables(features=jnp.asarray(solve_moments(moments, faces), jnp.float32), layout=layout),
        decoders=impostor.decoders,
        decoder_index=impostor.decoder_index[cage.parents],
        config=impostor.config,
    )
    return refine(baked, pool, train, render, config, log=log)


def refine(
    baked: BakedImpostor,
    pool: PixelPool,
    train: TrainConfig,
    render: RenderConfig,
    config: BakeConfig,
    *,
    log: Log = print,
) -> BakedImpostor:
    """Textures, and decoders where asked, after some steps of training on whole pixels."""
    if not config.refine_steps:
        return baked
    optimizer = make_optimizer()
    parameters = {"features": baked.textures.features, "decoders": baked.decoders}
    state = optimizer.init(parameters)
    step = jax.jit(partial(refine_step, config=render, optimizer=optimizer), donate_argnums=(0, 1))
    parameters = jax.tree.map(jnp.copy, parameters)
    key, losses = jax.random.key(train.seed + 3), []
    for i in tqdm(range(config.refine_steps), desc="refine", unit="step", disable=None):
        batch = draw_batch(key, i, pool, train.rays_per_batch, "random")
        rate = config.learning_rate * FINAL_RATE ** (i / config.refine_steps)
        decoder_rate = DECODER_RATE * rate if config.refine_decoders else 0.0
        rates = {"features": jnp.float32(rate), "decoders": jnp.float32(decoder_rate)}
        parameters, state, loss = step(parameters, state, baked, batch, rates)
        losses.append(loss)
    first, last = (np.mean([float(x) for x in part]) for part in (losses[:20], losses[-20:]))
    log(f"refined: loss {first:.2e} to {last:.2e} in {config.refine_steps} steps")
    textures = dataclasses.replace(baked.textures, features=parameters["features"])
    return dataclasses.replace(baked, textures=textures, decoders=parameters["decoders"])


def face_pixels(
    vertices: Float[np.ndarray, "V 3"], tets: Int[np.ndarray, "T 4"], views: PosedImages
) -> Float[np.ndarray, "T 4"]:
    """Length in pixels of each face's longest edge, at the views' median distance.

    Raises ValueError, naming the first, for faces without area.
    """
    corners = vertices[tets[:, np.array(FACES)]]  # [T, 4, 3, 3]
    edges = corners - np.roll(corners, 1, axis=2)
    normals = np.cross(edges[:, :, 0], edges[:, :, 1])
    flat = np.argwhere(~(np.linalg.norm(normals, axis=-1) > 0))
    if len(flat):
        raise ValueError(
            f"{len(flat)} faces have no area; first: that of tet {flat[0, 0]} opposite corner {flat[0, 1]}; "
            "remesh the cage"
        )
    middle = vertices.mean(axis=0)
    distance = np.median(np.linalg.norm(views.camera_to_world[:, :3, 3] - middle, axis=1))
    return np.linalg.norm(edges, axis=-1).max(axis=-1) * np.median(views.focal) / distance
