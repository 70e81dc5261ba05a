"""A pole on a cart that is pushed along a rail: two joints and one actuator."""

from dataclasses import KW_ONLY
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import parameter, positive, radians, state_part


class CartPole(AbstractArm):
    """Push a cart along a rail, with a bob on a massless rod that hangs from it and turns freely.

    (M + m) a + m l (b cos q2 - w^2 sin q2) = u,    l b + a cos q2 + g sin q2 = 0

    with a and b the accelerations of the cart [m/s^2] and of the angle [rad/s^2], w the rate of the
    angle. There is no friction.

    State x = (cart's position q1 [m], angle q2 [rad], velocity [m/s], rate w [rad/s]), shape (4,);
    control u, the force on the cart [N], shape (1,). q2 = 0 hangs down, q2 = pi is upright; a
    positive angle swings the bob towards positive positions. The hand is the bob,
    (q1 + l sin q2, -l cos q2).

    Arguments:
        M: mass of the cart [kg].
        m: mass of the bob [kg].
        l: length of the rod [m].
        g: gravity [m/s^2]; may be zero or negative.
        control_bounds: (lower, upper) [N], scalars or of shape (1,), or None.

    The defaults are those of RobotZoo.jl, the models of ALTRO's benchmarks (Howell, Jackson &
    Manchester 2019). Raises ValueError, naming the argument, for a mass or a length that is not
    positive, or a wrong shape.
    """

    nx: ClassVar[int] = 4
    nu: ClassVar[int] = 1
    num_joints: ClassVar[int] = 2
    _: KW_ONLY
    M: Float[Array, ""] = eqx.field(converter=partial(positive, "M"), default=1.0)
    m: Float[Array, ""] = eqx.field(converter=partial(positive, "m"), default=0.2)
    l: Float[Array, ""] = eqx.field(converter=partial(positive, "l"), default=0.5)
    g: Float[Array, ""] = eqx.field(converter=partial(parameter, "g"), default=9.81)
    control_bounds: Bounds | None = eqx.field(
        converter=partial(as_bounds, shape=(1,)), default=None
    )

    def __call__(self, x, u, t):
        """Return (dq, ddq), shape (4,)."""
        s, c = jnp.sin(x[1]), jnp.cos(x[1])
        pull = self.m * s * (self.l * x[3] ** 2 + self.g * c)
        cart = (u[0] + pull) / (self.M + self.m * s**2)
        return jnp.stack([x[2], x[3], cart, -(cart * c + self.g * s) / self.l])

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """Infinite, shape (): the rail has no end."""
        return jnp.full_like(self.l, jnp.inf)

    def hand_of_joints(self, q: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the bob's position (q1 + l sin q2, -l cos q2) [m], shape (2,), for q (2,)."""
        return jnp.stack([q[0] + self.l * jnp.sin(q[1]), -self.l * jnp.cos(q[1])])

    def mass_matrix(self, q: Float[Array, "2"]) -> Float[Array, "2 2"]:
        """Return [[M + m, m l cos q2], [m l cos q2, m l^2]], shape (2, 2), for q (2,)."""
        across = self.m * self.l * jnp.cos(q[1])
        both = self.M + self.m
        return jnp.stack([jnp.stack([both, across]), jnp.stack([across, self.m * self.l**2])])

    def joint_torque(self, x: Float[Array, "4"], u: Float[Array, "1"]) -> Float[Array, "2"]:
        """Return the force on the cart [N] and the torque on the rod [N m], (u, 0), shape (2,)."""
        return jnp.stack([u[0], jnp.zeros_like(u[0])])

    def at_rest(self, position: ArrayLike = 0.0, angle: ArrayLike = 0.0) -> Float[Array, "4"]:
        """Return the state (position [m], angle [rad], 0, 0), shape (4,).

        Raises ValueError when one of them is not a finite scalar, or the angle in degrees.
        """
        q = (state_part("position", position, self.l), radians("angle", angle, self.l))
        return jnp.stack([*q, jnp.zeros_like(q[0]), jnp.zeros_like(q[1])])
