"""Two-stage local retraining (Sec. 4.2, Eq. 12): a region of a new impostor learns what an old one shows.

Tables start from some updates towards the old features (`fit_features`). Stage 1 fits tables and decoders of
the region to the old field at random points, most of them where something is seen (`visibility.py`): its
features, and what they are decoded to; stage 2 to pictures of the old impostor, along rays that cross the
region. Steps are pure, (state, batch) to (state, loss); everything outside the region keeps its bits
(`region.py`).

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
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Float
from tqdm.auto import tqdm

from nimpostor_jax.config import RenderConfig, RetrainConfig
from nimpostor_jax.edit.boolean import STEP
from nimpostor_jax.edit.probe import Points, draw_points, occupancy_of
from nimpostor_jax.edit.region import Region, entries_of, trained_part, with_trained_part
from nimpostor_jax.edit.teacher import pictures_of
from nimpostor_jax.edit.visibility import seen_parts
from nimpostor_jax.encoding.hash_grid import encode
from nimpostor_jax.field import impostor as field
from nimpostor_jax.field.solids import to_cells
from nimpostor_jax.geometry.locate import LocateTables, locate_tables
from nimpostor_jax.render.capacity import fit_capacities
from nimpostor_jax.render.sampling import with_step
from nimpostor_jax.render.traverse import march_tables
from nimpostor_jax.train.pool import PixelPool, draw_batch
from nimpostor_jax.train.sharding import (
    AXIS,
    data_parallel,
    device_mesh,
    dividing_devices,
    over_rays,
    replicated,
)
from nimpostor_jax.train.step import (
    Metrics,
    Parameters,
    RayBatch,
    is_finite,
    loss_gradient,
    make_optimizer,
    trainable,
)
from nimpostor_jax.types import NeuralImpostor

FEATURE_WEIGHT = 0.1  # of features, where opacities and colours count 1
START_UPDATES = 8  # of tables, before stage 1
START_BATCHES = 4  # of points, together in an update
WARMUP_STEPS = 30  # of stage 2, at most a quarter: Adam's first steps, of few gradients, would undo stage 1
FINAL_RATE = 0.1  # of the rates, at the end of stage 2
PROBE_RAYS = 4096
SYNC_EVERY = 8  # steps that may be under way at once


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

    Both stand in the same world. `render` is that of training; buffers are fitted here. Raises
    FloatingPointError where a parameter is not finite afterwards.
    """
    if not region.tets.size:
        return new
    render = with_step(render, new.config.encoding)  # complains now, and not after stage 1
    key, optimizer = jax.random.key(config.seed), make_optimizer()
    source = locate_tables(old.mesh)
    draw = partial(draw_points, measure=render.density_measure)
    new = dataclasses.replace(new, occupied=occupancy_of(old, source, new, region, config))
    if config.render_steps or new.occupied is not None:
        pool = pictures_of(old, new, region, render, config)
        region = dataclasses.replace(region, seen=seen_parts(old, new, region, pool, render, config))
    for i in range(START_UPDATES):
        several = START_BATCHES * config.points_per_batch
        points = draw(jax.random.fold_in(key, i), old, source, new, region, count=several)
        new = fit_features(new, points)
    state = RetrainState(part=(part := trained_part(new, region)), optimizer=optimizer.init(part))
    rates = {"features": config.feature_rate, "decoders": config.decoder_rate}
    state, losses = _feature_stage(old, source, new, region, draw, config, state, optimizer, rates)
    _log_stage(log, "features", losses)
    if config.render_steps:
        state, losses = _render_stage(pool, new, region, render, config, state, optimizer, rates)
        _log_stage(log, "colours", losses)
    if not is_finite(state.part):
        raise FloatingPointError("the region is not finite after retraining; lower RetrainConfig's rates")
    return with_trained_part(new, region, state.part)


def _feature_stage(
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    draw: Callable[..., Points],
    config: RetrainConfig,
    state: RetrainState,
    optimizer: optax.GradientTransformation,
    rates: dict[str, float],
) -> tuple[RetrainState, list[Array]]:
    """Stage 1; each local device draws points of its own."""
    key, losses, devices = jax.random.key(config.seed), [], jax.local_devices()
    mesh = device_mesh(devices)
    fields = jax.device_put((old, source, new, region), replicated(mesh))
    state = jax.device_put(state, replicated(mesh))
    draw = partial(draw, count=max(1, config.points_per_batch // len(devices)))
    step = partial(feature_step, draw=draw, optimizer=optimizer, gradient=on_all_devices(mesh))
    compiled = jax.jit(step, donate_argnums=0)
    for i in tqdm(range(config.feature_steps), desc="features", unit="step", disable=None):
        keys = jax.random.split(jax.random.fold_in(key, START_UPDATES + i), len(devices))
        state, loss = compiled(state, *fields, jax.device_put(keys, over_rays(mesh)), rates)
        losses.append(loss)
        if i % SYNC_EVERY == 0:
            jax.block_until_ready(loss)
    return jax.device_put(state, devices[0]), losses


def _render_stage(
    pool: PixelPool,
    new: NeuralImpostor,
    region: Region,
    render: RenderConfig,
    config: RetrainConfig,
    state: RetrainState,
    optimizer: optax.GradientTransformation,
    rates: dict[str, float],
) -> tuple[RetrainState, list[Array]]:
    """Stage 2, its rays split over all local devices."""
    key, losses = jax.random.key(config.seed + 1), []
    probe = draw_batch(key, 0, pool, min(PROBE_RAYS, config.rays_per_batch), "random")
    march = dataclasses.replace(render.march, max_entries_per_ray=pool.entries.slots)
    sized = dataclasses.replace(render, march=march)
    tables = march_tables(new.mesh)
    sized = fit_capacities(new.mesh, tables, probe.rays, sized, embedding=new.embedding)
    gradient, place = loss_gradient, (lambda batch: batch)
    devices = dividing_devices(config.rays_per_batch)
    if len(devices) > 1:
        mesh = device_mesh(devices)
        state, new, region = jax.device_put((state, new, region), replicated(mesh))
        gradient, place = data_parallel(mesh), partial(jax.device_put, device=over_rays(mesh))
    step = partial(render_step, optimizer=optimizer, config=sized, gradient=gradient)
    compiled = jax.jit(step, donate_argnums=0)
    state = dataclasses.replace(state, optimizer=optimizer.init(state.part))
    warmup = min(WARMUP_STEPS, config.render_steps // 4)
    for i in tqdm(range(config.render_steps), desc="colours", unit="step", disable=None):
        batch = place(draw_batch(key, i, pool, config.rays_per_batch, "random"))
        share = min(1, (i + 1) / (warmup + 1)) * FINAL_RATE ** (i / config.render_steps)
        scaled = {name: share * rate for name, rate in rates.items()}
        state, loss = compiled(state, new, region, batch, scaled)
        losses.append(loss)
        if i % SYNC_EVERY == 0:
            jax.block_until_ready(loss)
    return jax.device_put(state, devices[0]), losses


@jax.jit
def fit_features(new: NeuralImpostor, points: Points) -> NeuralImpostor:
    """A region's tables after one update of simultaneous iterative reconstruction towards the old features.

    Each entry moves by the mean, weighted as it is interpolated, of what is missing at the points around it.
    Converges to weighted least squares; levels without collisions meet the old features.
    """
    cells, places = to_cells(new.embedding, points.tets, points.lambdas)

    def encoded(features: Array) -> Array:
        tables = dataclasses.replace(new.tables, features=features)
        return encode(tables, new.config.encoding, cells, places)

    features = new.tables.features
    found, pull = jax.vjp(encoded, features)
    weight = jnp.broadcast_to(points.present[:, None], found.shape).astype(found.dtype)
    missing, weights = pull((points.features - found) * weight)[0], pull(weight)[0]
    near = weights > 0  # none of the entries of other tets
    moved = jnp.where(near, features + missing / jnp.where(near, weights, 1), features)
    return dataclasses.replace(new, tables=dataclasses.replace(new.tables, features=moved))


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


def feature_gradient(
    part: dict[str, Any],
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    keys: Array,
    *,
    draw: Callable[..., Points],
) -> tuple[dict[str, Any], Float[Array, ""]]:
    """Gradient of `feature_loss` at the points that `draw` finds by the first of the keys, and the loss."""
    points = draw(keys[0], old, source, new, region)
    loss, gradients = jax.value_and_grad(feature_loss)(part, new, region, points)
    return gradients, loss


def on_all_devices(mesh: Mesh) -> Callable[..., tuple[dict[str, Any], Float[Array, ""]]]:
    """`feature_gradient` with a key, and points, for each device of the mesh; the mean over them."""

    def gradient(*arguments: Any, draw: Callable[..., Points]) -> tuple:
        *shared, keys = arguments
        specs = (P(),) * len(shared) + (P(AXIS),)

        @partial(jax.shard_map, mesh=mesh, in_specs=specs, out_specs=P(), check_vma=False)
        def shard(*arguments: Any) -> tuple:
            return jax.lax.pmean(feature_gradient(*arguments, draw=draw), AXIS)

        return shard(*shared, keys)

    return gradient


def feature_step(
    state: RetrainState,
    old: NeuralImpostor,
    source: LocateTables,
    new: NeuralImpostor,
    region: Region,
    keys: Array,
    rates: dict[str, Any],
    *,
    draw: Callable[..., Points],
    optimizer: optax.GradientTransformation,
    gradient: Callable[..., tuple[dict[str, Any], Float[Array, ""]]] = feature_gradient,
) -> tuple[RetrainState, Float[Array, ""]]:
    """One step of stage 1 at points that `draw` finds by `keys`.

    That is one key, or one for each of the devices that `gradient` (`on_all_devices`) knows.
    """
    gradients, loss = gradient(state.part, old, source, new, region, keys, draw=draw)
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
        "features": entries_of(found["features"], region),
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
