"""Checkpoints of a run (orbax): any pytree, bit for bit, with the configuration that it belongs to.

A checkpoint is for resuming: it is restored into a state of the same structure, and a state of
another configuration or cage is refused with the first difference. To hand a trained impostor on,
see `impostor_file`.
"""

import contextlib
import dataclasses
import hashlib
import json
import logging
import operator
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from nimpostor_jax.config import ExperimentConfig
from nimpostor_jax.config_dict import from_dict, to_dict
from nimpostor_jax.types import TetMesh

_KEPT_STEPS = 2
_FORMAT_VERSION = 1
# What gives the saved arrays their meaning. Other fields steer a run and may change at a resume.
_BINDING_FIELDS = ("impostor", "render.density_measure", "render.integrate", "render.directions")


def save_checkpoint(
    folder: str | Path,
    step: int,
    state: Any,
    config: ExperimentConfig,
    *,
    metadata: Mapping[str, Any] | None = None,
) -> None:
    """Save a pytree as `folder/<step>` and keep the last two steps; returns when it is on disk.

    Leaves are arrays of any dtype, typed PRNG keys or Python numbers. `metadata` is anything that
    JSON can hold. The step appears whole or not at all. Saving the latest step again replaces it
    (if that is cut short, the step before it remains). Raises ValueError where the folder holds a
    later step, or for metadata that JSON cannot hold.
    """
    folder = Path(folder).absolute()
    arrays = {name: _leaf_to_numpy(leaf) for name, leaf in _named_leaves(state).items()}
    record = {
        "version": _FORMAT_VERSION,
        "config": to_dict(config),
        "metadata": dict(metadata or {}),
        "arrays": {name: [list(a.shape), a.dtype.name] for name, a in arrays.items()},
    }
    try:
        json.dumps(record)
    except (TypeError, ValueError) as error:
        raise ValueError(f"checkpoint metadata must be JSON values ({error})") from error
    with _manager(folder, writable=True) as manager:
        latest = manager.latest_step()
        if latest is not None and latest > step:
            raise ValueError(
                f"{folder} already holds step {latest}, later than {step}; "
                "resume from it or use another folder"
            )
        if latest == step:
            manager.delete(step)
        saved = manager.save(
            step,
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(_nonempty(arrays)), config=ocp.args.JsonSave(record)
            ),
        )
        if not saved:
            raise RuntimeError(f"orbax did not save step {step} in {folder}")


def restore_checkpoint(
    folder: str | Path,
    state_like: Any,
    config: ExperimentConfig,
    step: int | None = None,
    *,
    metadata: Mapping[str, Any] | None = None,
) -> tuple[Any, int]:
    """Restore a step (None: the latest) into the structure, dtypes and placement of `state_like`.

    Raises FileNotFoundError where there is no such checkpoint, and ValueError naming the first
    difference and both values where the checkpoint has another impostor configuration or another
    way to render it (`_BINDING_FIELDS`), other arrays, another cage (the tets of every `TetMesh` in
    the state), or other values of the entries given in `metadata` (see `cage_fingerprint`). Nothing
    is read beyond the small record before these checks, but the tets.
    """
    folder = Path(folder).absolute()
    step = _existing_step(folder, step)
    where = f"checkpoint {folder / str(step)}"
    record = _read_record(folder, step)
    _require_same_config(where, _saved_config(where, record), config)
    for name, value in (metadata or {}).items():
        saved = record["metadata"].get(name)
        if saved != json.loads(json.dumps(value)):
            raise ValueError(f"{where} has another {name}: saved {saved!r}, now {value!r}")
    leaves = _named_leaves(state_like)
    _require_same_arrays(where, record["arrays"], leaves)

    empty = {
        name: np.empty(shape, _dtype(dtype)) for name, (shape, dtype) in record["arrays"].items()
    }
    try:
        with _manager(folder) as manager:
            composite = ocp.args.Composite(state=ocp.args.StandardRestore(_nonempty(empty)))
            arrays = {**empty, **manager.restore(step, args=composite).state}
    except Exception as error:  # orbax and tensorstore document no common base class
        raise ValueError(
            f"{where} is damaged ({type(error).__name__}); "
            "delete this folder to resume from an earlier step"
        ) from error
    restored = [_leaf_from_numpy(arrays[name], like) for name, like in leaves.items()]
    state = jax.tree.unflatten(jax.tree.structure(state_like), restored)
    _require_same_tets(where, state, state_like)
    return state, step


def latest_step(folder: str | Path) -> int | None:
    """The last complete step in `folder`; None where there is none, or no folder."""
    folder = Path(folder).absolute()
    if not folder.is_dir():
        return None
    with _manager(folder) as manager:
        return manager.latest_step()


def load_config(folder: str | Path, step: int | None = None) -> ExperimentConfig:
    """The configuration of a step (None: the latest). Raises FileNotFoundError or ValueError."""
    folder = Path(folder).absolute()
    step = _existing_step(folder, step)
    return _saved_config(f"checkpoint {folder / str(step)}", _read_record(folder, step))


def load_metadata(folder: str | Path, step: int | None = None) -> dict[str, Any]:
    """The metadata of a step (None: the latest). Raises FileNotFoundError or ValueError."""
    folder = Path(folder).absolute()
    return _read_record(folder, _existing_step(folder, step))["metadata"]


def cage_fingerprint(mesh: TetMesh) -> dict[str, Any]:
    """Identifies a cage by its tets and vertices, in JSON values.

    For a state without the mesh: give `metadata={"cage": cage_fingerprint(mesh)}` when saving and
    when restoring.
    """
    digest = hashlib.sha256()
    for values, dtype in (
        (mesh.tets, "<i4"), (mesh.vertices, "<f4"), (mesh.center, "<f4"), (mesh.scale, "<f4"),
    ):  # fmt: skip
        digest.update(np.ascontiguousarray(np.asarray(values).astype(dtype)).tobytes())
    return {
        "num_vertices": mesh.vertices.shape[0],
        "num_tets": mesh.tets.shape[0],
        "sha256": digest.hexdigest()[:16],
    }


@contextlib.contextmanager
def _manager(folder: Path, writable: bool = False) -> Iterator[ocp.CheckpointManager]:
    """An orbax manager that works synchronously and keeps its progress notes to itself."""
    logger = logging.getLogger("absl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)  # failures arrive as exceptions
    try:
        if writable:
            options = ocp.CheckpointManagerOptions(
                max_to_keep=_KEPT_STEPS,
                enable_async_checkpointing=False,
                cleanup_tmp_directories=True,
            )
        else:
            options = ocp.CheckpointManagerOptions(read_only=True)
        with ocp.CheckpointManager(folder, options=options) as manager:
            yield manager
    finally:
        logger.setLevel(level)


def _existing_step(folder: Path, step: int | None) -> int:
    steps: list[int] = []
    if folder.is_dir():
        with _manager(folder) as manager:
            steps = sorted(manager.all_steps())
    if not steps:
        raise FileNotFoundError(
            f"there is no checkpoint in {folder}; train first, or name another folder"
        )
    if step is not None and step not in steps:
        raise FileNotFoundError(f"{folder} has no checkpoint of step {step}; it has {steps}")
    return steps[-1] if step is None else step


def _read_record(folder: Path, step: int) -> dict[str, Any]:
    where = f"checkpoint {folder / str(step)}"
    try:
        with _manager(folder) as manager:
            record = manager.restore(
                step, args=ocp.args.Composite(config=ocp.args.JsonRestore())
            ).config
        version = record["version"]
    except Exception as error:  # orbax documents no common base class
        raise ValueError(
            f"{where} is damaged, or not of this package ({type(error).__name__})"
        ) from error
    if version > _FORMAT_VERSION:
        raise ValueError(
            f"{where} has format {version}, newer than {_FORMAT_VERSION}; update nimpostor-jax"
        )
    return record


def _named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their dotted path, in the pytree's order."""
    paths = jax.tree_util.tree_flatten_with_path(tree)[0]
    named = {
        jax.tree_util.keystr(p, simple=True, separator=".") or "state": leaf for p, leaf in paths
    }
    if len(named) != len(paths):
        raise ValueError(
            "two leaves of the state have the same dotted path; rename a key that has a dot"
        )
    return named


def _nonempty(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Without the arrays that have no elements: orbax refuses them, and the record tells all."""
    return {name: array for name, array in arrays.items() if array.size}


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _leaf_to_numpy(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _leaf_from_numpy(value: np.ndarray, like: Any) -> Any:
    """The value as the kind of leaf that `like` is; on its devices where it is bound to some."""
    if _is_key(like):
        return jax.random.wrap_key_data(jnp.asarray(value), impl=jax.random.key_impl(like))
    if isinstance(like, (bool, int, float)):
        return type(like)(value.item())
    if isinstance(like, (np.ndarray, np.generic)):
        return value
    return (
        jax.device_put(value, like.sharding)
        if getattr(like, "committed", False)
        else jnp.array(value)
    )


def _dtype(name: str) -> np.dtype:
    return np.dtype(jnp.dtype(name))  # jax knows bfloat16 and its like


def _saved_config(where: str, record: dict[str, Any]) -> ExperimentConfig:
    try:
        return from_dict(ExperimentConfig, record["config"])
    except (LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error


def _require_same_config(where: str, saved: ExperimentConfig, current: ExperimentConfig) -> None:
    for field in _BINDING_FIELDS:
        get = operator.attrgetter(field)
        difference = _first_difference(get(saved), get(current), field)
        if difference is not None:
            name, old, new = difference
            raise ValueError(
                f"{where} is of another configuration: {name} is {old!r} there and {new!r} here; "
                "use the saved configuration or another folder"
            )


def _first_difference(saved: Any, current: Any, name: str) -> tuple[str, Any, Any] | None:
    """Dotted name and both values of the first unequal leaf of two configs of one type."""
    if not dataclasses.is_dataclass(current):
        return None if saved == current else (name, saved, current)
    for field in dataclasses.fields(current):
        old, new = getattr(saved, field.name), getattr(current, field.name)
        found = _first_difference(old, new, f"{name}.{field.name}")
        if found is not None:
            return found
    return None


def _require_same_arrays(where: str, saved: dict[str, Any], leaves: dict[str, Any]) -> None:
    for name, leaf in leaves.items():
        data = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        data = data if hasattr(data, "dtype") else np.asarray(data)
        expected = [list(data.shape), np.dtype(data.dtype).name]
        if saved.get(name) != expected:
            there = "missing" if name not in saved else _describe(saved[name])
            raise ValueError(
                f"{where} is of another configuration or cage: array {name} is {there} there and "
                f"{_describe(expected)} here"
            )
    extra = [name for name in saved if name not in leaves]
    if extra:
        raise ValueError(
            f"{where} is of another configuration or cage: array {extra[0]} is "
            f"{_describe(saved[extra[0]])} there and missing here"
        )


def _describe(shape_and_dtype: list[Any]) -> str:
    shape, dtype = shape_and_dtype
    return f"{dtype}{shape}"


def _require_same_tets(where: str, state: Any, state_like: Any) -> None:
    for saved, current in zip(_meshes(state), _meshes(state_like), strict=True):
        if isinstance(current.tets, jax.ShapeDtypeStruct):
            continue  # only shapes were given
        differs = np.flatnonzero((np.asarray(saved.tets) != np.asarray(current.tets)).any(axis=1))
        if differs.size:
            tet = int(differs[0])
            raise ValueError(
                f"{where} is of another cage: {differs.size} tets differ (first: tet {tet}, "
                f"vertices {saved.tets[tet].tolist()} there and {current.tets[tet].tolist()} here)"
            )


def _meshes(tree: Any) -> list[TetMesh]:
    nodes = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, TetMesh))
    return [node for node in nodes if isinstance(node, TetMesh)]
