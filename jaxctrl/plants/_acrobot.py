"""The acrobot: a double pendulum that is moved by its elbow alone."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import parameter, positive, radians


class Acrobot(AbstractArm):
    """Swing two links under gravity by a torque at the joint between them.

    M(q) ddq + C(q, dq) + G(q) + B dq = (0, u),    B = diag(friction)

    State x = (q, dq), shape (4,): q1 [rad] of the first link against the x axis, q2 [rad] of the
    second relative to the first, and their rates [rad/s]. Control u, the torque at the elbow
    [N m], shape (1,). Gravity points along -y: q = (-pi/2, 0) hangs down, (pi/2, 0) stands. The
    hand is the end of the second link.

    Arguments:
        m: masses of the links [kg], scalar or (2,).
        l: lengths of the links [m], scalar or (2,).
        centre: distances of the links' centres of mass from their upper ends [m], scalar or (2,);
            by default l: at their lower ends.
        inertia: moments of inertia about the centres of mass [kg m^2], scalar or (2,).
        friction: viscous friction of the joints [N m s/rad], scalar or (2,).
        g: gravity [m/s^2]; may be zero or negative.
        control_bounds: (lower, upper) [N m], scalars or of shape (1,), or None.

    The equations are those of Spong (1995), "The swing up control problem for the acrobot", with
    friction. The defaults are those of RobotZoo.jl, the models of ALTRO's benchmarks (Howell,
    Jackson & Manchester 2019). Raises ValueError, naming the argument, for a mass, a length or a
    centre that is not positive, a negative inertia or friction, or a wrong shape.
    """

    nx: ClassVar[int] = 4
    nu: ClassVar[int] = 1
    num_joints: ClassVar[int] = 2
    m: Float[Array, "2"]
    l: Float[Array, "2"]
    given_centre: Float[Array, "2"] | None
    inertia: Float[Array, "2"]
    friction: Float[Array, "2"]
    g: Float[Array, ""]
    control_bounds: Bounds | None

    def __init__(
        self,
        *,
        m: ArrayLike = 1.0,
        l: ArrayLike = 1.0,
        centre: ArrayLike | None = None,
        inertia: ArrayLike = 1.0,
        friction: ArrayLike = 1.0,
        g: ArrayLike = 9.81,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ):
        self.m = positive("m", m, (2,))
        self.l = positive("l", l, (2,))
        self.given_centre = None if centre is None else positive("centre", centre, (2,))
        self.inertia = parameter("inertia", inertia, (2,), minimum=0.0)
        self.friction = parameter("friction", friction, (2,), minimum=0.0)
        self.g = parameter("g", g)
        self.control_bounds = as_bounds(control_bounds, (1,))

    @property
    def centre(self) -> Float[Array, "2"]:
        """Distances of the centres of mass from the upper ends [m], shape (2,); l unless given."""
        return self.l if self.given_centre is None else self.given_centre

    def __call__(self, x, u, t):
        """Return (dq, ddq), shape (4,)."""
        q, dq = x[:2], x[2:]
        bend = self.m[1] * self.l[0] * self.centre[1] * jnp.sin(q[1])
        lower = self.m[1] * self.centre[1] * self.g * jnp.cos(q[0] + q[1])
        upper = (self.m[0] * self.centre[0] + self.m[1] * self.l[0]) * self.g * jnp.cos(q[0])
        friction = self.friction * dq
        n1 = bend * dq[1] * (2 * dq[0] + dq[1]) - upper - lower - friction[0]
        n2 = u[0] - bend * dq[0] ** 2 - lower - friction[1]
        m11, m12, m22 = self._mass_entries(q)
        determinant = m11 * m22 - m12**2
        ddq = (m22 * n1 - m12 * n2) / determinant, (m11 * n2 - m12 * n1) / determinant
        return jnp.stack([dq[0], dq[1], *ddq])

    def _mass_entries(self, q):
        across = self.m[1] * self.l[0] * self.centre[1] * jnp.cos(q[1])
        about_elbow = self.inertia[1] + self.m[1] * self.centre[1] ** 2
        about_shoulder = self.inertia[0] + self.m[0] * self.centre[0] ** 2
        carried = self.m[1] * self.l[0] ** 2
        m11 = about_shoulder + about_elbow + carried + 2 * across
        return m11, about_elbow + across, about_elbow

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """Both links stretched out [m], shape ()."""
        return jnp.sum(self.l)

    def hand_of_joints(self, q: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the end of the second link [m], shape (2,), for joint angles q (2,) [rad]."""
        along = jnp.stack([q[0], q[0] + q[1]])
        return jnp.stack([jnp.sum(self.l * jnp.cos(along)), jnp.sum(self.l * jnp.sin(along))])

    def mass_matrix(self, q: Float[Array, "2"]) -> Float[Array, "2 2"]:
        """Return M(q) [kg m^2], shape (2, 2), for joint angles q (2,) [rad]."""
        m11, m12, m22 = self._mass_entries(q)
        return jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m22])])

    def joint_torque(self, x: Float[Array, "4"], u: Float[Array, "1"]) -> Float[Array, "2"]:
        """Return the torques at shoulder and elbow [N m], (0, u), shape (2,)."""
        return jnp.stack([jnp.zeros_like(u[0]), u[0]])

    def at_rest(self, shoulder: ArrayLike, elbow: ArrayLike = 0.0) -> Float[Array, "4"]:
        """Return the state (shoulder, elbow, 0, 0), shape (4,), for angles in rad.

        Raises ValueError when an angle is not a finite scalar, or can only be in degrees.
        """
        q = (radians("shoulder", shoulder, self.m), radians("elbow", elbow, self.m))
        return jnp.stack([*q, jnp.zeros_like(q[0]), jnp.zeros_like(q[1])])
