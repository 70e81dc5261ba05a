"""One time step of a plant: explicit Euler, Runge-Kutta, or the plant's own next state."""

import abc
from typing import Any, ClassVar

import equinox as eqx
from jaxtyping import Array, ArrayLike, Float

from ._plant import AbstractPlant


class AbstractIntegrator(eqx.Module):
    """A rule that takes a plant one step further.

    Attributes:
        holds: whether the control is held over the step, True by default: two half steps under the
            same control are then a finer rule for the same step.
    """

    holds: ClassVar[bool] = True

    @abc.abstractmethod
    def __call__(
        self,
        plant: AbstractPlant,
        x: Float[Array, " nx"],
        u: Float[Array, " nu"],
        t: ArrayLike,
        dt: ArrayLike,
    ) -> Float[Array, " nx"]:
        """Return the state (nx,) at time t + dt [s] from x (nx,) at t, with u (nu,)."""


class Euler(AbstractIntegrator):
    """Explicit Euler, x' = x + dt f(x, u, t): first order, and what Li (2006) uses throughout."""

    def __call__(self, plant, x, u, t, dt):
        """Return x + dt f(x, u, t), shape (nx,)."""
        return x + dt * plant(x, u, t)


class RK4(AbstractIntegrator):
    """The classical fourth-order Runge-Kutta rule, with the control held over the step."""

    def __call__(self, plant, x, u, t, dt):
        """Return x + dt (k1 + 2 k2 + 2 k3 + k4) / 6, shape (nx,)."""
        k1 = plant(x, u, t)
        k2 = plant(x + 0.5 * dt * k1, u, t + 0.5 * dt)
        k3 = plant(x + 0.5 * dt * k2, u, t + 0.5 * dt)
        k4 = plant(x + dt * k3, u, t + dt)
        return x + dt * (k1 + 2 * k2 + 2 * k3 + k4) / 6


class NextState(AbstractIntegrator):
    """The rule of a discrete plant: the plant returns the next state itself.

    One whose next state depends on the length of the step is called with it: `plant(x, u, t, dt)`,
    if it says `takes_dt = True`, as `jc.plants.Car` does.
    """

    def __call__(self, plant: Any, x, u, t, dt):
        """Return plant(x, u, t) or plant(x, u, t, dt), shape (nx,)."""
        return plant(x, u, t, dt) if getattr(plant, "takes_dt", False) else plant(x, u, t)
