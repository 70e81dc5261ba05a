"""A planar chain of n thin rods, by the articulated-body recursion."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import check_integer
from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import parameter, positive, radians

TOTAL_LENGTH = 0.63
"""Length of the whole chain [m], that of the two-link arm; our choice."""
TOTAL_MASS = 2.4
"""Mass of the whole chain [kg]; our choice."""
FRICTION = 0.05
"""Viscous friction of each joint of a chain of two [N m s/rad]; our choice."""


class Chain(AbstractArm):
    """Move a planar chain of n thin rods by torques at its joints, in time proportional to n.

    M(q) ddq + C(q, dq) + G(q) + B dq = u,    B = diag(friction)

    State x = (q, dq), shape (2 n,): relative joint angles [rad], the first against the x axis, and
    their rates [rad/s]. Control u, the torques [N m], shape (n,). The hand is the tip of the last
    link. Gravity, if any, points along -y.

    The recursion is Featherstone's (1983) articulated-body algorithm for rods in the plane. Seen
    from its joint, link i with everything beyond it answers a base acceleration a with the force
    F = A a + b; A and b come from tip to base, the accelerations from base to tip. M is never
    formed. Li (2006, fig. 5.6) compares methods on such a family; its parameters are our choice.

    Arguments:
        n: number of links.
        length: lengths of the links [m], scalar or (n,); 0.63/n each by default.
        mass: masses of the links [kg], scalar or (n,); 2.4/n each by default.
        friction: viscous friction of the joints [N m s/rad], scalar or (n,); 0.05 (2/n)^3 by
            default. The inertia of a link falls as 1/n^3: so its friction acts at the same rate
            for any n, and a time step that is stable for two links is so for sixteen.
        gravity: acceleration along -y [m/s^2]; zero for a chain in the horizontal plane.
        control_bounds: (lower, upper) [N m], scalars or of shape (n,), or None.

    Raises ValueError, naming the argument, for n < 1, a length or mass that is not positive, a
    negative friction, or a wrong shape.
    """

    num_joints: int = eqx.field(static=True)
    length: Float[Array, " n"]
    mass: Float[Array, " n"]
    friction: Float[Array, " n"]
    gravity: Float[Array, ""]
    control_bounds: Bounds | None

    def __init__(
        self,
        n: int,
        *,
        length: ArrayLike | None = None,
        mass: ArrayLike | None = None,
        friction: ArrayLike | None = None,
        gravity: ArrayLike = 0.0,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = None,
    ):
        self.num_joints = n = check_integer("n", n, 1)
        self.length = positive("length", TOTAL_LENGTH / n if length is None else length, (n,))
        self.mass = positive("mass", TOTAL_MASS / n if mass is None else mass, (n,))
        self.friction = parameter(
            "friction", FRICTION * (2 / n) ** 3 if friction is None else friction, (n,), minimum=0.0
        )
        self.gravity = parameter("gravity", gravity)
        self.control_bounds = as_bounds(control_bounds, (n,))

    @property
    def nx(self) -> int:
        """Size of the state, 2 n."""
        return 2 * self.num_joints

    @property
    def nu(self) -> int:
        """Number of torques, n."""
        return self.num_joints

    def __call__(self, x, u, t):
        """Return (dq, ddq), shape (2 n,)."""
        n = self.num_joints
        q, dq = x[:n], x[n:]
        tau = u - self.friction * dq
        # Each joint's torque acts on its link, and backwards on the link before.
        net = tau - jnp.concatenate([tau[1:], jnp.zeros_like(tau[:1])])
        absolute = self._recursion(jnp.cumsum(q), jnp.cumsum(dq), net)
        return jnp.concatenate([dq, jnp.diff(absolute, prepend=jnp.zeros_like(absolute[:1]))])

    def _recursion(self, phi, w, net):
        """Return the angular accelerations (n,) for absolute angles and rates, and net torques.

        For a rod of mass m, length l, direction e and normal n, with its base accelerating at a:
            tip      a' = a + l (alpha n - w^2 e)
            force    F  = m (a + l/2 (alpha n - w^2 e)) + F',  F' = A'a' + b' beyond the tip
            moment   (m l^2/3) alpha + m l/2 n'a = Q - l n'F'
        """
        m, l = self.mass, self.length
        c, s, spin = jnp.cos(phi), jnp.sin(phi), w**2
        links = (c, s, spin, net, m, l)
        dtype = jnp.result_type(*links, self.gravity)
        zero = jnp.zeros((), dtype)

        def inward(beyond, link):
            axx, axy, ayy, bx, by = beyond
            c, s, spin, net, m, l = link
            # l A' times the link's normal (-s, c) and times its direction (c, s).
            across_x, across_y = l * (axy * c - axx * s), l * (ayy * c - axy * s)
            along_x, along_y = l * (axx * c + axy * s), l * (axy * c + ayy * s)
            half = 0.5 * m * l
            wx, wy = across_x - half * s, across_y + half * c
            inertia = m * l**2 / 3 + l * (across_y * c - across_x * s)
            moment = net + l * (spin * (along_y * c - along_x * s) - (by * c - bx * s))
            alpha0, gx, gy = moment / inertia, wx / inertia, wy / inertia
            here = (
                m + axx - wx * gx,
                axy - wx * gy,
                m + ayy - wy * gy,
                bx + wx * alpha0 - spin * (half * c + along_x),
                by + wy * alpha0 - spin * (half * s + along_y),
            )
            return here, (alpha0, gx, gy)

        _, answers = jax.lax.scan(inward, (zero,) * 5, links, reverse=True)

        def outward(a, link):
            c, s, spin, l, alpha0, gx, gy = link
            ax, ay = a
            alpha = alpha0 - gx * ax - gy * ay
            return (ax - l * (alpha * s + spin * c), ay + l * (alpha * c - spin * s)), alpha

        # A chain that falls is a chain whose wall accelerates upwards.
        wall = (zero, jnp.asarray(self.gravity, dtype))
        return jax.lax.scan(outward, wall, (c, s, spin, l, *answers))[1]

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """The chain stretched out [m], shape ()."""
        return jnp.sum(self.length)

    def hand_of_joints(self, q: Float[Array, " n"]) -> Float[Array, "2"]:
        """Return the tip of the last link [m], shape (2,), for joint angles q (n,) [rad]."""
        phi = jnp.cumsum(q)
        return jnp.stack([jnp.sum(self.length * jnp.cos(phi)), jnp.sum(self.length * jnp.sin(phi))])

    def _centres(self, q):
        """Return the links' centres of mass [m], shape (n, 2)."""
        phi = jnp.cumsum(q)
        rods = self.length[:, None] * jnp.stack([jnp.cos(phi), jnp.sin(phi)], axis=1)
        return jnp.cumsum(rods, axis=0) - 0.5 * rods

    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2] in relative coordinates, shape (n, n), for angles q (n,) [rad].

        M = sum_i m_i (J_i'J_i + l_i^2/12 1_i 1_i'), J_i the Jacobian of link i's centre and 1_i
        the joints up to i. The dynamics do not use it.
        """
        jacobian = jax.jacfwd(self._centres)(q)
        turning = jnp.tri(self.num_joints, dtype=jacobian.dtype)
        spin = self.mass * self.length**2 / 12
        linear = jnp.einsum("i,ijk,ijl->kl", self.mass, jacobian, jacobian)
        return linear + jnp.einsum("i,ik,il->kl", spin, turning, turning)

    def joint_torque(self, x: Float[Array, " nx"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the torques at the joints [N m], shape (n,): the control u (n,) itself."""
        return u

    def kinetic_energy(self, x: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return sum_i m_i (|v_i|^2 + l_i^2 w_i^2/12)/2 [J], shape (), of a state x (2 n,)."""
        n = self.num_joints
        _, v = jax.jvp(self._centres, (x[:n],), (x[n:],))
        w = jnp.cumsum(x[n:])
        return 0.5 * jnp.sum(self.mass * (jnp.sum(v**2, axis=1) + self.length**2 / 12 * w**2))

    def at_rest(self, q: ArrayLike) -> Float[Array, " nx"]:
        """Return the state (q, 0), shape (2 n,), for relative joint angles [rad], scalar or (n,).

        Raises ValueError for what is not finite, not of these shapes, or in degrees.
        """
        q = radians("q", q, self.length, (self.num_joints,))
        return jnp.concatenate([q, jnp.zeros_like(q)])
