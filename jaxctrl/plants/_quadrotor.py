"""A quadrotor in a vertical plane: a rigid body on two rotors."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractPlant
from .._types import Bounds, as_bounds
from ._parameters import like, parameter, positive, radians, state_part


class PlanarQuadrotor(AbstractPlant):
    """Fly a rigid body in a vertical plane by the thrusts of its two rotors.

    m ddx = (u1 + u2) sin q,    m ddy = (u1 + u2) cos q - m g,    J ddq = (u2 - u1) l/2

    State (x [m], y [m], tilt q [rad], and their rates), shape (6,); y points up, and a positive
    tilt leans towards positive x. Control u, the thrusts [N] along the body's own upward axis,
    shape (2,); the first rotor is l/2 ahead of the centre of mass, the second l/2 behind. The
    nominal control, m g/2 each, hovers.

    Arguments:
        m: mass [kg].
        l: distance between the rotors [m].
        inertia: J, moment of inertia about the centre of mass [kg m^2]; 0.2 m l^2 by default.
        g: gravity [m/s^2]; may be zero or negative.
        control_bounds: (lower, upper) [N], scalars or of shape (2,), or None.

    The defaults are those of `PlanarQuadrotor` in RobotZoo.jl. Raises ValueError, naming the
    argument, for a mass, a distance or an inertia that is not positive, or a wrong shape.
    """

    nx: ClassVar[int] = 6
    nu: ClassVar[int] = 2
    m: Float[Array, ""]
    l: Float[Array, ""]
    given_inertia: Float[Array, ""] | None
    g: Float[Array, ""]
    control_bounds: Bounds | None

    def __init__(
        self,
        *,
        m: ArrayLike = 1.0,
        l: ArrayLike = 0.3,
        inertia: ArrayLike | None = None,
        g: ArrayLike = 9.81,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ):
        self.m = positive("m", m)
        self.l = positive("l", l)
        self.given_inertia = None if inertia is None else positive("inertia", inertia)
        self.g = parameter("g", g)
        self.control_bounds = as_bounds(control_bounds, (2,))

    @property
    def inertia(self) -> Float[Array, ""]:
        """J [kg m^2], shape (); 0.2 m l^2 unless given."""
        given = self.given_inertia
        return 0.2 * self.m * self.l**2 if given is None else given

    @property
    def nominal_control(self) -> Float[Array, "2"]:
        """The thrusts that hover, m g/2 each [N], shape (2,)."""
        return jnp.broadcast_to(0.5 * self.m * self.g, (2,))

    def __call__(self, x, u, t):
        """Return (dx, dy, dq, ddx, ddy, ddq), shape (6,)."""
        lift = (u[0] + u[1]) / self.m
        turn = 0.5 * self.l / self.inertia * (u[1] - u[0])
        across, up = lift * jnp.sin(x[2]), lift * jnp.cos(x[2]) - self.g
        return jnp.stack([x[3], x[4], x[5], across, up, turn])

    def at_rest(self, position: Float[ArrayLike, "2"], tilt: ArrayLike = 0.0) -> Float[Array, "6"]:
        """Return the state (position (2,) [m], tilt [rad], 0, 0, 0), shape (6,).

        Raises ValueError for another shape, a number that is not finite, or a tilt in degrees.
        """
        if jnp.shape(position) != (2,):
            raise ValueError(f"position: got shape {jnp.shape(position)}, wanted (2,)")
        state_part("position", position, self.m, (2,))
        tilt = radians("tilt", tilt, self.m)
        q = jnp.concatenate([like(position, self.m), tilt[None]])
        return jnp.concatenate([q, jnp.zeros_like(q)])
