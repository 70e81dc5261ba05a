import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.fixture
def float32():
    """Run a test as an application that never enabled x64."""
    with jax.enable_x64(False):
        yield
