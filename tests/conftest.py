"""JAX on the CPU with two virtual devices, and what all tests share."""

import os

os.environ.setdefault("JAX_PLATFORMS", "cpu")
if "PYTEST_XDIST_WORKER" in os.environ:  # workers share the cores: more threads each only slow all of them down
    flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false"

import jax
import numpy as np
import pytest

jax.config.update("jax_num_cpu_devices", 2)  # for the tests of data parallelism and of frames on several devices


@pytest.fixture
def x64():
    """float64 for the test's own computations."""
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@pytest.fixture
def rng():
    return np.random.default_rng(0)
