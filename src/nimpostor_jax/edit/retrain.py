"""Two-stage local retraining (Sec. 4.2, Eq. 12): a region of a new impostor learns what an old one shows.

Stage 1 fits the region's tables to the old field's features at random points; stage 2 its tables and its own
decoders to the old impostor's colours along rays that cross the region. Steps are pure, (state, batch) to
(state, loss); everything outside the region keeps its bits (`region.py`).

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
from nimpostor_jax.edit.region import Region, trained_part, with_trained_part
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import is_kept, to_cells
from nimpostor_jax.geometry.locate import LocateTables, locate, locate_tables
from nimpostor_jax.geometry.tetrahedron import corners, cross, signed_volumes
from nimpostor_jax.render.camera import TILE
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.composite import blend_background
from nimpostor_jax.render.occupancy import cells_of, in_occupied_cells
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.step import make_optimizer
from nimpostor_jax.types import NeuralImpostor, Rays, TetMesh

EMPTY_LOG_DENSITY = -8.0  # a density that no sampling step can see
START_BATCHES = 16  # of points, for the first guess of tables and of what is occupied
FINAL_RATE = 0.1  # of the rates, at the end of stage 2
PROBE_RAYS = 4096
PICTURE_WIDTH = 200  # pixels across the cage, of the small pictures in stage 2


@struct.dataclass
class Points:
    """Points in a region's tets, and what the old field has there."""

    tets: Int[Array, " M"]  # of the new mesh
    lambdas: Float[Array, "M 4"]
    features: Float[Array, "M C"]  # 0 where there is no old field
    present: Bool[Array, " M"]  # in the old mesh, and let through by its gates
    occupied: Bool[Array, " M"]  # also by its occupancy


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
    draw = jax.jit(partial(draw_points, count=config.points_per_batch))
    guess, seen = (jnp.zeros_like(new.tables.features),) * 2, None
    for i in range(START_BATCHES):
        points = draw(jax.random.fold_in(key, i), old, source, new, region)
        guess = _add_points(guess, new, points)
        seen = _add_seen(seen, new, points)
    sums, weights = guess
    mean = sums / jnp.where(weights > 0, weights, 1)
    tables = dataclasses.replace(
        new.tables, features=new.tables.features.at[region.entries].set(mean[region.entries])
    )
    new = dataclasses.replace(new, tables=tables, occupied=_seen_or_old(new, region, seen))

    state = RetrainState(part=(part := trained_part(new, region)), optimizer=optimizer.init(part))
    first = jax.jit(partial(feature_step, optimizer=optimizer), donate_argnums=0)
    rates = {"features": config.feature_rate, "decoders": 0.0}
    losses = []
    for i in tqdm(range(config.feature_steps), desc="features", unit="step", disable=None):
        points = draw(jax.random.fold_in(key, START_BATCHES + i), old, source, new, region)
        state, loss = first(state, new, region, points, rates)
        losses.append(loss)
    _log_stage(log, "features", losses)
    rates["decoders"] = config.decoder_rate
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
    key = jax.random.key(config.seed + 1)
    cast = jax.jit(partial(draw_rays, count=config.rays_per_batch))
    probe = cast(key, new, region)
    teacher, student = (_fitted(each, probe, render) for each in (old, new))
    step = jax.jit(partial(render_step, optimizer=optimizer, config=student), donate_argnums=0)
    look = jax.jit(partial(render_rays, config=teacher))
    tables, losses = jax.jit(march_tables)(old.mesh), []
    state = dataclasses.replace(state, optimizer=optimizer.init(state.part))
    for i in tqdm(range(config.render_steps), desc="colours", unit="step", disable=None):
        step_key = jax.random.fold_in(key, i)
        rays = cast(step_key, new, region)
        jitter = jax.random.uniform(jax.random.fold_in(step_key, 1), (config.rays_per_batch,))
        seen = look(old, rays, tables=tables)
        target = jnp.column_stack([seen.color, seen.opacity])
        share = FINAL_RATE ** (i / config.render_steps)
        scaled = {name: share * rate for name, rate in rates.items()}
        state, loss = step(state, new, region, rays, target, jitter, scaled)
        losses.append(loss)
    return state, losses


def _fitted(impostor: NeuralImpostor, probe: Rays, config: RenderConfig) -> RenderConfig:
    """With buffers for such rays."""
    few = jax.tree.map(lambda x: x[:PROBE_RAYS], probe)
    return fit_capacities(impostor.mesh, jax.jit(march_tables)(impostor.mesh), few, config)


def draw_points(
    key: Array,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    *,
    count: int,
) -> Points:
    """Points spread evenly over the region's volume, located in the old mesh (Eq. 12, stage 1)."""
    chosen, lambdas, local = _random_points(key, new.mesh, region, count)
    world = new.mesh.center + new.mesh.scale * local
    if region.sources is None:
        found, places = locate(old.mesh, world, source)
    else:
        found, places = region.sources[chosen], lambdas
    cells, places = to_cells(old.embedding, jnp.maximum(found, 0), places)
    present = (found >= 0) & is_kept(old, jnp.maximum(found, 0), places)
    features = jnp.where((found >= 0)[:, None], field.features(old, cells, places), 0)
    occupied = present if old.occupied is None else present & in_occupied_cells(old.occupied, cells, places)
    return Points(
        tets=region.tets[chosen], lambdas=lambdas, features=features, present=present, occupied=occupied
    )


def draw_rays(key: Array, new: NeuralImpostor, region: Region, *, count: int) -> Rays:
    """World rays from outside to the region, from all sides: small pictures of points in it.

    Rays of one picture are neighbours: entering a cage and marching through it costs them least.
    """
    point_key, side_key = jax.random.split(key)
    mesh = new.mesh
    pictures = -(-count // TILE**2)
    _, _, points = _random_points(point_key, mesh, region, pictures)
    forward, side = jax.random.normal(side_key, (2, pictures, 3), points.dtype)
    forward = _unit(forward)
    right = _unit(cross(forward, side))
    reach = 2 * jnp.max(jnp.linalg.norm(mesh.vertices, axis=1))
    across = (jnp.arange(TILE) - (TILE - 1) / 2) * (reach / PICTURE_WIDTH)
    up = cross(right, forward)
    offsets = across[:, None, None] * right[:, None, None] + across[:, None] * up[:, None, None]
    directions = _unit(reach * forward[:, None, None] + offsets).reshape(-1, 3)[:count]
    origins = jnp.repeat(points - reach * forward, TILE**2, axis=0)[:count]
    return Rays(origins=mesh.center + mesh.scale * origins, directions=directions)


def _unit(vectors: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    return vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)


def _random_points(
    key: Array, mesh: TetMesh, region: Region, count: int
) -> tuple[Int[Array, " M"], Float[Array, "M 4"], Float[Array, "M 3"]]:
    """Which of the region's tets, where in it, and the place in the mesh's frame; even over the volume."""
    choice_key, place_key = jax.random.split(key)
    positions = corners(mesh.vertices, mesh.tets[region.tets])
    volumes = jnp.maximum(signed_volumes(positions), 0)
    chosen = jax.random.choice(choice_key, region.tets.size, (count,), p=volumes / jnp.sum(volumes))
    shares = jax.random.exponential(place_key, (count, 4), positions.dtype)
    lambdas = shares / jnp.sum(shares, axis=1, keepdims=True)
    return chosen.astype(jnp.int32), lambdas, jnp.sum(lambdas[:, :, None] * positions[chosen], axis=1)


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


@jax.jit
def _add_seen(seen: Array | None, new: NeuralImpostor, points: Points) -> Array | None:
    """Parts of cells in which the old field is occupied."""
    if new.occupied is None:
        return None
    cells, places = to_cells(new.embedding, points.tets, points.lambdas)
    found = cells_of(cells, places, points.occupied, *new.occupied.shape)
    return found if seen is None else seen | found


def _seen_or_old(new: NeuralImpostor, region: Region, seen: Array | None) -> Array | None:
    """The parts of the region's cells that were seen; those of others as before."""
    if new.occupied is None or seen is None:
        return new.occupied
    cells = region.tets if new.embedding is None else new.embedding.cells[region.tets]
    return new.occupied.at[cells].set(seen[cells])


def feature_loss(
    part: dict[str, Any], new: NeuralImpostor, region: Region, points: Points
) -> Float[Array, ""]:
    """Stage 1 of Eq. 12: L1 to the old features; where there is no old field, to a density of nothing."""
    new = with_trained_part(new, region, part)
    cells, places = to_cells(new.embedding, points.tets, points.lambdas)
    features = field.features(new, cells, places)
    off = jnp.mean(jnp.abs(features - points.features), axis=1)
    log_density = jnp.log(field.density(new, cells, features))
    haze = jnp.maximum(log_density - EMPTY_LOG_DENSITY, 0)
    return jnp.mean(jnp.where(points.present, off, 0.1 * haze))


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


def render_loss(
    part: dict[str, Any],
    new: NeuralImpostor,
    region: Region,
    rays: Rays,
    target: Float[Array, "R 4"],
    jitter: Float[Array, " R"],
    config: RenderConfig,
) -> Float[Array, ""]:
    """Stage 2 of Eq. 12: squared error of colours over black and over white; overflown rays count as zero."""
    output = render_rays(with_trained_part(new, region, part), rays, config, jitter)
    losses = []
    for shade in (0.0, 1.0):
        background = jnp.full(3, shade, target.dtype)
        color = blend_background(output.color, output.opacity, background)
        expected = blend_background(target[:, :3], target[:, 3], background)
        losses.append(jnp.mean((color - expected) ** 2, axis=1))
    return jnp.mean(jnp.where(output.overflow, 0, losses[0] + losses[1])) / 2


def render_step(
    state: RetrainState,
    new: NeuralImpostor,
    region: Region,
    rays: Rays,
    target: Float[Array, "R 4"],
    jitter: Float[Array, " R"],
    rates: dict[str, Any],
    *,
    optimizer: optax.GradientTransformation,
    config: RenderConfig,
) -> tuple[RetrainState, Float[Array, ""]]:
    """One step of stage 2."""
    loss, gradients = jax.value_and_grad(render_loss)(state.part, new, region, rays, target, jitter, config)
    return _stepped(state, gradients, rates, optimizer), loss


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
