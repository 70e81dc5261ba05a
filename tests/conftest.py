import gc
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
# Tracing makes millions of objects, and hardly any that are garbage.
gc.set_threshold(100_000, 20, 50)

MAPS = Path("/proc/self/maps")
LONGEST = [
    *("test_experiments", "test_properties", "test_gains", "test_adjoint", "test_gradient"),
    *("test_notebooks", "test_user_plants", "test_boundary_value", "test_times", "test_readme"),
    "test_identification",
]


def pytest_collection_modifyitems(items):
    """Begin with the files that take longest, so that in the end no worker waits for another."""
    names = [*LONGEST, ""]
    items.sort(key=lambda item: names.index(item.path.stem if item.path.stem in names else ""))


@pytest.fixture
def float32():
    """Run a test as an application that never enabled x64."""
    with jax.enable_x64(False):
        yield


@pytest.fixture(autouse=True, scope="module")
def few_memory_maps():
    """Drop compiled programs before their memory maps reach Linux's limit, 65530 a process."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > 30_000:
        eqx.clear_caches()
        jax.clear_caches()
