"""The two-link arm moved by six muscle groups."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._plant import AbstractArm
from .._types import Bounds, as_bounds
from ._arm import TwoLinkArm
from ._muscle import ACTIVATION_TIME, DEACTIVATION_TIME, activation_rate, tension
from ._parameters import known, parameter, positive, state_part

MUSCLES = ("EF", "EX", "SF", "SX", "BF", "BX")
"""The six groups: elbow flexors (part of the biceps, brachialis, brachioradialis), elbow extensors
(lateral triceps, anconeus), shoulder flexors (anterior deltoid, ...), shoulder extensors (posterior
deltoid, ...), biarticulate flexors (long biceps), biarticulate extensors (long triceps)."""

PCSA = np.array([18.0, 14.0, 22.0, 12.0, 5.0, 10.0])
"""Physiological cross-sections [cm^2] (Li & Todorov 2004)."""
SPECIFIC_TENSION = 31.8
"""Peak force per cross-section [N/cm^2] (Brown, Cheng & Loeb 1999; Van Wouwe et al. 2022)."""
SHORTEST = np.array([0.60, 0.80, 0.70, 0.70, 0.60, 0.85])
"""Shortest lengths [L0] (Li & Todorov 2004)."""
LONGEST = np.array([1.10, 1.25, 1.20, 1.10, 1.10, 1.20])
"""Longest lengths [L0] (Li & Todorov 2004; EX as Van Wouwe, Ting & De Groote 2022 have it)."""
ARM_FREQUENCY = 1.9
"""c in the arms' cos(c q) (Van Wouwe, Ting & De Groote 2022)."""

COSINE_ARMS = np.array(
    [
        [[0, 0, 0.040, -0.042, 0.030, -0.039], [0.030, -0.019, 0, 0, 0.032, -0.022]],
        [[0, 0, -0.008, 0, -0.011, 0], [-0.011, 0, 0, 0, -0.010, 0]],
    ]
)
"""alpha and beta [m], each (2, 6): shoulder, elbow (Van Wouwe, Ting & De Groote 2022)."""
CONSTANT_ARMS = np.array(
    [
        [[0, 0, 0.040, -0.040, 0.028, -0.035], [0.025, -0.025, 0, 0, 0.028, -0.035]],
        np.zeros((2, 6)),
    ]
)
"""alpha and beta [m] of posture-independent arms (Katayama & Kawato 1993)."""


class MuscleArm(AbstractArm):
    """Move a two-link arm in the horizontal plane by six muscle groups, `MUSCLES`.

    M(q) ddq + C(q, dq) + B dq = R(q) T(a, l(q), v(q, dq))    (Li 2006, eq. 3.6 and section 3.1)
    R_ji = alpha_ji + beta_ji cos(c q_j)                      (moment arms [m])
    l_i  = l0_i - kappa_i sum_j (alpha_ji q_j + beta_ji/c sin(c q_j)),  v = dl/dt = -kappa R'dq
    da/dt = (u - a)/t(u, a)                                   (Li 2006, eq. 3.14)

    State x = (shoulder, elbow [rad], their rates [rad/s], activations), shape (10,); control u, the
    muscles' excitations between 0 and 1, shape (6,). Lengths are in units of the optimal length
    L0 = 1/kappa, velocities in L0/s. kappa and l0 are such that each muscle runs through exactly
    its range of lengths while the joints go from 0 to pi; with constant arms (beta = 0) the same
    rule is our choice. Tension: see `tension`, and there what to know about its derivatives.

    Arguments:
        arms: "cosine" (Van Wouwe, Ting & De Groote 2022) or "constant" (Katayama & Kawato 1993):
            the defaults of alpha and beta.
        alpha, beta: coefficients of the moment arms [m], shape (2, 6), shoulder above elbow.
        arm_frequency: c.
        pcsa: cross-sections [cm^2], scalar or (6,).
        specific_tension: peak force per cross-section [N/cm^2].
        shortest, longest: range of lengths [L0], scalars or (6,).
        activation_time, deactivation_time: t_a and t_d [s].
        control_bounds: (lower, upper), scalars or of shape (6,), or None.
        nominal_control: where an optimisation starts, scalar or (6,); 0.05 is our choice: without
            any activation the gradient at rest is exactly zero.
        skeleton: m2, l1, l2, s2, I1, I2, friction, as `TwoLinkArm` takes them.

    Raises ValueError, naming the argument, for numbers that are not positive, a wrong shape, a
    longest length not above the shortest, a muscle without any moment arm, another word for `arms`,
    or what `TwoLinkArm` refuses.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    num_joints: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    skeleton: TwoLinkArm
    alpha: Float[Array, "2 6"]
    beta: Float[Array, "2 6"]
    arm_frequency: Float[Array, ""]
    pcsa: Float[Array, "6"]
    specific_tension: Float[Array, ""]
    shortest: Float[Array, "6"]
    longest: Float[Array, "6"]
    activation_time: Float[Array, ""]
    deactivation_time: Float[Array, ""]
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(
        self,
        *,
        arms: Literal["cosine", "constant"] = "cosine",
        alpha: ArrayLike | None = None,
        beta: ArrayLike | None = None,
        arm_frequency: ArrayLike = ARM_FREQUENCY,
        pcsa: ArrayLike = PCSA,
        specific_tension: ArrayLike = SPECIFIC_TENSION,
        shortest: ArrayLike = SHORTEST,
        longest: ArrayLike = LONGEST,
        activation_time: ArrayLike = ACTIVATION_TIME,
        deactivation_time: ArrayLike = DEACTIVATION_TIME,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = (0.0, 1.0),
        nominal_control: ArrayLike = 0.05,
        **skeleton: ArrayLike,
    ):
        defaults = {"cosine": COSINE_ARMS, "constant": CONSTANT_ARMS}
        if arms not in defaults:
            raise ValueError(f"arms: one of {sorted(defaults)} is wanted, got {arms!r}")
        self.nx, self.nu, self.num_joints, self.discrete = 10, 6, 2, False
        self.skeleton = TwoLinkArm(**skeleton)
        self.alpha = parameter("alpha", defaults[arms][0] if alpha is None else alpha, (2, 6))
        self.beta = parameter("beta", defaults[arms][1] if beta is None else beta, (2, 6))
        self.arm_frequency = positive("arm_frequency", arm_frequency)
        self.pcsa = positive("pcsa", pcsa, (6,))
        self.specific_tension = positive("specific_tension", specific_tension)
        self.shortest = positive("shortest", shortest, (6,))
        self.longest = positive("longest", longest, (6,))
        self.activation_time = positive("activation_time", activation_time)
        self.deactivation_time = positive("deactivation_time", deactivation_time)
        self.control_bounds = as_bounds(control_bounds, (6,))
        self.nominal_control = parameter("nominal_control", nominal_control, (6,))
        low, high = known(shortest), known(longest)
        if low is not None and high is not None and not (high > low).all():
            raise ValueError(f"longest: above shortest is wanted, got {longest} and {shortest}")
        excursion = known(self.excursion)
        if excursion is not None and (excursion == 0).any():
            raise ValueError("alpha: every muscle needs a moment arm, or its length has no range")

    def __call__(self, x, u, t):
        """Return (dq, M^-1 (R T - C - B dq), da/dt), shape (10,)."""
        q, dq, a = x[:2], x[2:4], x[4:]
        return jnp.concatenate(
            [
                dq,
                self.skeleton.acceleration(q, dq, self.muscle_torque(x)),
                activation_rate(a, u, self.activation_time, self.deactivation_time),
            ]
        )

    @property
    def peak_force(self) -> Float[Array, "6"]:
        """Peak isometric forces F0 = specific tension times cross-section [N], shape (6,)."""
        return self.specific_tension * self.pcsa

    def _wound(self, q):
        """Return the integral of the arms from 0 to q, summed over the joints [m], (6,)."""
        c = self.arm_frequency
        q = jnp.asarray(q)[:, None]
        return jnp.sum(self.alpha * q + self.beta / c * jnp.sin(c * q), axis=0)

    @property
    def excursion(self) -> Float[Array, "6"]:
        """E_i = sum_j (alpha_ji pi + beta_ji/c sin(c pi)) [m], shape (6,); positive for flexors."""
        return self._wound(jnp.full((2,), jnp.pi, self.alpha.dtype))

    @property
    def kappa(self) -> Float[Array, "6"]:
        """1/L0 = (longest - shortest)/|E| [1/m], shape (6,)."""
        return (self.longest - self.shortest) / jnp.abs(self.excursion)

    @property
    def length_at_zero(self) -> Float[Array, "6"]:
        """Lengths l0 at q = 0 [L0], shape (6,): the flexors' longest, the extensors' shortest."""
        return jnp.where(self.excursion > 0, self.longest, self.shortest)

    def moment_arms(self, q: Float[Array, "2"]) -> Float[Array, "2 6"]:
        """Return R_ji = alpha_ji + beta_ji cos(c q_j) [m], shape (2, 6), for q (2,) [rad]."""
        return self.alpha + self.beta * jnp.cos(self.arm_frequency * q)[:, None]

    def muscle_length(self, q: Float[Array, "2"]) -> Float[Array, "6"]:
        """Return the lengths l [L0], shape (6,), for q (2,) [rad]; dl/dq_j = -kappa R_j exactly."""
        return self.length_at_zero - self.kappa * self._wound(q)

    def muscle_velocity(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "6"]:
        """Return v = -kappa R'dq [L0/s], shape (6,), for q (2,) [rad] and dq (2,) [rad/s]."""
        return -self.kappa * jnp.sum(self.moment_arms(q) * dq[:, None], axis=0)

    def muscle_tension(self, x: Float[Array, "10"]) -> Float[Array, "6"]:
        """Return the tensions T [N], shape (6,), in a state x (10,)."""
        l = self.muscle_length(x[:2])
        v = self.muscle_velocity(x[:2], x[2:4])
        return self.peak_force * tension(x[4:10], l, v)

    def muscle_torque(self, x: Float[Array, "10"]) -> Float[Array, "2"]:
        """Return the torques R(q) T at shoulder and elbow [N m], shape (2,), in a state x (10,)."""
        return jnp.sum(self.moment_arms(x[:2]) * self.muscle_tension(x), axis=1)

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """The arm stretched out, l1 + l2 [m], shape ()."""
        return self.skeleton.l1 + self.skeleton.l2

    def joint_torque(self, x: Float[Array, "10"], u: Float[Array, "6"]) -> Float[Array, "2"]:
        """Return the muscles' torques R(q) T [N m], shape (2,); they do not depend on u (6,)."""
        return self.muscle_torque(x)

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

    def kinetic_energy(self, x: Float[Array, "10"]) -> Float[Array, ""]:
        """Return the kinetic energy [J], shape (), of a state x (10,)."""
        return self.skeleton.kinetic_energy(x[:2], x[2:4])

    def at_rest(
        self, shoulder: ArrayLike, elbow: ArrayLike, activation: ArrayLike = 0.0
    ) -> Float[Array, "10"]:
        """Return the state at rest, shape (10,), for angles [rad] and activations, scalar or (6,).

        Raises ValueError for what is not finite, not of these shapes, or a negative activation.
        """
        q = self.skeleton.posture(shoulder, elbow)
        a = state_part("activation", activation, self.alpha, (6,))
        numbers = known(activation)
        if numbers is not None and (numbers < 0).any():
            raise ValueError(f"activation: at least 0 is wanted, got {activation}")
        return jnp.concatenate([q, jnp.zeros_like(q), a])
