"""One training step: pure, (state, batch) -> (state, metrics), no device and no named axis inside."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.chunks import map_used
from nimpostor_jax.config import RenderConfig, SamplerConfig, TrainConfig
from nimpostor_jax.field import impostor as field
from nimpostor_jax.render.composite import blend_background
from nimpostor_jax.render.occupancy import cells_of, num_cells, random_points
from nimpostor_jax.render.renderer import render_samples
from nimpostor_jax.render.traverse import Entries
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.types import NeuralImpostor, Rays

Parameters = dict[str, Any]
Metrics = dict[str, Array]

B1, B2, EPSILON = 0.9, 0.99, 1e-15  # Adam's, as Instant-NGP has them
DECAY = 0.95  # of a cell's optical thickness between updates
MIN_THICKNESS = 0.01  # of a step, below which a cell counts as empty
NEVER = -(1 << 30)  # step of a cell that no ray has seen
MAX_CELLS = 1 << 19  # of all tets: more would see too few rays before they are forgotten


@struct.dataclass
class RayBatch:
    """Rays in world space with what they should see. Axis R comes first everywhere: shard it at will."""

    rays: Rays
    target: Float[Array, "R 4"]  # premultiplied colour and opacity
    background: Float[Array, "R 3"]
    jitter: Float[Array, " R"]
    entries: Entries | None = None  # into the cage, where it stays as it is
    opacity_cost: Float[Array, " R"] | None = None  # added to the loss by opacity


@struct.dataclass
class TrainState:
    """What a step changes. Batches are functions of seed and step, so nothing else need be saved."""

    parameters: Parameters  # tables' features and decoders
    optimizer: optax.OptState
    step: Int[Array, ""]
    last_seen: Int[Array, "T cells"] | None = None  # step at which a cell last contributed to a pixel
    thickness: Float[Array, "T cells"] | None = None  # optical, of a step in the cell; slowly forgotten


def trainable(impostor: NeuralImpostor) -> Parameters:
    """The impostor's trained arrays. Raises ValueError where its levels are merged."""
    field.check_unmerged(impostor)
    return {"features": impostor.tables.features, "decoders": impostor.decoders}


def with_parameters(impostor: NeuralImpostor, parameters: Parameters) -> NeuralImpostor:
    """The impostor with its trained arrays replaced."""
    tables = dataclasses.replace(impostor.tables, features=parameters["features"])
    return dataclasses.replace(impostor, tables=tables, decoders=parameters["decoders"])


def make_optimizer() -> optax.GradientTransformation:
    """Adam's direction; the step applies the learning rate."""
    return optax.scale_by_adam(b1=B1, b2=B2, eps=EPSILON)


def learning_rate(config: TrainConfig, progress: float, step: int) -> float:
    """Warm-up by steps, then exponential decay over `progress` in [0, 1]."""
    warmup = min(1.0, (step + 1) / (config.warmup_steps + 1))
    decay = (config.final_learning_rate / config.learning_rate) ** min(max(progress, 0.0), 1.0)
    return config.learning_rate * warmup * decay


def init_state(
    impostor: NeuralImpostor,
    optimizer: optax.GradientTransformation,
    cells_per_edge: int = 0,
    occupancy: Literal["seen", "density"] = "seen",
) -> TrainState:
    """The state before the first step. Of large cages, tets are cut into fewer cells than asked for.

    An impostor that has been trained already goes on with its own cells.
    """
    parameters, last_seen, thickness = trainable(impostor), None, None
    if impostor.occupied is not None:
        # Not weakly typed, or the second step would compile again.
        last_seen = jnp.where(impostor.occupied, jnp.int32(0), jnp.int32(NEVER))
    elif cells_per_edge:
        num_tets = impostor.decoder_index.shape[0]
        while cells_per_edge > 1 and num_tets * num_cells(cells_per_edge) > MAX_CELLS:
            cells_per_edge //= 2
        last_seen = jnp.zeros((num_tets, num_cells(cells_per_edge)), jnp.int32)
    if occupancy == "density" and last_seen is not None:
        thickness = jnp.where(last_seen == NEVER, 0, jnp.full(last_seen.shape, 2 * MIN_THICKNESS))
        last_seen = None
    return TrainState(
        parameters=parameters,
        optimizer=optimizer.init(parameters),
        step=jnp.zeros((), jnp.int32),
        last_seen=last_seen,
        thickness=thickness,
    )


def occupied_cells(state: TrainState, forget_after: int) -> Bool[Array, "T cells"] | None:
    """Cells that some ray saw within the last `forget_after` steps, or that have an optical thickness."""
    if state.thickness is not None:
        return state.thickness > jnp.minimum(MIN_THICKNESS, jnp.mean(state.thickness))
    return None if state.last_seen is None else state.last_seen + forget_after > state.step


def render_loss(
    parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig
) -> tuple[Float[Array, ""], Metrics]:
    """Photometric loss of a batch over its backgrounds, and what the driver watches.

    Where the impostor has an occupancy grid, also the cells that contributed, `seen_cells` [T, C] > 0.
    """
    impostor = with_parameters(impostor, parameters)
    output, samples = render_samples(impostor, batch.rays, config, batch.jitter, entries=batch.entries)
    color = blend_background(output.color, output.opacity, batch.background)
    target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
    loss = photometric(color, target, output.overflow)
    flags = {"overflow": output.overflow, "coarsened": output.coarsened}
    metrics = {"loss": loss} | {name: jnp.mean(flag.astype(loss.dtype)) for name, flag in flags.items()}
    if impostor.occupied is not None:
        used = samples.deltas > 0
        seen = cells_of(samples.tet_ids, samples.lambdas, used, *impostor.occupied.shape)
        metrics["seen_cells"] = seen.astype(loss.dtype)  # a mean over devices is as good as "any"
    if batch.opacity_cost is not None:
        loss += jnp.mean(jnp.where(output.overflow, 0, batch.opacity_cost * output.opacity))
    return loss, metrics


def loss_gradient(
    parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig
) -> tuple[Parameters, Metrics]:
    """Gradient of `render_loss` and its metrics, all means over rays."""
    return jax.grad(render_loss, has_aux=True)(parameters, impostor, batch, config)


@jax.jit
def is_finite(parameters: Any) -> Bool[Array, ""]:
    """Whether all numbers of a pytree are finite: once one is not, training has none that is."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(parameters)]))


def train_step(
    state: TrainState,
    impostor: NeuralImpostor,
    batch: RayBatch,
    rate: Float[Array, ""],
    *,
    config: RenderConfig,
    optimizer: optax.GradientTransformation,
    forget_after: int = TrainConfig().forget_after,
    gradient: Callable[..., tuple[Parameters, Metrics]] = loss_gradient,
) -> tuple[TrainState, Metrics]:
    """One optimiser step at learning rate `rate`.

    `impostor` gives cage and layout; its own tables and decoders are not read. Cells that no ray has seen for
    `forget_after` steps are left out. `gradient` may be a sharded `loss_gradient` (`sharding.data_parallel`).
    """
    impostor = dataclasses.replace(impostor, occupied=occupied_cells(state, forget_after))
    gradients, metrics = gradient(state.parameters, impostor, batch, config)
    updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.parameters)
    parameters = jax.tree.map(lambda p, u: p - rate * u, state.parameters, updates)
    last_seen = state.last_seen
    seen = metrics.pop("seen_cells", None)
    if last_seen is not None and seen is not None:
        last_seen = jnp.where(seen > 0, state.step, last_seen)
    state = dataclasses.replace(
        state,
        parameters=parameters,
        optimizer=optimizer_state,
        step=state.step + 1,
        last_seen=last_seen,
    )
    return state, metrics


def update_thickness(
    key: Array, state: TrainState, impostor: NeuralImpostor, sampler: SamplerConfig
) -> TrainState:
    """Look into half of the cells, the odd or the even ones, at a random point (Instant-NGP, Appendix C).

    A cell's thickness is the larger of what is found and of what has been known, a little forgotten. For
    `measure` euclidean and density in the same measure: a step then is as long in all cells.
    """
    if state.thickness is None:
        return state
    impostor = with_parameters(impostor, state.parameters)
    num_tets, cells = state.thickness.shape
    key = jax.random.fold_in(key, state.step)
    turn = jax.random.randint(key, (), 0, 2)
    chosen = jnp.minimum(2 * jnp.arange((num_tets * cells + 1) // 2) + turn, num_tets * cells - 1)
    tet_ids, lambdas = random_points(key, chosen, cells)
    features = field.features(impostor, tet_ids, lambdas)
    found = map_used(
        lambda shared, part: field.density(shared, *part),
        field.only_decoders(impostor),
        (tet_ids, features),
        jnp.int32(chosen.size),
    )
    known = DECAY * state.thickness.reshape(-1)
    thickness = known.at[chosen].max(sampler.step * found).reshape(num_tets, cells)
    return dataclasses.replace(state, thickness=thickness)
