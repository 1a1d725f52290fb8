"""A trained impostor in one `.npz` file: arrays by their path in the pytree, and a JSON header.

The file is for handing on: the pytree is rebuilt from it alone, without pickles and without orbax.
"""

import dataclasses
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from nimpostor_jax import types
from nimpostor_jax.config import ImpostorConfig
from nimpostor_jax.config_dict import from_dict, to_dict
from nimpostor_jax.field.impostor import check_unmerged
from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.types import BakedImpostor, NeuralImpostor

Impostor = TypeVar("Impostor", NeuralImpostor, BakedImpostor)

_FORMAT = "nimpostor_jax.NeuralImpostor"
_FORMAT_VERSION = 2  # 1 had one array of features a level
_HEADER, _ROOT = "header.json", "impostor"
# What NumPy, zipfile and zlib raise for a file that is cut short, changed, or something else.
_DAMAGE = (
    OSError, EOFError, ValueError, LookupError, TypeError, AttributeError, NotImplementedError,
    zipfile.BadZipFile, zlib.error,
)  # fmt: skip
# The only classes that a file can name.
_RECORDS: dict[str, Any] = {
    name: cls
    for name, cls in vars(types).items()
    if dataclasses.is_dataclass(cls) and cls.__module__ == types.__name__
}


def save_impostor(path: str | Path, impostor: NeuralImpostor | BakedImpostor) -> None:
    """Write an impostor, baked or not, as a self-contained `.npz`: arrays by their path, and a JSON header.

    The header holds the format's version, the configuration and the pytree's structure. The file appears
    whole or not at all. Raises ValueError for another suffix, merged levels, and decoders with anything but
    dicts with text keys, lists, tuples, None and arrays.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{path}: the suffix of an impostor file must be .npz")
    if isinstance(impostor, NeuralImpostor):
        check_unmerged(impostor)
    arrays: dict[str, np.ndarray] = {}
    structure = _pack(impostor, _ROOT, arrays)
    header = {
        "format": _FORMAT,
        "version": _FORMAT_VERSION,
        "config": to_dict(impostor.config),
        "structure": structure,
    }
    encoded = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with atomic_path(path) as partial:
        np.savez(partial, **{_HEADER: encoded}, **arrays)  # type: ignore[arg-type]


def load_impostor(path: str | Path) -> NeuralImpostor:
    """Read what `save_impostor` wrote; every array has the bits and dtype that it had.

    Raises FileNotFoundError for a missing file, ValueError for one that is not an impostor file, holds a
    baked impostor, is damaged, is of another version, or holds float64 while jax runs without
    `jax_enable_x64`.
    """
    return _load(path, NeuralImpostor)


def load_baked(path: str | Path) -> BakedImpostor:
    """As `load_impostor`, of a baked one."""
    return _load(path, BakedImpostor)


def _load(path: str | Path, cls: type[Impostor]) -> Impostor:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"impostor file {path} does not exist")
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
        header = json.loads(stored.pop(_HEADER).tobytes())
        version = header["version"]
        recognised = header["format"] == _FORMAT and isinstance(version, int)
    except _DAMAGE as error:
        raise ValueError(
            f"{path} is damaged, or not an impostor file ({type(error).__name__})"
        ) from error
    if not recognised:
        raise ValueError(f"{path} is not an impostor file")
    if version != _FORMAT_VERSION:
        remedy = "update nimpostor-jax" if version > _FORMAT_VERSION else "train and save it again"
        raise ValueError(f"{path} has format {version}, not {_FORMAT_VERSION}; {remedy}")
    try:
        config = from_dict(ImpostorConfig, header["config"])
        impostor = _unpack(header["structure"], stored, config)
    except (LookupError, TypeError, ValueError) as error:
        remedy = "if an earlier version wrote it, train or bake again"
        raise ValueError(f"{path} cannot be read as an impostor: {error}; {remedy}") from error
    if not isinstance(impostor, cls):
        raise ValueError(f"{path} holds a {type(impostor).__name__}, not a {cls.__name__}")
    return impostor


def _pack(node: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Put the arrays below `node` into `arrays`; return the structure as JSON values."""
    if node is None:
        return None
    if type(node) in _RECORDS.values():
        names = [field.name for field in dataclasses.fields(node)]
        result: dict[str, Any] = {"record": type(node).__name__}
        if type(node) in (NeuralImpostor, BakedImpostor):
            names.remove("config")
            if path != _ROOT:  # one that a gate looks into; the file's own is in the header
                result["config"] = to_dict(node.config)
        fields = {name: _pack(getattr(node, name), f"{path}/{name}", arrays) for name in names}
        return result | {"fields": fields}
    if isinstance(node, dict):
        if not all(isinstance(key, str) and "/" not in key for key in node):
            raise ValueError(f"{path}: keys must be text without '/', got {list(node)}")
        return {"dict": {key: _pack(part, f"{path}/{key}", arrays) for key, part in node.items()}}
    if isinstance(node, (list, tuple)):
        if type(node) not in (list, tuple):
            raise ValueError(f"{path}: {type(node).__name__} cannot be saved; use a plain tuple")
        return {
            type(node).__name__: [_pack(part, f"{path}/{i}", arrays) for i, part in enumerate(node)]
        }
    if type(node) in (bool, int):
        return {"number": node}
    if callable(node):
        raise ValueError(f"{path} is a function, which no file can hold; sample it on a grid (GridSolid)")
    is_array = isinstance(node, (jax.Array, np.ndarray))
    if not is_array or jnp.issubdtype(node.dtype, jax.dtypes.extended):
        raise ValueError(f"{path}: expected an array, got {type(node).__name__}")
    value = np.asarray(node)
    arrays[path] = value
    return {"array": path, "dtype": value.dtype.name}


def _unpack(spec: Any, arrays: dict[str, np.ndarray], config: ImpostorConfig) -> Any:
    """Inverse of `_pack`."""
    if spec is None:
        return None
    if "array" in spec:
        dtype = np.dtype(jnp.dtype(spec["dtype"]))
        value = arrays[spec["array"]]
        # NumPy files know no bfloat16: it comes back as two raw bytes.
        value = value.view(dtype) if value.dtype.kind == "V" else value
        placed = jnp.asarray(value)
        if placed.dtype != dtype:
            raise ValueError(f"{spec['array']} is {dtype}; set jax_enable_x64 to load it")
        return placed
    if "record" in spec:
        cls = _RECORDS[spec["record"]]
        configured = cls in (NeuralImpostor, BakedImpostor)
        if "config" in spec:
            config = from_dict(ImpostorConfig, spec["config"])
        fields = {name: _unpack(part, arrays, config) for name, part in spec["fields"].items()}
        return cls(**fields, config=config) if configured else cls(**fields)
    if "number" in spec:
        return spec["number"]
    if "dict" in spec:
        return {key: _unpack(part, arrays, config) for key, part in spec["dict"].items()}
    kind = list if "list" in spec else tuple
    return kind(_unpack(part, arrays, config) for part in spec[kind.__name__])
