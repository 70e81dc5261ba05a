"""The inverted pendulum: the smallest nonlinear plant, and smooth everywhere."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import parameter, positive, state_part


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

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    num_joints: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    m: Float[Array, ""]
    l: Float[Array, ""]
    g: Float[Array, ""]
    friction: Float[Array, ""]
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(
        self,
        *,
        m: ArrayLike = 1.0,
        l: ArrayLike = 1.0,
        g: ArrayLike = 9.8,
        friction: ArrayLike = 0.01,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ):
        self.nx, self.nu, self.num_joints, self.discrete = 2, 1, 1, False
        self.m = positive("m", m)
        self.l = positive("l", l)
        self.g = parameter("g", g)
        self.friction = parameter("friction", friction, minimum=0.0)
        self.control_bounds = as_bounds(control_bounds, (1,))
        self.nominal_control = jnp.zeros((1,), self.m.dtype)

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

        Raises ValueError when the angle is not a finite scalar.
        """
        angle = state_part("angle", angle, self.m)
        return jnp.stack([angle, jnp.zeros_like(angle)])
