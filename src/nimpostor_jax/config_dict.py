"""Configs as plain dictionaries and back: for JSON headers, checkpoints and gin's checks."""

import dataclasses
import types
import typing
from typing import Any, Literal, TypeVar

Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """A config as nested plain dictionaries, JSON-ready."""
    return dataclasses.asdict(config)


def from_dict(cls: type[Config], values: dict[str, Any]) -> Config:
    """Inverse of `to_dict`. Raises ValueError for unknown keys and TypeError for wrong types, by name."""
    hints = typing.get_type_hints(cls)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(
            f"{cls.__name__} has no field {unknown[0]!r}; fields: {', '.join(sorted(hints))}"
        )
    built = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]) and isinstance(value, dict):
            value = from_dict(typing.cast(type, hints[name]), value)
        _check_type(cls, name, value, hints[name])
        built[name] = value
    return cls(**built)


def check_types(config: Any) -> None:
    """Raise TypeError naming the first field whose value is not of its annotated type (nested too)."""
    for name, hint in typing.get_type_hints(type(config)).items():
        value = getattr(config, name)
        _check_type(type(config), name, value, hint)
        if dataclasses.is_dataclass(value):
            check_types(value)


def _check_type(cls: type, name: str, value: Any, hint: Any) -> None:
    if _matches(value, hint):
        return
    options = typing.get_args(hint) if typing.get_origin(hint) is Literal else ()
    expected = " or ".join(map(repr, options)) or getattr(hint, "__name__", str(hint))
    raise TypeError(f"{cls.__name__}.{name} must be {expected}, got {value!r} ({type(value).__name__})")


def _matches(value: Any, hint: Any) -> bool:
    origin = typing.get_origin(hint)
    if origin is Literal:
        return value in typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return any(_matches(value, option) for option in typing.get_args(hint))
    if hint is type(None):
        return value is None
    if hint is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, hint)
