"""Tetrahedral cages and triangle surfaces on disk.

Cages: `.npz` with `V` float64 [n, 3] and `T` int32 [m, 4], and of built ones `settings`, a text;
`.vtk`, `.vtu`, `.msh` through meshio (tetra cells only). Surfaces: whatever trimesh reads.
World units throughout.
"""

import zipfile
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from jaxtyping import Float, Int

from nimpostor_jax.io.atomic import atomic_path
from nimpostor_jax.preprocess.surface import check_exists, load_surface
from nimpostor_jax.preprocess.validate import check_tets, orient_tets

__all__ = ["load_surface", "load_tets", "save_tets"]

_MESHIO_FORMATS = {".vtk": "vtk", ".vtu": "vtu", ".msh": "gmsh"}
_SUFFIXES = (".npz", *_MESHIO_FORMATS)


def load_tets(
    path: str | Path, orient: bool = False
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]:
    """Read a cage; `orient` turns inverted tets around instead of refusing them.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: unknown suffix, unreadable file, missing arrays or tetra cells, or a mesh that
            fails `preprocess.validate.check_tets`.
    """
    path = Path(path)
    check_cage_path(path)
    check_exists(path, "cage")
    vertices, tets = _read_npz(path) if path.suffix == ".npz" else _read_meshio(path)
    shaped = vertices.shape[1:] == (3,) and tets.shape[1:] == (4,)
    if orient and shaped and len(tets) and tets.min() >= 0 and tets.max() < len(vertices):
        tets = orient_tets(tets, vertices)
    check_tets(vertices, tets, str(path))
    return vertices, tets.astype(np.int32)


def save_tets(
    path: str | Path,
    vertices: Float[np.ndarray, "V 3"],
    tets: Int[np.ndarray, "T 4"],
    settings: str | None = None,
) -> None:
    """Write a cage in the format that the suffix names; the file appears whole or not at all.

    `settings` is what it was built with, for `cage_settings`; only `.npz` keeps it.

    Raises:
        ValueError: unknown suffix, or a mesh that fails `preprocess.validate.check_tets`.
    """
    path = Path(path)
    check_cage_path(path)
    check_tets(vertices, tets, str(path))
    vertices, tets = np.asarray(vertices, np.float64), np.asarray(tets, np.int32)
    with atomic_path(path) as partial:
        if path.suffix == ".npz":
            more: dict[str, Any] = {} if settings is None else {"settings": np.array(settings)}
            np.savez(partial, V=vertices, T=tets, **more)
        else:
            mesh = meshio.Mesh(vertices, [("tetra", tets)])
            mesh.write(partial, file_format=_MESHIO_FORMATS[path.suffix])


def cage_settings(path: str | Path) -> str | None:
    """What an `.npz` cage says that it was built with; None where it does not. Errors as `load_tets`."""
    check_exists(Path(path), "cage")
    settings = _arrays(Path(path)).get("settings") if Path(path).suffix == ".npz" else None
    return None if settings is None else str(settings)


def check_cage_path(path: Path) -> None:
    """Raise ValueError for a file name that is no cage's, and for a folder."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder; name a cage file in it")
    if path.suffix not in _SUFFIXES:
        raise ValueError(
            f"{path}: unknown cage format {path.suffix!r}; use one of {', '.join(_SUFFIXES)}"
        )


def _arrays(path: Path) -> dict[str, np.ndarray]:
    # Zip archives only: NumPy takes anything else for a lone array or a pickle.
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path}: not an .npz archive (damaged?); write it with save_tets")
    try:
        with np.load(path, allow_pickle=False) as data:
            return dict(data)
    except (OSError, EOFError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: unreadable arrays ({error}); write it with save_tets") from error


def _read_npz(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]:
    arrays = _arrays(path)
    missing = [key for key in ("V", "T") if key not in arrays]
    if missing:
        raise ValueError(
            f"{path}: no array {missing[0]!r}; it has {', '.join(arrays) or 'none'}; "
            "a cage has V float64 [n, 3] and T int32 [m, 4]"
        )
    vertices, tets = arrays["V"], arrays["T"]
    if not np.issubdtype(tets.dtype, np.integer):
        raise ValueError(f"{path}: T must hold integers, got {tets.dtype}; write it with save_tets")
    if not np.issubdtype(vertices.dtype, np.number) or np.issubdtype(vertices.dtype, np.complexfloating):
        raise ValueError(f"{path}: V must hold numbers, got {vertices.dtype}; write it with save_tets")
    return vertices.astype(np.float64), tets


def _read_meshio(path: Path) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "T 4"]]:
    try:
        mesh = meshio.read(path, file_format=_MESHIO_FORMATS[path.suffix])
    except (
        Exception,
        SystemExit,
    ) as error:  # meshio's readers raise anything, and exit on some input
        raise ValueError(f"{path}: meshio cannot read it as {path.suffix} ({error})") from error
    blocks = [block.data for block in mesh.cells if block.type == "tetra"]
    if not blocks:
        found = ", ".join(sorted({block.type for block in mesh.cells})) or "no cells"
        raise ValueError(f"{path}: no tetra cells in it (it has {found}); export linear tetrahedra")
    return np.asarray(mesh.points, np.float64), np.concatenate(blocks)
