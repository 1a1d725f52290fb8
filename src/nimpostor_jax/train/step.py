"""One training step: pure, (state, batch) -> (state, metrics), no device and no named axis inside."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int

from nimpostor_jax.config import RenderConfig, TrainConfig
from nimpostor_jax.render.composite import blend_background
from nimpostor_jax.render.renderer import render_rays
from nimpostor_jax.render.traverse import Entries
from nimpostor_jax.train.losses import photometric
from nimpostor_jax.types import NeuralImpostor, Rays

Parameters = dict[str, Any]
Metrics = dict[str, Array]


@struct.dataclass
class RayBatch:
    """Rays in world space with what they should see. Axis R comes first everywhere: shard it at will."""

    rays: Rays
    target: Float[Array, "R 4"]  # premultiplied colour and opacity
    background: Float[Array, "R 3"]
    jitter: Float[Array, " R"]
    entries: Entries | None = None  # into the cage, where it stays as it is


@struct.dataclass
class TrainState:
    """What a step changes. Batches are functions of seed and step, so nothing else need be saved."""

    parameters: Parameters  # tables' features and decoders
    optimizer: optax.OptState
    step: Int[Array, ""]


def trainable(impostor: NeuralImpostor) -> Parameters:
    """The impostor's trained arrays."""
    return {"features": impostor.tables.features, "decoders": impostor.decoders}


def with_parameters(impostor: NeuralImpostor, parameters: Parameters) -> NeuralImpostor:
    """The impostor with its trained arrays replaced."""
    tables = dataclasses.replace(impostor.tables, features=parameters["features"])
    return dataclasses.replace(impostor, tables=tables, decoders=parameters["decoders"])


def make_optimizer() -> optax.GradientTransformation:
    """Adam's direction (Instant-NGP's constants); the step applies the learning rate."""
    return optax.scale_by_adam(b1=0.9, b2=0.99, eps=1e-15)


def learning_rate(config: TrainConfig, progress: float, step: int) -> float:
    """Warm-up by steps, then exponential decay over `progress` in [0, 1]."""
    warmup = min(1.0, (step + 1) / (config.warmup_steps + 1))
    decay = (config.final_learning_rate / config.learning_rate) ** min(max(progress, 0.0), 1.0)
    return config.learning_rate * warmup * decay


def init_state(impostor: NeuralImpostor, optimizer: optax.GradientTransformation) -> TrainState:
    """The state before the first step."""
    parameters = trainable(impostor)
    return TrainState(
        parameters=parameters, optimizer=optimizer.init(parameters), step=jnp.zeros((), jnp.int32)
    )


def render_loss(
    parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig
) -> tuple[Float[Array, ""], Metrics]:
    """Photometric loss of a batch over its backgrounds, and what the driver watches."""
    impostor = with_parameters(impostor, parameters)
    output = render_rays(impostor, batch.rays, config, batch.jitter, entries=batch.entries)
    color = blend_background(output.color, output.opacity, batch.background)
    target = blend_background(batch.target[:, :3], batch.target[:, 3], batch.background)
    loss = photometric(color, target, output.overflow)
    flags = {"overflow": output.overflow, "coarsened": output.coarsened}
    return loss, {"loss": loss} | {name: jnp.mean(flag.astype(loss.dtype)) for name, flag in flags.items()}


def loss_gradient(
    parameters: Parameters, impostor: NeuralImpostor, batch: RayBatch, config: RenderConfig
) -> tuple[Parameters, Metrics]:
    """Gradient of `render_loss` and its metrics, all means over rays."""
    return jax.grad(render_loss, has_aux=True)(parameters, impostor, batch, config)


def train_step(
    state: TrainState,
    impostor: NeuralImpostor,
    batch: RayBatch,
    rate: Float[Array, ""],
    *,
    config: RenderConfig,
    optimizer: optax.GradientTransformation,
    gradient: Callable[..., tuple[Parameters, Metrics]] = loss_gradient,
) -> tuple[TrainState, Metrics]:
    """One optimiser step at learning rate `rate`.

    `impostor` gives cage and layout; its own tables and decoders are not read. `gradient` may be a sharded
    `loss_gradient` (`sharding.data_parallel`).
    """
    gradients, metrics = gradient(state.parameters, impostor, batch, config)
    updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.parameters)
    parameters = jax.tree.map(lambda p, u: p - rate * u, state.parameters, updates)
    return TrainState(parameters=parameters, optimizer=optimizer_state, step=state.step + 1), metrics
