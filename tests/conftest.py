import os
from pathlib import Path

# Most of the tests' time is XLA's, compiling: without its optimisations it takes half of that, and
# costs agree to 13 digits. An XLA_FLAGS of your own, "" too, is left as it is.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")

import equinox as eqx
import jax
import pytest

jax.config.update("jax_enable_x64", True)

MAPS = Path("/proc/self/maps")


@pytest.fixture
def float32():
    """Run a test as an application that never enabled x64."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(autouse=True)
def few_memory_maps():
    """Drop compiled programs before their memory maps reach Linux's limit, 65530 a process."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > 20_000:
        eqx.clear_caches()
        jax.clear_caches()
