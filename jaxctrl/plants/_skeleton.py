"""Skeletons: what the bones of an arm do, whatever moves them; and arms that have one."""

import abc
from dataclasses import KW_ONLY
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from ._parameters import known, like, parameter, positive, radians

FRICTION = np.array([[0.05, 0.025], [0.025, 0.05]])
"""Joint friction B [N m s/rad] (Li & Todorov 2004)."""


class AbstractSkeleton(eqx.Module):
    """Bones on joints, M(q) ddq + h(q, dq) = tau, and where the hand is.

    Attributes:
        n: number of joints; static.
        dim: of the space that the hand moves in, 2 or 3; static.
    """

    n: eqx.AbstractVar[int]
    dim: eqx.AbstractVar[int]

    @property
    @abc.abstractmethod
    def longest_reach(self) -> Float[Array, ""]:
        """The largest distance of the hand from the origin [m], shape ()."""

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""

    @abc.abstractmethod
    def bias(self, q: Float[Array, " n"], dq: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return h(q, dq) [N m], shape (n,): centripetal and Coriolis torques, friction, gravity.

        For joint angles q (n,) [rad] and rates dq (n,) [rad/s].
        """

    @abc.abstractmethod
    def hand(self, q: Float[Array, " n"]) -> Float[Array, " dim"]:
        """Return the hand's position [m], shape (dim,), for joint angles q (n,) [rad]."""

    @abc.abstractmethod
    def solve(self, q: Float[Array, " n"], torque: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return M(q)^-1 torque [rad/s^2], shape (n,), for q (n,) [rad] and torques (n,) [N m].

        Without a closed form `jnp.linalg.solve(self.mass_matrix(q), torque)` will do.
        """

    def acceleration(
        self, q: Float[Array, " n"], dq: Float[Array, " n"], tau: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Return ddq = M^-1 (tau - h) [rad/s^2], shape (n,), for torques tau (n,) [N m]."""
        return self.solve(q, tau - self.bias(q, dq))

    def kinetic_energy(self, q: Float[Array, " n"], dq: Float[Array, " n"]) -> Float[Array, ""]:
        """Return dq'M(q)dq/2 [J], shape (), for q (n,) [rad] and dq (n,) [rad/s]."""
        return 0.5 * jnp.sum(dq * jnp.sum(self.mass_matrix(q) * dq, axis=1))


def _friction(value: ArrayLike) -> Array:
    if jnp.shape(value) != (2, 2):
        raise ValueError(f"friction: shape {jnp.shape(value)}, wanted (2, 2)")
    return parameter("friction", value, (2, 2))


class TwoLinkArm(AbstractSkeleton):
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

    n: ClassVar[int] = 2
    dim: ClassVar[int] = 2
    _: KW_ONLY
    m2: Float[Array, ""] = eqx.field(converter=partial(positive, "m2"), default=1.1)
    l1: Float[Array, ""] = eqx.field(converter=partial(positive, "l1"), default=0.30)
    l2: Float[Array, ""] = eqx.field(converter=partial(positive, "l2"), default=0.33)
    s2: Float[Array, ""] = eqx.field(converter=partial(positive, "s2"), default=0.16)
    I1: Float[Array, ""] = eqx.field(converter=partial(positive, "I1"), default=0.025)
    I2: Float[Array, ""] = eqx.field(converter=partial(positive, "I2"), default=0.045)
    friction: Float[Array, "2 2"] = eqx.field(converter=_friction, default_factory=lambda: FRICTION)

    def __check_init__(self):
        numbers = known(self.m2, self.l1, self.s2, self.I1, self.I2)
        if numbers is not None:
            mass, length, centre, upper, fore = numbers
            if not fore * (upper + mass * length**2) > (mass * length * centre) ** 2:
                raise ValueError(
                    f"I2: {fore:g} is too small for m2 and s2: M is not positive definite"
                )
        B = known(self.friction)
        if B is not None and np.linalg.eigvalsh(B + B.T)[0] < -1e-7 * np.abs(B).max():
            raise ValueError(f"friction: B + B' must be positive semidefinite, got {B.tolist()}")

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """The arm stretched out, l1 + l2 [m], shape ()."""
        return self.l1 + self.l2

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

    def solve(self, q: Float[Array, "2"], torque: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return M(q)^-1 torque [rad/s^2], shape (2,), for q (2,) [rad] and torques (2,) [N m]."""
        m11, m12, m22 = self._mass_entries(q)
        along = m22 * torque[0] - m12 * torque[1], m11 * torque[1] - m12 * torque[0]
        return jnp.stack(along) / (m11 * m22 - m12**2)

    def coriolis(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the centripetal and Coriolis torques C(q, dq) [N m], shape (2,).

        C = d2 sin q2 (-dq2 (2 dq1 + dq2), dq1^2), for q (2,) in rad and dq (2,) in rad/s.
        """
        s = self.m2 * self.l1 * self.s2 * jnp.sin(q[1])
        return s * jnp.stack([-dq[1] * (2 * dq[0] + dq[1]), dq[0] ** 2])

    def bias(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return C(q, dq) + B dq [N m], shape (2,), for q (2,) [rad] and dq (2,) [rad/s]."""
        return self.coriolis(q, dq) + jnp.sum(self.friction * dq, axis=1)

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

        Raises ValueError when an angle is not a finite scalar, or can only be in degrees.
        """
        return jnp.stack([radians("shoulder", shoulder, self.l1), radians("elbow", elbow, self.l1)])


class AbstractSkeletalArm(AbstractArm):
    """An arm that has a skeleton, and is moved by torques about its joints, whatever makes them.

    Attributes:
        skeleton: joints, masses and lengths.
    """

    skeleton: eqx.AbstractVar[AbstractSkeleton]

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return self.skeleton.n

    @property
    def dim(self) -> int:
        """Dimension of the space that the hand moves in, 2 or 3."""
        return self.skeleton.dim

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """That of the skeleton [m], shape ()."""
        return self.skeleton.longest_reach

    def hand_of_joints(self, q: Float[Array, " n"]) -> Float[Array, " dim"]:
        """Return the hand's position [m], shape (dim,), for joint angles q (n,) [rad]."""
        return self.skeleton.hand(q)

    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""
        return self.skeleton.mass_matrix(q)

    def kinetic_energy(self, x: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return the kinetic energy [J], shape (), of a state x (nx,)."""
        n = self.num_joints
        return self.skeleton.kinetic_energy(x[:n], x[n : 2 * n])
