"""A hand without an arm, moved by its jerk: the plant of purely kinematic models."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import shape_of
from .._integrate import AbstractIntegrator
from .._plant import AbstractHand
from .._types import Bounds
from ._parameters import state_part


class FreeHand(AbstractHand):
    """Move a point in the plane by its jerk, d^3 e/dt^3.

    State x = (position [m], velocity [m/s], acceleration [m/s^2]), shape (6,). Control u, shape
    (6,), the three Legendre coefficients (2,) of the jerk within a step [m/s^3]: its mean c_0, and
    c_1, c_2 of

        d^3 e/dt^3 = c_0 + c_1 (2 s - 1) + c_2 (6 s^2 - 6 s + 1),  0 <= s <= 1 through the step.

    The path of least jerk is a polynomial of fifth degree between via-points (Flash & Hogan 1985),
    so that with `PolynomialJerk` nothing is lost to the grid. Other integrators hold the mean.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(self):
        self.nx, self.nu, self.discrete = 6, 6, False
        self.control_bounds = None
        self.nominal_control = jnp.zeros((6,))

    def __call__(self, x, u, t):
        """Return (velocity, acceleration, mean jerk), shape (6,)."""
        return jnp.concatenate([x[2:], u[:2]])

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """No limit: infinite [m], shape ()."""
        return jnp.asarray(jnp.inf, self.nominal_control.dtype)

    def hand(self, x: Float[Array, "6"]) -> Float[Array, "2"]:
        """Return the position [m], shape (2,); raises ValueError when x is not of shape (6,)."""
        _check(x)
        return x[:2]

    def hand_velocity(self, x: Float[Array, "6"]) -> Float[Array, "2"]:
        """Return the velocity [m/s], shape (2,); raises ValueError when x is not of shape (6,)."""
        _check(x)
        return x[2:4]

    def at_rest(self, position: ArrayLike, velocity: ArrayLike = 0.0) -> Float[Array, "6"]:
        """Return the state, shape (6,), for a position (2,) [m] and a velocity [m/s], no push.

        Raises ValueError when either is not finite, or not of shape (2,).
        """
        like = self.nominal_control
        if shape_of(position) != (2,):
            raise ValueError(f"position: shape {shape_of(position)}, wanted (2,)")
        e, v = (
            state_part("position", position, like, (2,)),
            state_part("velocity", velocity, like, (2,)),
        )
        return jnp.concatenate([e, v, jnp.zeros_like(e)])


def _check(x) -> None:
    if jnp.shape(x) != (6,):
        raise ValueError(
            f"x: got shape {jnp.shape(x)}, wanted (6,); a trajectory goes through jax.vmap"
        )


class PolynomialJerk(AbstractIntegrator):
    """The exact step of a `FreeHand`, whose jerk is a polynomial of second degree within it."""

    holds: ClassVar[bool] = False

    def __call__(self, plant, x, u, t, dt):
        """Return the state (6,) after a step, by integrating the jerk three times."""
        e, v, a = x[:2], x[2:4], x[4:]
        c0, c1, c2 = u[:2], u[2:4], u[4:]
        return jnp.concatenate(
            [
                e + dt * v + dt**2 / 2 * a + dt**3 * (c0 / 6 - c1 / 12 + c2 / 60),
                v + dt * a + dt**2 * (c0 / 2 - c1 / 6),
                a + dt * c0,
            ]
        )
