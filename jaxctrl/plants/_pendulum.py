"""The inverted pendulum: the smallest nonlinear plant, and smooth everywhere."""

from dataclasses import KW_ONLY
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import parameter, positive, radians


class Pendulum(AbstractArm):
    """Swing a bob on a massless rod by a torque at the pivot.

    dx1/dt = x2,  dx2/dt = g/l sin x1 - mu/(m l^2) x2 + u/(m l^2)        (Li 2006, eq. 4.21-4.22)

    State x = (angle from the upright position [rad], rate [rad/s]), shape (2,); control u, the
    torque [N m], shape (1,). x1 = 0 is upright (unstable), x1 = pi hangs down. The hand is the bob,
    (l sin x1, l cos x1).

    Arguments:
        m: mass of the bob [kg].
        l: length of the rod [m].
        g: gravity [m/s^2]; may be zero or negative.
        friction: mu, viscous friction of the pivot [N m s/rad].
        control_bounds: (lower, upper) [N m], scalars or of shape (1,), or None.

    The defaults are those of Li (2006, section 4.3.1). Raises ValueError, naming the argument, for
    a mass or a length that is not positive, a negative friction, or a wrong shape.
    """

    nx: ClassVar[int] = 2
    nu: ClassVar[int] = 1
    num_joints: ClassVar[int] = 1
    _: KW_ONLY
    m: Float[Array, ""] = eqx.field(converter=partial(positive, "m"), default=1.0)
    l: Float[Array, ""] = eqx.field(converter=partial(positive, "l"), default=1.0)
    g: Float[Array, ""] = eqx.field(converter=partial(parameter, "g"), default=9.8)
    friction: Float[Array, ""] = eqx.field(
        converter=partial(parameter, "friction", minimum=0.0), default=0.01
    )
    control_bounds: Bounds | None = eqx.field(
        converter=partial(as_bounds, shape=(1,)), default=None
    )

    def __call__(self, x, u, t):
        """Return (x2, g/l sin x1 - (mu x2 - u)/(m l^2)), shape (2,)."""
        inertia = self.m * self.l**2
        rate = self.g / self.l * jnp.sin(x[0]) + (u[0] - self.friction * x[1]) / inertia
        return jnp.stack([x[1], rate])

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """The length of the rod [m], shape ()."""
        return self.l

    def hand_of_joints(self, q: Float[Array, "1"]) -> Float[Array, "2"]:
        """Return the position of the bob, (l sin q, l cos q) [m], shape (2,), for q (1,) [rad]."""
        return self.l * jnp.stack([jnp.sin(q[0]), jnp.cos(q[0])])

    def mass_matrix(self, q: Float[Array, "1"]) -> Float[Array, "1 1"]:
        """Return m l^2 [kg m^2], shape (1, 1), whatever the angle q (1,) [rad]."""
        return (self.m * self.l**2)[None, None]

    def joint_torque(self, x: Float[Array, "2"], u: Float[Array, "1"]) -> Float[Array, "1"]:
        """Return the torque at the pivot [N m], shape (1,): the control u (1,) itself."""
        return u

    def at_rest(self, angle: ArrayLike) -> Float[Array, "2"]:
        """Return the state (angle, 0), shape (2,), for an angle from upright [rad].

        Raises ValueError when the angle is not a finite scalar, or can only be in degrees.
        """
        q = radians("angle", angle, self.m)
        return jnp.stack([q, jnp.zeros_like(q)])
