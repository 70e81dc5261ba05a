"""A car whose wheels do not slip: kinematic, and discrete in time."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractPlant
from .._types import Bounds, as_bounds
from ._parameters import like, positive, state_part


class Car(AbstractPlant):
    """Drive a car by the angle and the acceleration of its front wheels, one time step at a call.

    With heading q, speed v, wheel angle w, acceleration a, and f = dt v the way that the front
    wheels roll in a step, in their own direction,

    p' = p + b (cos q, sin q),    b = d + f cos w - sqrt(d^2 - f^2 sin^2 w)
    q' = q + arcsin(f sin w / d),    v' = v + dt a

    State x = (p (2,) [m], q [rad], v [m/s]), shape (4,), with p the middle of the rear axle, which
    rolls straight on by b; control u = (w [rad], a [m/s^2]), shape (2,).

    This is the exact step for a front axle that moves along a line, not an integrator's: the plant
    is discrete. The time step is the `Problem`'s.

    Arguments:
        d: distance between the axles [m].
        control_bounds: (lower, upper), scalars or of shape (2,), or None.

    The equations and defaults are those of Tassa, Mansard & Todorov (2014), "Control-limited
    differential dynamic programming", and of its published program. The next state is not finite
    where |f sin w| > d, the front wheels rolling further in a step than the car is long. Raises
    ValueError, naming the argument, for a distance that is not positive, or a wrong shape.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    d: Float[Array, ""]
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]
    takes_dt: ClassVar[bool] = True

    def __init__(
        self,
        *,
        d: ArrayLike = 2.0,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ):
        self.nx, self.nu, self.discrete = 4, 2, True
        self.d = positive("d", d)
        self.control_bounds = as_bounds(control_bounds, (2,))
        self.nominal_control = jnp.zeros((2,), self.d.dtype)

    def __call__(self, x, u, t, dt):
        """Return the state (4,) after a step of dt [s]."""
        rolled = dt * x[3]
        aside = rolled * jnp.sin(u[0])
        rear = self.d + rolled * jnp.cos(u[0]) - jnp.sqrt(self.d**2 - aside**2)
        heading = x[2] + jnp.arcsin(aside / self.d)
        at = (x[0] + rear * jnp.cos(x[2]), x[1] + rear * jnp.sin(x[2]))
        return jnp.stack([*at, heading, x[3] + dt * u[1]])

    def at_rest(self, position: Float[ArrayLike, "2"], heading: ArrayLike) -> Float[Array, "4"]:
        """Return the state (position (2,) [m], heading [rad], 0), shape (4,).

        Raises ValueError for another shape, or a number that is not finite.
        """
        if jnp.shape(position) != (2,):
            raise ValueError(f"position: got shape {jnp.shape(position)}, wanted (2,)")
        state_part("position", position, self.d, (2,))
        heading = state_part("heading", heading, self.d)
        return jnp.concatenate([like(position, self.d), jnp.stack([heading, 0 * heading])])
