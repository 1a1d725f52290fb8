"""Who may import whom, read from the source; and how long a file may be."""

import ast
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "nimpostor_jax"
MAX_LINES = 400

# The core, lowest first: a layer imports only itself and what stands before it.
CORE = [
    "config", "config_dict", "types", "chunks", "geometry", "encoding", "field", "render", "train", "edit",
]  # fmt: skip
# On top of the core, which imports none of them. Among each other they must not form a cycle.
OUTER = ["preprocess", "io", "export", "lpips", "metrics", "gin_flags", "pipeline"]
# Where a library may be imported: a folder (with a slash at its end) or a file.
CONFINED = {
    "trimesh": ["preprocess/", "io/mesh_files.py"],
    "pytetwild": ["preprocess/"],
    "embreex": ["preprocess/"],
    "pyvista": ["preprocess/"],
    "meshio": ["io/mesh_files.py"],
    "orbax": ["io/checkpoint.py"],
    "pycolmap": ["io/colmap.py"],
    "gin": ["gin_flags.py"],
    "optimistix": ["edit/"],
    "lineax": ["edit/"],
}


class Import(NamedTuple):
    """One imported module and where the import stands (path relative to the package)."""

    path: str
    line: int
    module: str

    def __str__(self) -> str:
        return f"{self.path}:{self.line} imports {self.module}"


def imports_of(source: str, path: str) -> Iterator[Import]:
    """Every import in a file, also those inside functions, as absolute names."""
    folder = ["nimpostor_jax", *Path(path).parent.parts]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for name in node.names:
                yield Import(path, node.lineno, name.name)
        elif isinstance(node, ast.ImportFrom):
            parts = folder[: len(folder) - node.level + 1] if node.level else []
            module = ".".join([*parts, *([node.module] if node.module else [])])
            # `from nimpostor_jax import geometry` names a layer only in its second half.
            for name in node.names:
                yield Import(path, node.lineno, f"{module}.{name.name}")


def layer_of_file(path: str | Path) -> str:
    return Path(path).parts[0].removesuffix(".py")


def layer_of_import(item: Import) -> str | None:
    """The layer that an import reaches: None for another package, "" for our top level."""
    head, *rest = item.module.split(".")
    if head != "nimpostor_jax":
        return None
    return rest[0] if rest and rest[0] in CORE + OUTER else ""


def misdirected(imports: list[Import]) -> list[str]:
    """Imports that point from a core layer to a later one, to an outer one or to the top level."""
    found = []
    for item in imports:
        source, target = layer_of_file(item.path), layer_of_import(item)
        if target is None or source == "__init__" or source == target:
            continue
        allowed = CORE[: CORE.index(source)] if source in CORE else CORE + OUTER
        if target not in allowed:
            found.append(str(item))
    return found


def escaped(imports: list[Import]) -> list[str]:
    """Imports of a confined library outside its place."""
    found = []
    for item in imports:
        places = CONFINED.get(item.module.split(".")[0])
        if places is not None and not any(item.path.startswith(place) for place in places):
            found.append(f"{item} (allowed: {', '.join(places)})")
    return found


def all_imports() -> list[Import]:
    return [
        item
        for path in sorted(PACKAGE.rglob("*.py"))
        for item in imports_of(path.read_text(), path.relative_to(PACKAGE).as_posix())
    ]


def test_every_module_belongs_to_a_layer():
    layers = {layer_of_file(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py")}
    assert layers <= {"__init__", *CORE, *OUTER}


def test_imports_point_down():
    assert misdirected(all_imports()) == []


def test_outer_layers_form_no_cycle():
    graph: dict[str, set[str]] = {name: set() for name in OUTER}
    for item in all_imports():
        source, target = layer_of_file(item.path), layer_of_import(item)
        if source in OUTER and target in OUTER and source != target:
            graph[source].add(target)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"cycle: {' <- '.join(error.args[1])}")


def test_libraries_stay_in_their_place():
    assert escaped(all_imports()) == []


@pytest.mark.parametrize("folder", ["src", "experiments", "tests"])
def test_files_stay_short(folder):
    lengths = {path: len(path.read_text().splitlines()) for path in (ROOT / folder).rglob("*.py")}
    assert lengths
    assert {str(path): n for path, n in lengths.items() if n > MAX_LINES} == {}


# The checks themselves


@pytest.mark.parametrize(
    "path, source, wrong",
    [
        ("geometry/a.py", "from nimpostor_jax.config import MarchConfig", False),
        ("geometry/a.py", "from nimpostor_jax.geometry.b import f", False),
        ("geometry/a.py", "from . import b", False),
        ("geometry/a.py", "from ..types import Rays", False),
        ("render/a.py", "import nimpostor_jax.field.decoder", False),
        ("io/a.py", "from nimpostor_jax import metrics", False),
        ("__init__.py", "from nimpostor_jax.io.images import load", False),
        ("geometry/a.py", "import jax.numpy as jnp", False),
        ("config.py", "from nimpostor_jax.types import Rays", True),
        ("geometry/a.py", "from nimpostor_jax.render.camera import rays", True),
        ("geometry/a.py", "from nimpostor_jax import render", True),
        ("geometry/a.py", "from .. import render", True),
        ("geometry/a.py", "from ..render.camera import rays", True),
        ("geometry/a.py", "import nimpostor_jax", True),
        ("train/a.py", "from nimpostor_jax.io.images import load", True),
        ("train/a.py", "def f():\n    import nimpostor_jax.metrics", True),
        ("edit/a.py", "from nimpostor_jax.gin_flags import load_config", True),
        ("train/a.py", "from nimpostor_jax.edit.deform import deform", True),
    ],
)
def test_misdirected_imports_are_found(path, source, wrong):
    assert bool(misdirected(list(imports_of(source, path)))) == wrong


@pytest.mark.parametrize(
    "path, source, wrong",
    [
        ("preprocess/embree.py", "import trimesh", False),
        ("io/mesh_files.py", "from trimesh import load", False),
        ("io/checkpoint.py", "import orbax.checkpoint as ocp", False),
        ("gin_flags.py", "import gin", False),
        ("io/images.py", "import trimesh", True),
        ("io/mesh_files.py", "import pytetwild", True),
        ("export/viewer.py", "def f():\n    import meshio", True),
        ("train/loop.py", "from orbax import checkpoint", True),
        ("config.py", "import gin.config", True),
        ("render/preprocess/a.py", "import embreex", True),
    ],
)
def test_escaped_libraries_are_found(path, source, wrong):
    assert bool(escaped(list(imports_of(source, path)))) == wrong
