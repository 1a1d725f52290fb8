"""The two small decoders of Eq. 7: density from features, colour from features and view direction.

Parameters are plain dictionaries; every leaf has a leading axis over decoder sets, so that a locally edited
region can own its copy (Sec. 4.2). Axes: D decoder sets, M points.
"""

import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from nimpostor_jax.config import ImpostorConfig

MAX_LOG_DENSITY = 40.0  # exp(40) is opaque in any scene and far from float32's overflow
MAX_LOG_GRADIENT = 15.0
Parameters = dict[str, Any]


@jax.custom_jvp
def truncated_exp(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """exp(x), bounded; its gradient is bounded earlier, so that one dense sample cannot blow up a step."""
    return jnp.exp(jnp.minimum(x, MAX_LOG_DENSITY))


@truncated_exp.defjvp
def _truncated_exp_jvp(primals, tangents):  # type: ignore[no-untyped-def]
    (x,), (dx,) = primals, tangents
    return truncated_exp(x), jnp.exp(jnp.clip(x, -MAX_LOG_GRADIENT, MAX_LOG_GRADIENT)) * dx


def init_decoders(key: Array, config: ImpostorConfig, num_sets: int = 1) -> Parameters:
    """He-initialised weights, zero biases; the last density bias is the config's (space starts thin)."""
    decoder = config.decoder
    features = config.encoding.feature_dim
    hidden = decoder.appearance_hidden
    widths = {
        "density": [features, decoder.density_hidden, 1],
        "appearance": [features + decoder.sh_degree**2, *[hidden] * decoder.appearance_layers, 3],
    }
    parameters: Parameters = {}
    for name, sizes in widths.items():
        layers = []
        for fan_in, fan_out in itertools.pairwise(sizes):
            key, layer_key = jax.random.split(key)
            weight = jax.random.normal(layer_key, (num_sets, fan_in, fan_out)) * (2 / fan_in) ** 0.5
            layers.append({"weight": weight, "bias": jnp.zeros((num_sets, fan_out))})
        parameters[name] = layers
    parameters["density"][-1]["bias"] += decoder.density_bias
    return parameters


def num_decoder_sets(parameters: Parameters) -> int:
    """D."""
    return parameters["appearance"][0]["weight"].shape[0]


def reorder_features(parameters: Parameters, order: Int[np.ndarray, " C"]) -> Parameters:
    """Decoders of the same functions for position features in another order: `features[:, order]`."""

    def reordered(layers: list) -> list:
        weight = layers[0]["weight"]
        first = jnp.concatenate([weight[:, order], weight[:, len(order) :]], axis=1)
        return [layers[0] | {"weight": first}, *layers[1:]]

    return parameters | {name: reordered(layers) for name, layers in parameters.items()}


def decode_density(
    parameters: Parameters, features: Float[Array, "M C"], decoder_ids: Int[Array, " M"]
) -> Float[Array, " M"]:
    """Density D_sigma(f_p) >= 0 per unit of the density measure (Eq. 7)."""
    return truncated_exp(apply_layers(parameters["density"], features, decoder_ids)[..., 0])


def decode_appearance(
    parameters: Parameters,
    features: Float[Array, "M C"],
    direction_features: Float[Array, "M E"],
    decoder_ids: Int[Array, " M"],
) -> Float[Array, "M 3"]:
    """Colour D_r(f_p + f_d) in [0, 1] (Eq. 7)."""
    inputs = jnp.concatenate([features, direction_features], axis=-1)
    return jax.nn.sigmoid(apply_layers(parameters["appearance"], inputs, decoder_ids))


def principal_channels(
    parameters: Parameters, products: Float[np.ndarray, "D C C"], count: int
) -> tuple[Parameters, list]:
    """Appearance decoders of `count` channels (at most) instead of C features; the layer that makes them.

    The first layer is linear: of features f it sees f W, and nearly all of that lies in the principal
    directions V over the features' second moments `products`, f W = (f W V) V^T. Host code.
    """
    first, *others = parameters["appearance"]
    size, weights = products.shape[1], np.asarray(first["weight"], np.float64)
    count = min(count, size, weights.shape[2])
    makers, takers = [], []
    for weight, moment in zip(weights, np.asarray(products, np.float64), strict=True):
        seen = weight[:size]
        directions = np.linalg.eigh(seen.T @ moment @ seen)[1][:, ::-1][:, :count]
        makers.append(seen @ directions)
        takers.append(np.concatenate([directions.T, weight[size:]]))
    dtype = first["weight"].dtype
    maker = {"weight": jnp.asarray(np.stack(makers), dtype), "bias": jnp.zeros((len(makers), count), dtype)}
    return {"appearance": [first | {"weight": jnp.asarray(np.stack(takers), dtype)}, *others]}, [maker]


def apply_layers(
    layers: list, inputs: Float[Array, "M C"], decoder_ids: Int[Array, " M"]
) -> Float[Array, "M out"]:
    """An MLP with ReLU between its layers, of each point's own decoder set."""
    num_sets = layers[0]["weight"].shape[0]
    if num_sets == 1:
        return _mlp(layers, 0, inputs)
    width = layers[-1]["bias"].shape[1]
    outputs = jnp.zeros((inputs.shape[0], width), jnp.result_type(inputs, layers[-1]["bias"]))
    for chosen in range(num_sets):
        outputs = _where_used(layers, chosen, inputs, decoder_ids[:, None] == chosen, outputs)
    return outputs


def _where_used(
    layers: list,
    chosen: int,
    inputs: Float[Array, "M C"],
    here: Bool[Array, "M 1"],
    outputs: Float[Array, "M out"],
) -> Float[Array, "M out"]:
    """A set costs nothing for points of which none uses it: neighbours mostly use the same."""
    return jax.lax.cond(
        jnp.any(here), lambda: jnp.where(here, _mlp(layers, chosen, inputs), outputs), lambda: outputs
    )


def _mlp(layers: list, chosen: int, inputs: Float[Array, "M C"]) -> Float[Array, "M out"]:
    for layer in layers[:-1]:
        inputs = jax.nn.relu(inputs @ layer["weight"][chosen] + layer["bias"][chosen])
    return inputs @ layers[-1]["weight"][chosen] + layers[-1]["bias"][chosen]
