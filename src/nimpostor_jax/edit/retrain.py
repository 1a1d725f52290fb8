"""Two-stage local retraining (Sec. 4.2, Eq. 12): a region of a new impostor learns what an old one shows.

Stage 1 fits the tables and decoders of the region to the old field at random points: its features, and what
they are decoded to; stage 2 to pictures of the old impostor, along rays that cross the region. Steps are
pure, (state, batch) to (state, loss); everything outside the region keeps its bits (`region.py`).

Axes: M points, R rays, C features.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int
from tqdm.auto import tqdm

from nimpostor_jax.config import RenderConfig, RetrainConfig
from nimpostor_jax.edit.boolean import STEP
from nimpostor_jax.edit.region import Region, trained_part, with_trained_part
from nimpostor_jax.edit.teacher import pictures_of
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import is_kept, painted, to_cells
from nimpostor_jax.geometry.locate import LocateTables, locate, locate_tables
from nimpostor_jax.geometry.tetrahedron import corners, signed_volumes
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.occupancy import in_occupied_cells, random_points
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import draw_batch
from nimpostor_jax.train.sharding import data_parallel, device_mesh, over_rays, replicated
from nimpostor_jax.train.step import (
    Metrics,
    Parameters,
    RayBatch,
    loss_gradient,
    make_optimizer,
    trainable,
)
from nimpostor_jax.types import NeuralImpostor, TetMesh

FEATURE_WEIGHT = 0.1  # of features, where opacities and colours count 1
EMPTY_SHARE = 0.1  # of the points in occupied parts, as many in others of the same volume
START_BATCHES = 16  # of points, for the first guess of tables
OCCUPANCY_POINTS = 16  # in each part of a new cell, to find out what is occupied
INWARD = 1e-3  # of the way to the tet's middle
FINAL_RATE = 0.1  # of the rates, at the end of stage 2
PROBE_RAYS = 4096
SYNC_EVERY = 8  # steps that may be under way at once


@struct.dataclass
class Points:
    """Points in a region's tets, and what the old field has there."""

    tets: Int[Array, " M"]  # of the new mesh
    lambdas: Float[Array, "M 4"]
    features: Float[Array, "M C"]  # 0 where there is no old field
    densities: Float[Array, " M"]  # per unit of the new tets' barycentric measure
    directions: Float[Array, "M 3"]  # from all sides
    colors: Float[Array, "M 3"]  # seen from there
    present: Bool[Array, " M"]  # in the old mesh, and let through by its gates


@struct.dataclass
class RetrainState:
    """What a step changes."""

    part: dict[str, Any]  # the region's features and decoders
    optimizer: optax.OptState


def retrain(
    old: NeuralImpostor,
    new: NeuralImpostor,
    region: Region,
    render: RenderConfig,
    config: RetrainConfig,
    log: Callable[[str], None] = print,
) -> NeuralImpostor:
    """The new impostor with its region trained to look like the old one. Host loop around two jitted steps.

    Both stand in the same world. `render` is that of training; buffers are fitted here.
    """
    if not region.tets.size:
        return new
    key, optimizer = jax.random.key(config.seed), make_optimizer()
    source = locate_tables(old.mesh)
    draw = jax.jit(
        partial(draw_points, count=config.points_per_batch, measure=render.density_measure)
    )
    new = dataclasses.replace(new, occupied=occupancy_of(old, source, new, region, config))
    guess = (jnp.zeros_like(new.tables.features),) * 2
    for i in range(START_BATCHES):
        guess = _add_points(guess, new, draw(jax.random.fold_in(key, i), old, source, new, region))
    sums, weights = guess
    mean = sums / jnp.where(weights > 0, weights, 1)
    tables = dataclasses.replace(
        new.tables, features=new.tables.features.at[region.entries].set(mean[region.entries])
    )
    new = dataclasses.replace(new, tables=tables)

    state = RetrainState(part=(part := trained_part(new, region)), optimizer=optimizer.init(part))
    first = jax.jit(partial(feature_step, optimizer=optimizer), donate_argnums=0)
    rates = {"features": config.feature_rate, "decoders": config.decoder_rate}
    losses = []
    for i in tqdm(range(config.feature_steps), desc="features", unit="step", disable=None):
        points = draw(jax.random.fold_in(key, START_BATCHES + i), old, source, new, region)
        state, loss = first(state, new, region, points, rates)
        losses.append(loss)
    _log_stage(log, "features", losses)
    state, losses = _render_stage(old, new, region, render, config, state, optimizer, rates)
    _log_stage(log, "colours", losses)
    return with_trained_part(new, region, state.part)


def _render_stage(
    old: NeuralImpostor,
    new: NeuralImpostor,
    region: Region,
    render: RenderConfig,
    config: RetrainConfig,
    state: RetrainState,
    optimizer: optax.GradientTransformation,
    rates: dict[str, float],
) -> tuple[RetrainState, list[Array]]:
    """Stage 2, its rays split over all local devices."""
    if not config.render_steps:
        return state, []
    pool, key, losses = pictures_of(old, new, region, render, config), jax.random.key(config.seed + 1), []
    probe = draw_batch(key, 0, pool, min(PROBE_RAYS, config.rays_per_batch), "random")
    march = dataclasses.replace(render.march, max_entries_per_ray=pool.entries.holds.shape[1])
    sized = dataclasses.replace(render, march=march)
    sized = fit_capacities(new.mesh, jax.jit(march_tables)(new.mesh), probe.rays, sized)
    gradient, place = loss_gradient, (lambda batch: batch)
    devices = jax.local_devices()
    if len(devices) > 1 and config.rays_per_batch % len(devices) == 0:
        mesh = device_mesh(devices)
        state, new, region, pool = jax.device_put((state, new, region, pool), replicated(mesh))
        gradient, place = data_parallel(mesh), partial(jax.device_put, device=over_rays(mesh))
    step = partial(render_step, optimizer=optimizer, config=sized, gradient=gradient)
    compiled = jax.jit(step, donate_argnums=0)
    state = dataclasses.replace(state, optimizer=optimizer.init(state.part))
    for i in tqdm(range(config.render_steps), desc="colours", unit="step", disable=None):
        batch = place(draw_batch(key, i, pool, config.rays_per_batch, "random"))
        share = FINAL_RATE ** (i / config.render_steps)
        scaled = {name: share * rate for name, rate in rates.items()}
        state, loss = compiled(state, new, region, batch, scaled)
        losses.append(loss)
        if i % SYNC_EVERY == 0:
            jax.block_until_ready(loss)
    return jax.device_put(state, devices[0]), losses


def draw_points(
    key: Array,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    *,
    count: int,
    measure: str,
) -> Points:
    """Points in the region's tets, and what the old field has there (Eq. 12, stage 1).

    Even over the volume; where occupancy is known, ten times as dense in occupied parts. `measure` is that of
    densities: barycentric ones change with the size of tets.
    """
    point_key, side_key = jax.random.split(key)
    mesh = new.mesh
    chosen, lambdas = _random_places(point_key, new, region, count)
    found, cells, places = _in_old(old, source, new, region, chosen, lambdas)
    inside, tets = found >= 0, jnp.maximum(found, 0)
    present = inside & is_kept(old, tets, places)
    features = jnp.where(inside[:, None], field.features(old, cells, places), 0)
    densities = field.density(old, cells, features)
    if measure == "barycentric":
        densities *= _size(mesh, region.tets[chosen]) / _cell_size(old, tets)
    directions = _unit(jax.random.normal(side_key, (count, 3), lambdas.dtype))
    colors = field.radiance(old, cells, features, field.encode_directions(old, directions))
    return Points(
        tets=region.tets[chosen],
        lambdas=lambdas,
        features=features,
        densities=jnp.where(present, densities, 0),
        directions=directions,
        colors=painted(old.paints, tets, places, directions, colors),
        present=present,
    )


def _size(mesh: TetMesh, tets: Int[Array, " M"]) -> Float[Array, " M"]:
    """Edge of a cube of each tet's volume; of flat tets next to nothing, but not nothing."""
    volumes = jnp.abs(signed_volumes(corners(mesh.vertices, mesh.tets[tets])))
    return jnp.cbrt(jnp.maximum(volumes, jnp.finfo(volumes.dtype).tiny))


def _cell_size(impostor: NeuralImpostor, tets: Int[Array, " M"]) -> Float[Array, " M"]:
    """The size that the cells around tets have where these are."""
    size = _size(impostor.mesh, tets)
    if impostor.embedding is None:
        return size
    shares = jnp.abs(jnp.linalg.det(impostor.embedding.lambdas))
    return size / jnp.cbrt(jnp.maximum(shares, jnp.finfo(shares.dtype).tiny))[tets]


def _unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def _random_places(
    key: Array, new: NeuralImpostor, region: Region, count: int
) -> tuple[Int[Array, " M"], Float[Array, "M 4"]]:
    """Which of the region's tets, and where in it."""
    choice_key, place_key = jax.random.split(key)
    volumes = jnp.maximum(signed_volumes(corners(new.mesh.vertices, new.mesh.tets[region.tets])), 0)
    if new.occupied is None:
        chosen = jax.random.choice(choice_key, volumes.size, (count,), p=volumes / jnp.sum(volumes))
        shares = jax.random.exponential(place_key, (count, 4), volumes.dtype)
        return chosen, shares / jnp.sum(shares, axis=1, keepdims=True)
    occupied = new.occupied[_cells_of_region(new, region)]
    weights = (volumes[:, None] * jnp.where(occupied, 1.0, EMPTY_SHARE)).reshape(-1)
    parts = jax.random.choice(choice_key, weights.size, (count,), p=weights / jnp.sum(weights))
    chosen, lambdas = random_points(place_key, parts, occupied.shape[1])
    return chosen, lambdas.astype(volumes.dtype)


def _cells_of_region(new: NeuralImpostor, region: Region) -> Int[Array, " n"]:
    return region.tets if new.embedding is None else new.embedding.cells[region.tets]


@jax.jit
def _add_points(guess: tuple[Array, Array], new: NeuralImpostor, points: Points) -> tuple[Array, Array]:
    """Add up, by table entry, features times their weights, and weights: their ratio is a smoothed field."""
    cells, places = to_cells(new.embedding, points.tets, points.lambdas)

    def encoded(features: Array) -> Array:
        tables = dataclasses.replace(new.tables, features=features)
        return encode(tables, new.config.encoding, cells, places)

    _, pull = jax.vjp(encoded, new.tables.features)
    weight = jnp.broadcast_to(points.present[:, None], points.features.shape).astype(points.features.dtype)
    return guess[0] + pull(points.features * weight)[0], guess[1] + pull(weight)[0]


def occupancy_of(
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    config: RetrainConfig,
) -> Bool[Array, "C parts"] | None:
    """The new impostor's occupancy, with that of the old one in the region's cells. Host loop.

    Every part of every cell is looked into at as many points: what is missed here is never rendered again.
    """
    if new.occupied is None or old.occupied is None:
        return new.occupied
    cells, num_parts = np.asarray(_cells_of_region(new, region)), new.occupied.shape[1]
    everything = np.arange(len(cells) * num_parts)
    found, batch = np.zeros(everything.size, bool), config.points_per_batch
    look = jax.jit(_occupied_at)
    key = jax.random.key(config.seed + 2)
    for _ in range(OCCUPANCY_POINTS):
        for start in range(0, everything.size, batch):
            key, point_key = jax.random.split(key)
            parts = np.resize(everything[start : start + batch], batch)
            hits = np.asarray(look(point_key, old, source, new, region, jnp.asarray(parts, jnp.int32)))
            found[parts] |= hits
    return new.occupied.at[cells].set(jnp.asarray(found.reshape(len(cells), num_parts)))


def _occupied_at(
    key: Array,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    parts: Int[Array, " M"],
) -> Bool[Array, " M"]:
    """Whether the old impostor is occupied at a random point of each part, numbered over the region."""
    assert new.occupied is not None and old.occupied is not None
    chosen, lambdas = random_points(key, parts, new.occupied.shape[1])
    lambdas += INWARD * (0.25 - lambdas)  # many lie on faces, where the tet beyond would be found
    tets, cells, places = _in_old(old, source, new, region, chosen, lambdas.astype(new.mesh.vertices.dtype))
    held = jnp.maximum(tets, 0)
    return (tets >= 0) & in_occupied_cells(old.occupied, cells, places) & is_kept(old, held, places)


def _in_old(
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    chosen: Int[Array, " M"],
    lambdas: Float[Array, "M 4"],
) -> tuple[Int[Array, " M"], Int[Array, " M"], Float[Array, "M 4"]]:
    """Points in the region's tets, by number, in the old mesh: tets (-1 outside), cells, coordinates."""
    mesh = new.mesh
    if region.sources is None:
        positions = corners(mesh.vertices, mesh.tets[region.tets[chosen]])
        world = mesh.center + mesh.scale * jnp.sum(lambdas[:, :, None] * positions, axis=1)
        found, places = locate(old.mesh, world, source)
    else:
        found, places = region.sources[chosen], lambdas
    return found, *to_cells(old.embedding, jnp.maximum(found, 0), places)


def feature_loss(
    part: dict[str, Any], new: NeuralImpostor, region: Region, points: Points
) -> Float[Array, ""]:
    """Stage 1: L1 to the old features (Eq. 12), and to the opacity of a step and the colour that they mean.

    Features of hashed levels cannot be met, since other nodes share their entries; what they mean can.
    """
    new = with_trained_part(new, region, part)
    cells, places = to_cells(new.embedding, points.tets, points.lambdas)
    features = field.features(new, cells, places)
    colors = field.radiance(new, cells, features, field.encode_directions(new, points.directions))
    opacity, target = (
        -jnp.expm1(-STEP * sigma) for sigma in (field.density(new, cells, features), points.densities)
    )
    off_features = jnp.where(points.present, jnp.mean(jnp.abs(features - points.features), axis=1), 0)
    off_colors = target * jnp.mean(jnp.abs(colors - points.colors), axis=1)
    return jnp.mean(FEATURE_WEIGHT * off_features + jnp.abs(opacity - target) + off_colors)


def feature_step(
    state: RetrainState,
    new: NeuralImpostor,
    region: Region,
    points: Points,
    rates: dict[str, Any],
    *,
    optimizer: optax.GradientTransformation,
) -> tuple[RetrainState, Float[Array, ""]]:
    """One step of stage 1."""
    loss, gradients = jax.value_and_grad(feature_loss)(state.part, new, region, points)
    return _stepped(state, gradients, rates, optimizer), loss


def render_step(
    state: RetrainState,
    new: NeuralImpostor,
    region: Region,
    batch: RayBatch,
    rates: dict[str, Any],
    *,
    optimizer: optax.GradientTransformation,
    config: RenderConfig,
    gradient: Callable[..., tuple[Parameters, Metrics]] = loss_gradient,
) -> tuple[RetrainState, Float[Array, ""]]:
    """One step of stage 2 (Eq. 12): training's own loss, of which the region's share is used.

    `gradient` may be a sharded `loss_gradient` (`train.sharding.data_parallel`).
    """
    whole = trainable(with_trained_part(new, region, state.part))
    found, metrics = gradient(whole, new, batch, config)
    gradients = {
        "features": found["features"][region.entries],
        "decoders": jax.tree.map(lambda x: x[region.decoder_sets], found["decoders"]),
    }
    return _stepped(state, gradients, rates, optimizer), metrics["loss"]


def _stepped(
    state: RetrainState, gradients: Any, rates: dict[str, Any], optimizer: optax.GradientTransformation
) -> RetrainState:
    updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.part)
    part = {
        name: jax.tree.map(lambda p, u, rate=rates[name]: p - rate * u, values, updates[name])
        for name, values in state.part.items()
    }
    return RetrainState(part=part, optimizer=optimizer_state)


def _log_stage(log: Callable[[str], None], name: str, losses: list[Array]) -> None:
    if losses:
        first, last = (float(np.mean([float(x) for x in part])) for part in (losses[:20], losses[-20:]))
        log(f"retraining {name}: loss {first:.2e} to {last:.2e} in {len(losses)} steps")
