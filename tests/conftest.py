"""JAX on the CPU with two virtual devices, and what all tests share."""

import os
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Compiled programs, shared by all workers, by the scripts that tests start, and by the next run.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "xla")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

# XLA's older emitters compile in half of the time, and tests mostly compile.
if version("jaxlib").startswith("0.10."):  # a flag that others do not know would end the process
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_use_fusion_emitters=false".strip()

import jax
import numpy as np
import pytest

jax.config.update(
    "jax_num_cpu_devices", 2
)  # for the tests of data parallelism and of frames on several devices


CORE = {"geometry", "encoding", "field", "render", "train", "edit", "pipeline"}


@pytest.fixture(autouse=True)
def quick_compilation(request):
    """The core's tests run small programs a few times: compiling them optimised would take most of the time.

    A test that asks for the fixture `optimized` gets what users get.
    """
    quick = request.path.parent.name in CORE and "optimized" not in request.fixturenames
    jax.config.update("jax_disable_most_optimizations", quick)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Free each module's compiled programs: they are thousands of memory maps, of which Linux allows 65,530.

    Beyond, compiling ends in a segmentation fault.
    """
    yield
    jax.clear_caches()


@pytest.fixture
def optimized():
    """Compile this test's own programs (not those that other tests have compiled) as users do."""


@pytest.fixture
def x64():
    """float64 for the test's own computations."""
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture
def on_accelerators(monkeypatch):
    """What accelerators compute, computed here: whole buffers at once, running sums as trees.

    A function that has been traced before keeps to what it was traced for.
    """
    jax.devices()  # found before the name changes
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


@pytest.fixture
def rng():
    return np.random.default_rng(0)
