"""Baking a trained impostor onto the faces of its tets: resolutions, memory, fit, refinement."""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Float, Int
from tqdm.auto import tqdm

from nimpostor_jax.config import BakeConfig, RenderConfig, TrainConfig
from nimpostor_jax.edit.subdivide import subdivide
from nimpostor_jax.encoding.face_grid import build_face_layout, num_texels
from nimpostor_jax.field.decoder import principal_channels
from nimpostor_jax.geometry.tetrahedron import FACES
from nimpostor_jax.geometry.topology import build_in_frame, world_vertices
from nimpostor_jax.io.blender import PosedImages
from nimpostor_jax.pipeline.novel_views import with_novel_views
from nimpostor_jax.pipeline.prepare import Log, Scene
from nimpostor_jax.render.baked import BASIS
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.frame import for_frames, refined
from nimpostor_jax.render.sampling import with_step
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.bake import (
    Moments,
    Seen,
    add_contents,
    add_depths,
    add_seen,
    no_moments,
    nothing_seen,
    solve_moments,
)
from nimpostor_jax.train.pool import PixelPool, build_pool, draw_batch
from nimpostor_jax.train.refine import count_lit, init_refinement, refine_step, with_tables
from nimpostor_jax.train.sharding import device_mesh, dividing_devices, over_rays, replicated, sums_by_device
from nimpostor_jax.train.step import RayBatch, is_finite
from nimpostor_jax.types import BakedImpostor, Embedding, HashTables, NeuralImpostor

FIT_RAYS = 8192  # a call
FIT_DEVICES = 4  # at most: each has moments as large as the textures
SYNC_EVERY = 2  # calls that may be under way at once: each has its buffers from the start
FIT_REFINEMENT = 2.0  # of training's steps: tets are small, and each should get some samples
LOOK_RAYS, LOOKS_A_TET = 250_000, 20  # rays, at least, to find out what is visible at all
DEPTHS_SHARE = 0.5  # of the rays: for how deep in the tets something lies
FINAL_RATE = 0.1  # of the learning rate, at the end of the refinement
DECODER_SHARE = 0.2  # of it
LIT_MARGIN = 1.3  # of the segments that light reaches: batches differ, and textures change
LOST_SHARE = 1e-3  # of the rays, above which it is reported that they do not fit


def bake(impostor: NeuralImpostor, scene: Scene, config: BakeConfig, *, log: Log = print) -> BakedImpostor:
    """The impostor with what its tets show baked onto their faces; best trained with early integration.

    Halves the tets in which something is seen, leaves out the others, fits textures to what rays gather, and
    refines them on whole pictures: the training views, and what the impostor shows from between them. Raises
    ValueError for gates and paints, where nothing is seen, where the textures would need more than
    `max_megabytes`, where faces have no area, and where rays cross more tets than buffers can hold.
    """
    if impostor.gates or impostor.paints:
        raise ValueError("consolidate live operations (gates, paints) before the impostor is baked")
    train = scene.config.train
    render = with_step(scene.config.render, impostor.config.encoding)
    part, seen = visible_part(impostor, scene.train, render, config, log=log)
    mesh = part.mesh
    pixels = face_pixels(world_vertices(mesh), np.asarray(mesh.tets), scene.train)
    decoders, layers = principal_channels(impostor.decoders, np.asarray(seen.products), config.channels)
    num_channels = layers[0]["weight"].shape[2]
    resolutions = checked_resolutions(pixels, BASIS * (2 + num_channels), config, log)
    counts = num_texels(resolutions).reshape(-1)
    faces = np.repeat(np.arange(counts.size), counts)
    layout = build_face_layout(resolutions)
    ready = for_frames(impostor)
    views = with_novel_views(scene.train, ready, config.novel_views, scene.config.render, train.seed)
    rays = TrainingRays.of(part, views, render, config.fit_rays, train.seed + 2)
    del views, ready  # the pool has what it needs

    def moments(num: int) -> Moments:
        return no_moments(len(faces), num)

    def table(found: Moments) -> HashTables:
        texels = solve_moments(found, faces)
        return HashTables(features=jnp.asarray(texels.reshape(len(faces), -1)), layout=layout)

    found = rays.add_up(partial(moments, 1), add_depths, DEPTHS_SHARE, "depths", part, layout)
    log_lost(int(found.lost) / (DEPTHS_SHARE * config.fit_rays), log)
    depths = table(found)
    del found
    contents = rays.add_up(
        lambda: (moments(1), moments(num_channels)), add_contents, 1.0, "contents", part, layers, depths
    )
    baked = BakedImpostor(
        mesh=mesh,
        depths=depths,
        opacities=table(contents[0]),
        textures=table(contents[1]),
        decoders=decoders,
        decoder_index=part.decoder_index[part.embedding.cells],  # type: ignore[union-attr]
        config=impostor.config,
    )
    del contents  # as large as the textures
    return refine(baked, rays.pool, train, rays.config, config, log=log)


@dataclasses.dataclass(frozen=True)
class TrainingRays:
    """Batches of views' rays through a mesh, and sums over them."""

    pool: PixelPool
    key: jax.Array
    count: int
    size: int  # of a batch
    config: RenderConfig  # with steps and buffers for the mesh
    devices: Mesh

    @staticmethod
    def of(
        impostor: NeuralImpostor, views: PosedImages, config: RenderConfig, count: int, seed: int
    ) -> "TrainingRays":
        """`count` draws from the views' pixels whose rays meet the impostor's mesh."""
        pool, _ = build_pool(impostor.mesh, views.cameras, views.images, config.march, views.backgrounds)
        key, size = jax.random.key(seed), min(FIT_RAYS, count)
        sized = fit_config(impostor, pool, draw_batch(key, 0, pool, size, "white"), config)
        devices = dividing_devices(size, at_most=FIT_DEVICES)
        return TrainingRays(pool, key, count, size, sized, device_mesh(devices))

    def add_up(
        self, start: Callable[[], Any], add: Callable[..., Any], share: float, text: str, *shared: Any
    ) -> Any:
        """`add`'s sums over a share of the rays, on the host; each device adds up its own."""
        compiled = jax.jit(sums_by_device(self.devices, add), static_argnames="config", donate_argnums=0)
        shared = jax.device_put(shared, replicated(self.devices))

        @partial(jax.jit, out_shardings=over_rays(self.devices))
        def no_sums() -> Any:
            return jax.tree.map(lambda x: jnp.broadcast_to(x, (self.devices.size, *x.shape)), start())

        sums, count = no_sums(), -(-round(share * self.count) // self.size)
        for i in tqdm(range(count), desc=text, unit="batch", disable=None):
            batch = jax.device_put(
                draw_batch(self.key, i, self.pool, self.size, "white"), over_rays(self.devices)
            )
            sums = compiled(sums, *shared, batch, config=self.config)
            if i % SYNC_EVERY == 0:
                jax.block_until_ready(sums)
        return jax.tree.map(_total, sums)


def _total(sums: jax.Array) -> np.ndarray:
    """The sum over devices of their own ones, which are given up: all of them would not fit twice."""
    first, *others = (shard.data for shard in sums.addressable_shards)
    total = np.array(first[0])
    for other in others:
        total += np.asarray(other)[0]
    sums.delete()
    return total


def visible_part(
    impostor: NeuralImpostor,
    views: PosedImages,
    render: RenderConfig,
    config: BakeConfig,
    *,
    log: Log = print,
) -> tuple[NeuralImpostor, Seen]:
    """The tets in which something is seen, halved until edges are about `tet_pixels` long; and what is seen.

    Rays do not cross the other tets, whose vertices are kept. Raises ValueError where nothing is seen.
    """
    vertices, tets = world_vertices(impostor.mesh), np.asarray(impostor.mesh.tets)
    longest = np.median(face_pixels(vertices, tets, views))
    halvings = max(0, math.ceil(math.log2(longest / config.tet_pixels)))
    for i in range(halvings + 1):
        count = min(max(LOOK_RAYS, LOOKS_A_TET * len(impostor.mesh.tets)), config.fit_rays)
        rays = TrainingRays.of(impostor, views, render, count, i)
        seen = rays.add_up(partial(nothing_seen, impostor), add_seen, 1.0, "look", impostor)
        log_lost(int(seen.lost) / count, log)
        visible = np.asarray(seen.taken > config.min_opacity * np.maximum(seen.light, 1))
        # An eighth of each tet after a halving, with edges half as long, as long as something is seen in all
        pixels = face_pixels(world_vertices(impostor.mesh), np.asarray(impostor.mesh.tets), views)[visible]
        left, numbers = halvings - i, BASIS * (2 + config.channels)
        megabytes = 8**left * _megabytes(_resolutions(pixels / 2**left, config), numbers)
        log(
            f"something is seen in {visible.sum():,} of {len(visible):,} tets: textures of about "
            f"{megabytes:.0f} MB at most"
        )
        if not visible.any():
            raise ValueError("nothing is seen in any tet; train the impostor before it is baked")
        if i < halvings:
            impostor = subdivide(impostor, 1, visible)
    return only_tets(impostor, visible), seen


def only_tets(impostor: NeuralImpostor, keep: Bool[np.ndarray, " T"]) -> NeuralImpostor:
    """An impostor without gates and paints with some tets of its mesh only. Its vertices and field stay."""
    mesh = impostor.mesh
    vertices, tets = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.tets)
    cells, lambdas = np.arange(len(tets)), np.broadcast_to(np.eye(4), (len(tets), 4, 4))
    if impostor.embedding is not None:
        cells, lambdas = np.asarray(impostor.embedding.cells), np.asarray(impostor.embedding.lambdas)
    within = Embedding(
        cells=jnp.asarray(cells[keep], jnp.int32), lambdas=jnp.asarray(lambdas[keep], mesh.vertices.dtype)
    )
    objects = np.asarray(mesh.object_ids)[keep]
    part = build_in_frame(mesh, vertices, tets[keep], objects, deformed=True)
    return dataclasses.replace(impostor, mesh=part, embedding=within)


def fit_config(
    impostor: NeuralImpostor, pool: PixelPool, probe: RayBatch, config: RenderConfig
) -> RenderConfig:
    """With steps for small tets, and buffers for them."""
    mesh = impostor.mesh
    march = dataclasses.replace(config.march, max_entries_per_ray=pool.entries.slots)
    config = dataclasses.replace(config, march=march, frame_refinement=FIT_REFINEMENT)
    config = dataclasses.replace(refined(config), min_weight=max(config.min_weight, 1e-4) / FIT_REFINEMENT)
    tables = march_tables(mesh)
    return fit_capacities(mesh, tables, probe.rays, config, embedding=impostor.embedding)


def checked_resolutions(
    pixels: Float[np.ndarray, "U 4"], numbers: int, config: BakeConfig, log: Log
) -> Int[np.ndarray, "U 4"]:
    """Texels along an edge of faces of so many pixels. Raises ValueError where all texels, of so many numbers
    each, need too much memory, and says what would not.
    """
    resolutions = _resolutions(pixels, config)
    megabytes = _megabytes(resolutions, numbers)
    log(
        f"{len(resolutions):,} tets with textures of at most {resolutions.max()} texels along an edge; "
        f"{num_texels(resolutions).sum():,} texels: {megabytes:.0f} MB"
    )
    if megabytes > config.max_megabytes:

        def fits(texels_per_pixel: float) -> bool:
            coarser = dataclasses.replace(config, texels_per_pixel=texels_per_pixel)
            return _megabytes(_resolutions(pixels, coarser), numbers) <= config.max_megabytes

        tried = (float(f"{0.9**i * config.texels_per_pixel:.3g}") for i in range(1, 40))
        value = next(filter(fits, tried), None)
        remedy = f"BakeConfig.texels_per_pixel={value} would fit" if value else "raise BakeConfig.tet_pixels"
        raise ValueError(
            f"the textures need {megabytes:.0f} MB, more than BakeConfig.max_megabytes = "
            f"{config.max_megabytes}; {remedy}, or raise the limit"
        )
    return resolutions


def _resolutions(pixels: Float[np.ndarray, "U 4"], config: BakeConfig) -> Int[np.ndarray, "U 4"]:
    texels = np.ceil(config.texels_per_pixel * pixels).astype(np.int64)
    return np.clip(texels, 1, config.max_resolution)


def _megabytes(resolutions: Int[np.ndarray, "U 4"], numbers: int) -> float:
    return float(num_texels(resolutions).sum() * numbers * 4 / 1e6)


def refine(
    baked: BakedImpostor,
    pool: PixelPool,
    train: TrainConfig,
    render: RenderConfig,
    config: BakeConfig,
    *,
    log: Log = print,
) -> BakedImpostor:
    """Textures, and decoders where asked, after some steps of training on whole pixels.

    Takes the place of `baked`, whose textures are given up to the steps: all of them would not fit twice.
    """
    if not config.refine_steps:
        return baked
    key, found = jax.random.key(train.seed + 3), []
    sample = draw_batch(key, 0, pool, train.rays_per_batch, "random")
    lit = int(jax.jit(count_lit, static_argnames="config")(baked, sample, config=render))
    room = math.ceil(LIT_MARGIN * lit / train.rays_per_batch) + 1
    step = partial(refine_step, config=render, lit_per_ray=room)
    compiled = jax.jit(step, donate_argnums=0)
    # Steps consume the state, and read the rest of `baked` beside it.
    state = init_refinement(dataclasses.replace(baked, decoders=jax.tree.map(jnp.copy, baked.decoders)))
    baked = with_tables(baked, {name: table[:0] for name, table in state.tables.items()})
    for i in tqdm(range(config.refine_steps), desc="refine", unit="step", disable=None):
        batch = draw_batch(key, i, pool, train.rays_per_batch, "random")
        rate = config.learning_rate * FINAL_RATE ** (i / config.refine_steps)
        decoder_rate = DECODER_SHARE * rate if config.refine_decoders else 0.0
        state, loss_and_lost = compiled(state, baked, batch, jnp.float32(rate), jnp.float32(decoder_rate))
        found.append(loss_and_lost)
        if i % SYNC_EVERY == 0:
            jax.block_until_ready(loss_and_lost)
    losses, lost = np.array(found).T
    if not is_finite((state.tables, state.decoders)):
        raise FloatingPointError("textures are not finite after refinement; lower BakeConfig.learning_rate")
    first, last = losses[:20].mean(), losses[-20:].mean()
    log(f"refined: loss {first:.2e} to {last:.2e} in {config.refine_steps} steps")
    log_lost(lost.mean(), log)
    return dataclasses.replace(with_tables(baked, state.tables), decoders=state.decoders)


def log_lost(share: float, log: Log) -> None:
    """Say so where more than a few rays were left out."""
    if share > LOST_SHARE:
        log(f"{share:.1%} of the rays crossed more tets, or had more samples, than buffers hold: left out")


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
    middle = vertices[np.unique(tets)].mean(axis=0)
    distance = np.median(np.linalg.norm(views.camera_to_world[:, :3, 3] - middle, axis=1))
    return np.linalg.norm(edges, axis=-1).max(axis=-1) * np.median(views.focal) / distance
