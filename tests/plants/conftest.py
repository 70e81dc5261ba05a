import jax
import pytest


@pytest.fixture
def rk4():
    """Integrate dx/dt = f(x) by the classical Runge-Kutta rule; return all states."""

    def integrate(f, x0, dt, num_steps):
        def step(x, _):
            k1 = f(x)
            k2 = f(x + 0.5 * dt * k1)
            k3 = f(x + 0.5 * dt * k2)
            k4 = f(x + dt * k3)
            x = x + dt * (k1 + 2 * k2 + 2 * k3 + k4) / 6
            return x, x

        return jax.jit(lambda x: jax.lax.scan(step, x, length=num_steps)[1])(x0)

    return integrate
