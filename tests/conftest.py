import os
import subprocess
import sys
from pathlib import Path

# Most of the tests' time is XLA's, compiling: without its optimisations and its newer emitters it
# takes a quarter of that, and costs agree to 13 digits. An XLA_FLAGS of your own, "" too, is left
# as it is. XLA ends a process that has a flag it does not know: hence the child.
if "XLA_FLAGS" not in os.environ:
    quick = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
    known = subprocess.run(
        [sys.executable, "-c", "import jax; jax.devices()"],
        env={**os.environ, "XLA_FLAGS": quick},
        capture_output=True,
    )
    os.environ["XLA_FLAGS"] = quick if known.returncode == 0 else quick.split()[0]

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
