"""Baking a trained impostor onto the faces of its tets: resolutions, memory, fit, refinement."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from tqdm.auto import tqdm

from nimpostor_jax.config import BakeConfig, RenderConfig, TrainConfig
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.encoding.face_grid import NO_TEXELS, build_face_layout, num_texels
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import world_vertices
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.pipeline.prepare import Log, Scene
from nimpostor_jax.render.baked import BASIS
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.frame import refined
from nimpostor_jax.render.sampling import with_step
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.bake import (
    Moments,
    add_contents,
    add_depths,
    add_visible,
    baked_parameters,
    no_moments,
    refine_step,
    solve_moments,
    with_baked_parameters,
)
from nimpostor_jax.train.pool import PixelPool, build_pool, draw_batch
from nimpostor_jax.train.sharding import device_mesh, over_rays, replicated, sums_by_device
from nimpostor_jax.train.step import RayBatch, make_optimizer
from nimpostor_jax.types import BakedImpostor, HashTables, NeuralImpostor, TetMesh

FIT_RAYS = 8192  # a call
FIT_DEVICES = 4  # at most: each has moments as large as the textures
SYNC_EVERY = 2  # calls that may be under way at once: each has its buffers from the start
FIT_REFINEMENT = 4.0  # of training's steps: tets are small, and each should get some samples
LOOK_SHARE, DEPTHS_SHARE = 0.25, 0.5  # of the rays: for what is visible at all, and how deep it lies
FINAL_RATE = 0.1  # of the learning rate, at the end of the refinement
RATES = {"depths": 1.0, "textures": 1.0, "decoders": 0.2}  # shares of it


def bake(impostor: NeuralImpostor, scene: Scene, config: BakeConfig, *, log: Log = print) -> BakedImpostor:
    """The impostor with what its tets show baked onto their faces; best trained with early integration.

    Halves the cage's tets, leaves out those in which nothing is seen, fits textures to what training rays
    gather in each of the others, and refines them on the training views. Raises ValueError where the textures
    would need more than `max_megabytes`, or faces have no area.
    """
    if impostor.gates or impostor.paints:
        raise ValueError("consolidate live operations (gates, paints) before the impostor is baked")
    impostor = fine_impostor(impostor, scene.train, config)
    train, mesh = scene.config.train, impostor.mesh
    pixels = face_pixels(world_vertices(mesh), np.asarray(mesh.tets), scene.train)
    pool, _ = build_pool(
        mesh,
        scene.train.cameras,
        scene.train.images,
        scene.config.render.march,
        scene.train.backgrounds,
    )
    key = jax.random.key(train.seed + 2)
    probe = draw_batch(key, 0, pool, min(FIT_RAYS, config.fit_rays), "white")
    render = fit_config(mesh, pool, probe, with_step(scene.config.render, impostor.config.encoding))

    devices = device_mesh(fit_devices(len(probe.jitter)))

    def add_up(start: Callable[[], Any], add: Callable[..., Any], share: float, text: str, *more: Any) -> Any:
        """Sums over rays, on the host; each device adds up its own."""
        compiled = jax.jit(sums_by_device(devices, add), static_argnames="config", donate_argnums=0)
        shared = jax.device_put((impostor, *more), replicated(devices))
        size = len(probe.jitter)

        @partial(jax.jit, out_shardings=over_rays(devices))
        def no_sums() -> Any:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (devices.size, *x.shape)), start())

        sums, count = no_sums(), -(-round(share * config.fit_rays) // size)
        for i in tqdm(range(count), desc=text, unit="batch", disable=None):
            batch = jax.device_put(draw_batch(key, i, pool, size, "white"), over_rays(devices))
            sums = compiled(sums, *shared, batch, config=render)
            if i % SYNC_EVERY == 0:
                jax.block_until_ready(sums)
        return jax.tree.map(_total, sums)

    found = add_up(lambda: jnp.zeros((len(mesh.tets), 2)), add_visible, LOOK_SHARE, "look")
    light, taken = found.T
    shown = taken > config.min_opacity * np.maximum(light, 1)
    resolutions = np.clip(np.ceil(config.texels_per_pixel * pixels), 1, config.max_resolution)
    resolutions = np.where(shown[:, None], resolutions, 0).astype(np.int64)
    num_features = impostor.config.encoding.feature_dim
    counts = checked_texels(resolutions, BASIS * (2 + num_features), config, log)
    faces = np.concatenate([np.zeros(NO_TEXELS, int), np.repeat(np.arange(counts.size), counts)])
    layout = build_face_layout(resolutions)

    def tables(*moments: Moments) -> HashTables:
        texels = np.concatenate([solve_moments(part, faces) for part in moments], axis=2)
        return HashTables(features=jnp.asarray(texels.reshape(len(faces), -1)), layout=layout)

    def no_contents() -> tuple[Moments, Moments]:
        return no_moments(len(faces), 1), no_moments(len(faces), num_features)

    depths = tables(add_up(partial(no_moments, len(faces), 1), add_depths, DEPTHS_SHARE, "depths", layout))
    contents = add_up(no_contents, add_contents, 1.0, "contents", depths)
    decoder_index = impostor.decoder_index
    if impostor.embedding is not None:
        decoder_index = decoder_index[impostor.embedding.cells]
    baked = BakedImpostor(
        mesh=mesh,
        depths=depths,
        textures=tables(*contents),
        decoders=impostor.decoders,
        decoder_index=decoder_index,
        config=impostor.config,
    )
    del contents  # as large as the textures
    return refine(baked, pool, train, render, config, log=log)


def fit_devices(num_rays: int) -> list[jax.Device]:
    """As many of the local devices as divide a call's rays, each of which has sums of its own to keep."""
    devices = jax.local_devices()
    count = max(n for n in range(1, min(FIT_DEVICES, len(devices)) + 1) if num_rays % n == 0)
    return devices[:count]


def _total(sums: jax.Array) -> np.ndarray:
    """The sum over devices of their own ones, which are given up: all of them would not fit twice."""
    first, *others = (shard.data for shard in sums.addressable_shards)
    total = np.array(first[0])
    for other in others:
        total += np.asarray(other)[0]
    sums.delete()
    return total


def fine_impostor(impostor: NeuralImpostor, views: PosedImages, config: BakeConfig) -> NeuralImpostor:
    """The impostor with its tets halved until their faces' edges are about `tet_pixels` long in the views."""
    mesh = impostor.mesh
    longest = np.median(face_pixels(world_vertices(mesh), np.asarray(mesh.tets), views))
    return subdivide(impostor, max(0, math.ceil(math.log2(longest / config.tet_pixels))))


def fit_config(mesh: TetMesh, pool: PixelPool, probe: RayBatch, config: RenderConfig) -> RenderConfig:
    """With steps for small tets, and buffers for them."""
    march = dataclasses.replace(config.march, max_entries_per_ray=pool.entries.holds.shape[1])
    config = dataclasses.replace(config, march=march, frame_refinement=FIT_REFINEMENT)
    config = dataclasses.replace(refined(config), min_weight=max(config.min_weight, 1e-4) / FIT_REFINEMENT)
    return fit_capacities(mesh, jax.jit(march_tables)(mesh), probe.rays, config)


def checked_texels(
    resolutions: Int[np.ndarray, "U 4"], numbers: int, config: BakeConfig, log: Log
) -> Int[np.ndarray, " 4U"]:
    """Texels of each face. Raises ValueError where all, of so many numbers each, need too much memory."""
    counts = np.where(resolutions > 0, num_texels(resolutions), 0).reshape(-1)
    megabytes = counts.sum() * numbers * 4 / 1e6
    log(
        f"{len(resolutions):,} tets, {np.sum(resolutions[:, 0] > 0):,} with textures of at most "
        f"{resolutions.max()} texels along an edge; {counts.sum():,} texels: {megabytes:.0f} MB"
    )
    if megabytes > config.max_megabytes:
        raise ValueError(
            f"the textures need {megabytes:.0f} MB, more than BakeConfig.max_megabytes = "
            f"{config.max_megabytes}; lower BakeConfig.texels_per_pixel or raise the limit"
        )
    if not counts.sum():
        raise ValueError("nothing is seen in any tet; train the impostor before it is baked")
    return counts


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
    rates = RATES if config.refine_decoders else RATES | {"decoders": 0.0}
    step = partial(refine_step, config=render, optimizer=optimizer, share=rates.__getitem__)
    compiled = jax.jit(step, donate_argnums=(0, 1))
    parameters = jax.tree.map(jnp.copy, baked_parameters(baked))  # steps consume them
    state = optimizer.init(parameters)
    key, losses = jax.random.key(train.seed + 3), []
    for i in tqdm(range(config.refine_steps), desc="refine", unit="step", disable=None):
        batch = draw_batch(key, i, pool, train.rays_per_batch, "random")
        rate = config.learning_rate * FINAL_RATE ** (i / config.refine_steps)
        parameters, state, loss = compiled(parameters, state, baked, batch, jnp.float32(rate))
        losses.append(loss)
        if i % SYNC_EVERY == 0:
            jax.block_until_ready(loss)
    first, last = (np.mean([float(x) for x in part]) for part in (losses[:20], losses[-20:]))
    log(f"refined: loss {first:.2e} to {last:.2e} in {config.refine_steps} steps")
    return with_baked_parameters(baked, parameters)


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
