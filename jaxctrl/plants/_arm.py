"""The two-link planar arm: its skeleton, and the arm moved by joint torques."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._parameters import known, like, parameter, positive, state_part

FRICTION = np.array([[0.05, 0.025], [0.025, 0.05]])
"""Joint friction B [N m s/rad] (Li & Todorov 2004)."""


class TwoLinkArm(eqx.Module):
    """Hold the geometry and inertia of a two-link arm in the horizontal plane.

    M(q) ddq + C(q, dq) + B dq = tau        (Li 2006, eq. 3.6; Li & Todorov 2004)

    with q = (shoulder, elbow) [rad], the elbow's angle relative to the upper arm; tau (2,) in N m;
    no gravity. The mass of the upper arm and the place of its centre do not enter, because the
    moments of inertia are about the joints.

    Arguments:
        m2: mass of the forearm with the hand [kg]; 1.1 as in Li (2006), 1.0 in Li & Todorov (2004).
        l1, l2: lengths of upper arm and forearm [m].
        s2: distance of the forearm's centre of mass from the elbow [m].
        I1, I2: moments of inertia of upper arm and forearm about their own joints [kg m^2].
        friction: B, viscous friction [N m s/rad], shape (2, 2).

    Raises ValueError, naming the argument, for numbers that are not positive, an I2 too small for
    the mass matrix to be positive definite, a friction that feeds energy in, or a wrong shape.
    """

    m2: Float[Array, ""]
    l1: Float[Array, ""]
    l2: Float[Array, ""]
    s2: Float[Array, ""]
    I1: Float[Array, ""]
    I2: Float[Array, ""]
    friction: Float[Array, "2 2"]

    def __init__(
        self,
        *,
        m2: ArrayLike = 1.1,
        l1: ArrayLike = 0.30,
        l2: ArrayLike = 0.33,
        s2: ArrayLike = 0.16,
        I1: ArrayLike = 0.025,
        I2: ArrayLike = 0.045,
        friction: ArrayLike = FRICTION,
    ):
        self.m2 = positive("m2", m2)
        self.l1 = positive("l1", l1)
        self.l2 = positive("l2", l2)
        self.s2 = positive("s2", s2)
        self.I1 = positive("I1", I1)
        self.I2 = positive("I2", I2)
        if jnp.shape(friction) != (2, 2):
            raise ValueError(f"friction: shape {jnp.shape(friction)}, wanted (2, 2)")
        self.friction = parameter("friction", friction, (2, 2))
        numbers = known(m2, l1, s2, I1, I2)
        if numbers is not None:
            mass, length, centre, upper, fore = numbers
            if not fore * (upper + mass * length**2) > (mass * length * centre) ** 2:
                raise ValueError(f"I2: {I2} is too small for m2 and s2: M is not positive definite")
        B = known(friction)
        if B is not None and np.linalg.eigvalsh(B + B.T)[0] < -1e-12 * np.abs(B).max():
            raise ValueError(f"friction: B + B' must be positive semidefinite, got {friction}")

    def mass_matrix(self, q: Float[Array, "2"]) -> Float[Array, "2 2"]:
        """Return M(q) [kg m^2], shape (2, 2), for joint angles q (2,) [rad].

        M = [[d1 + 2 d2 cos q2, d3 + d2 cos q2], [d3 + d2 cos q2, d3]], with
        d1 = I1 + I2 + m2 l1^2, d2 = m2 l1 s2, d3 = I2.
        """
        m11, m12, m22 = self._mass_entries(q)
        return jnp.stack([jnp.stack([m11, m12]), jnp.stack([m12, m22])])

    def _mass_entries(self, q):
        c = self.m2 * self.l1 * self.s2 * jnp.cos(q[1])
        return self.I1 + self.I2 + self.m2 * self.l1**2 + 2 * c, self.I2 + c, self.I2

    def coriolis(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the centripetal and Coriolis torques C(q, dq) [N m], shape (2,).

        C = d2 sin q2 (-dq2 (2 dq1 + dq2), dq1^2), for q (2,) in rad and dq (2,) in rad/s.
        """
        s = self.m2 * self.l1 * self.s2 * jnp.sin(q[1])
        return s * jnp.stack([-dq[1] * (2 * dq[0] + dq[1]), dq[0] ** 2])

    def acceleration(
        self, q: Float[Array, "2"], dq: Float[Array, "2"], tau: Float[Array, "2"]
    ) -> Float[Array, "2"]:
        """Return ddq = M^-1 (tau - C - B dq) [rad/s^2], shape (2,), for torques tau (2,) [N m]."""
        net = tau - self.coriolis(q, dq) - jnp.sum(self.friction * dq, axis=1)
        m11, m12, m22 = self._mass_entries(q)
        determinant = m11 * m22 - m12**2
        return jnp.stack([m22 * net[0] - m12 * net[1], m11 * net[1] - m12 * net[0]]) / determinant

    def hand(self, q: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the hand's position [m], shape (2,), for joint angles q (2,) [rad].

        e = (l1 cos q1 + l2 cos(q1 + q2), l1 sin q1 + l2 sin(q1 + q2))     (Li 2006, eq. 3.17)
        """
        along = q[0] + q[1]
        return jnp.stack(
            [
                self.l1 * jnp.cos(q[0]) + self.l2 * jnp.cos(along),
                self.l1 * jnp.sin(q[0]) + self.l2 * jnp.sin(along),
            ]
        )

    def inverse_kinematics(self, hand: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the joint angles [rad], shape (2,), that put the hand at `hand` (2,) [m].

        cos q2 = (|e|^2 - l1^2 - l2^2)/(2 l1 l2), q2 in [0, pi] (the elbow to the right of the line
        to the hand), q1 = atan2(y, x) - atan2(l2 sin q2, l1 + l2 cos q2), within [-pi, pi].

        Out of reach: raises ValueError where the values are known, returns NaN under a
        transformation. The derivative is infinite at the border of the reach.
        """
        if jnp.shape(hand) != (2,):
            raise ValueError(f"hand: shape {jnp.shape(hand)}, wanted (2,)")
        hand = like(hand, self.l1)
        c = (jnp.sum(hand**2) - self.l1**2 - self.l2**2) / (2 * self.l1 * self.l2)
        # Rounding must not put a straight arm out of reach.
        rounding = 8 * jnp.finfo(c.dtype).eps
        overshoot = jnp.abs(c) - 1
        c = jnp.where((overshoot > 0) & (overshoot <= rounding), jnp.sign(c), c)
        cosine = known(c)
        if cosine is not None and not abs(cosine) <= 1:
            raise ValueError(
                f"hand: {hand} is out of reach of an arm with links {self.l1} and {self.l2} m"
            )
        s = jnp.sqrt((1 - c) * (1 + c))
        # The difference of the two angles, as one angle.
        ahead, aside = self.l1 + self.l2 * c, self.l2 * s
        shoulder = jnp.arctan2(hand[1] * ahead - hand[0] * aside, hand[0] * ahead + hand[1] * aside)
        return jnp.stack([shoulder, jnp.arctan2(s, c)])

    def posture(self, shoulder: ArrayLike, elbow: ArrayLike) -> Float[Array, "2"]:
        """Return the joint angles (shoulder, elbow) [rad] as an array, shape (2,).

        Raises ValueError when an angle is not a finite scalar.
        """
        shoulder = state_part("shoulder", shoulder, self.l1)
        elbow = state_part("elbow", elbow, self.l1)
        return jnp.stack([shoulder, elbow])

    def kinetic_energy(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, ""]:
        """Return dq'M(q)dq/2 [J], shape (), for q (2,) [rad] and dq (2,) [rad/s]."""
        m11, m12, m22 = self._mass_entries(q)
        return 0.5 * (m11 * dq[0] ** 2 + m22 * dq[1] ** 2) + m12 * dq[0] * dq[1]


class TorqueArm(AbstractArm):
    """Move a two-link arm in the horizontal plane by torques at shoulder and elbow.

    ddq = M(q)^-1 (u - C(q, dq) - B dq)        (Li 2006, eq. 3.6; model 1 of section 4.3)

    State x = (shoulder, elbow [rad], their rates [rad/s]), shape (4,); control u, the torques
    [N m], shape (2,).

    Arguments:
        control_bounds: (lower, upper) [N m], scalars or of shape (2,), or None.
        skeleton: m2, l1, l2, s2, I1, I2, friction, as `TwoLinkArm` takes them.

    Raises ValueError for what `TwoLinkArm` refuses.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    num_joints: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    skeleton: TwoLinkArm
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(
        self, *, control_bounds: tuple[ArrayLike, ArrayLike] | None = None, **skeleton: ArrayLike
    ):
        self.nx, self.nu, self.num_joints, self.discrete = 4, 2, 2, False
        self.skeleton = TwoLinkArm(**skeleton)
        self.control_bounds = as_bounds(control_bounds, (2,))
        self.nominal_control = jnp.zeros((2,), self.skeleton.m2.dtype)

    def __call__(self, x, u, t):
        """Return (dq, M^-1 (u - C - B dq)), shape (4,)."""
        return jnp.concatenate([x[2:], self.skeleton.acceleration(x[:2], x[2:], u)])

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """The arm stretched out, l1 + l2 [m], shape ()."""
        return self.skeleton.l1 + self.skeleton.l2

    def hand_of_joints(self, q: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the hand's position [m], shape (2,); see `TwoLinkArm.hand`."""
        return self.skeleton.hand(q)

    def inverse_kinematics(self, hand: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return joint angles (2,) [rad] for a hand position (2,) [m]; see `TwoLinkArm`."""
        return self.skeleton.inverse_kinematics(hand)

    def mass_matrix(self, q: Float[Array, "2"]) -> Float[Array, "2 2"]:
        """Return M(q) [kg m^2], shape (2, 2), for joint angles q (2,) [rad]."""
        return self.skeleton.mass_matrix(q)

    def coriolis(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return C(q, dq) [N m], shape (2,), for q (2,) [rad] and dq (2,) [rad/s]."""
        return self.skeleton.coriolis(q, dq)

    def joint_torque(self, x: Float[Array, "4"], u: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the torques at shoulder and elbow [N m], shape (2,): the control u (2,) itself."""
        return u

    def kinetic_energy(self, x: Float[Array, "4"]) -> Float[Array, ""]:
        """Return the kinetic energy [J], shape (), of a state x (4,)."""
        return self.skeleton.kinetic_energy(x[:2], x[2:4])

    def at_rest(self, shoulder: ArrayLike, elbow: ArrayLike) -> Float[Array, "4"]:
        """Return the state (shoulder, elbow, 0, 0), shape (4,), for angles in rad.

        Raises ValueError when an angle is not a finite scalar.
        """
        q = self.skeleton.posture(shoulder, elbow)
        return jnp.concatenate([q, jnp.zeros_like(q)])
