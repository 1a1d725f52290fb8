"""Deformations on disk: JSON objects such as {"name": "bend", "c": 0.5}; other keys are ignored."""

import inspect
import json
from pathlib import Path
from typing import Any

import numpy as np

from nimpostor_jax.edit.deform import FAMILIES, SpaceMap

_SHAPES: dict[str, tuple[int, ...]] = {
    "rotation": (3, 3),
    "translation": (3,),
    "center": (3,),
    "rotation_vector": (3,),
}  # all others: numbers


def load_deformation(path: str | Path) -> SpaceMap:
    """The function of space (world coordinates, `edit.deform`) that a JSON file names.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a JSON object, unknown name, missing parameter, or a parameter that is not
        finite or
            has another shape than the family's.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such deformation file")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:  # malformed JSON or not UTF-8
        raise ValueError(f"{path}: not readable as JSON ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f'{path}: expected an object such as {{"name": "bend", "c": 0.5}}')
    name = content.get("name")
    if not isinstance(name, str) or name not in FAMILIES:
        known = ", ".join(sorted(FAMILIES))
        raise ValueError(f"{path}: unknown deformation {name!r}; known: {known}")
    family = FAMILIES[name]
    parameters = list(inspect.signature(family).parameters)
    missing = [key for key in parameters if key not in content]
    if missing:
        raise ValueError(
            f"{path}: deformation {name!r} lacks parameter {missing[0]!r}; it takes {', '.join(parameters)}"
        )
    values = {key: _parameter(path, key, content[key]) for key in parameters}
    try:
        return family(**values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _parameter(path: Path, key: str, value: Any) -> Any:
    shape = _SHAPES.get(key, ())
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    is_number = not isinstance(value, (bool, str)) and array.shape == shape and np.isfinite(array).all()
    if not is_number:
        expected = f"finite numbers of shape {list(shape)}" if shape else "a finite number"
        raise ValueError(f"{path}: parameter {key!r} must be {expected}, got {value!r}")
    return array if shape else float(value)
