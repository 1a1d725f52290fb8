"""Scenes that ship with the package, and the one place that turns an argument into a scene
folder."""

import importlib.resources
from pathlib import Path

BUILTIN_SCENES = ("fluffy_ball",)


def builtin_scene(name: str) -> Path:
    """Folder of a built-in scene in nerf-synthetic layout; ValueError names those that exist."""
    if name not in BUILTIN_SCENES:
        raise ValueError(f"no built-in scene {name!r}; there are: {', '.join(BUILTIN_SCENES)}")
    folder = Path(str(importlib.resources.files("nimpostor_jax").joinpath("data", name)))
    if not folder.is_dir():
        raise FileNotFoundError(
            f"{folder} is missing from this installation; reinstall nimpostor-jax"
        )
    return folder


def resolve_scene(text: str | Path) -> Path:
    """A folder as given, else the built-in scene of that name.

    Raises NotADirectoryError for a file, FileNotFoundError for what is neither; it lists the
    built-in names.
    """
    path = Path(text).expanduser()
    if path.is_dir():
        return path
    if path.exists():
        raise NotADirectoryError(f"{path} is a file; give the scene's folder")
    if str(text) in BUILTIN_SCENES:
        return builtin_scene(str(text))
    raise FileNotFoundError(
        f"{text} is neither a folder nor a built-in scene; built-in: {', '.join(BUILTIN_SCENES)}"
    )
