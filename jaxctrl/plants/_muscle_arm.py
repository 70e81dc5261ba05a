"""Arms moved by muscles: a skeleton, paths over its joints, and what pulls along them."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._types import Bounds, as_bounds
from ._muscle import ACTIVATION_TIME, DEACTIVATION_TIME, SPECIFIC_TENSION, Curve, Muscles
from ._parameters import known, parameter, radians, state_part
from ._paths import AbstractPaths, CosinePaths
from ._skeleton import AbstractSkeletalArm, AbstractSkeleton, TwoLinkArm

MUSCLES = ("EF", "EX", "SF", "SX", "BF", "BX")
"""The six groups: elbow flexors (part of the biceps, brachialis, brachioradialis), elbow extensors
(lateral triceps, anconeus), shoulder flexors (anterior deltoid, ...), shoulder extensors (posterior
deltoid, ...), biarticulate flexors (long biceps), biarticulate extensors (long triceps)."""

PCSA = np.array([18.0, 14.0, 22.0, 12.0, 5.0, 10.0])
"""Physiological cross-sections [cm^2] (Li & Todorov 2004)."""
SHORTEST = np.array([0.60, 0.80, 0.70, 0.70, 0.60, 0.85])
"""Shortest lengths [L0] (Li & Todorov 2004)."""
LONGEST = np.array([1.10, 1.25, 1.20, 1.10, 1.10, 1.20])
"""Longest lengths [L0] (Li & Todorov 2004; EX as Van Wouwe, Ting & De Groote 2022 have it)."""
OPTIMAL_LENGTH = np.array([0.111, 0.083, 0.107, 0.137, 0.116, 0.134])
"""Optimal fibre lengths [m] of the groups (Holzbaur, Murray & Delp 2005, their means weighted by
peak force): EF short biceps, brachialis, brachioradialis (13.2, 8.6, 17.3 cm; 436, 987, 261 N), EX
lateral triceps, anconeus (11.4, 2.7 cm; 624, 350 N), SF anterior deltoid, coracobrachialis,
clavicular pectoralis (9.8, 9.3, 14.4 cm; 1143, 243, 364 N), SX posterior deltoid, BF long biceps,
BX long triceps."""
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


class AbstractMusculoskeletalArm(AbstractSkeletalArm):
    """Move the n joints of a skeleton by m muscles.

    M(q) ddq + h(q, dq) = R(q) T(a, l, v),  da/dt = (u - a)/t(u, a)
    l = L(q)/L0,  v = dl/dt,  R = -(dL/dq)'

    State x = (q [rad], dq [rad/s], activations), shape (2 n + m,); control u, the muscles'
    excitations between 0 and 1, shape (m,).

    Attributes:
        skeleton, paths, muscles: joints and masses; lengths L(q); forces and activation.
    """

    paths: eqx.AbstractVar[AbstractPaths]
    muscles: eqx.AbstractVar[Muscles]

    @property
    def nx(self) -> int:
        """Size of the state, 2 n + m."""
        return 2 * self.skeleton.n + self.muscles.m

    @property
    def nu(self) -> int:
        """Number of muscles, m."""
        return self.muscles.m

    def __call__(self, x, u, t):
        """Return (dq, M^-1 (R T - h), da/dt), shape (nx,)."""
        q, dq, a = self._parts(x)
        ddq = self.skeleton.acceleration(q, dq, self.muscle_torque(x))
        return jnp.concatenate([dq, ddq, self.muscles.activation_rate(a, u)])

    def _parts(self, x):
        n = self.skeleton.n
        return x[:n], x[n : 2 * n], x[2 * n :]

    @property
    def peak_force(self) -> Float[Array, " m"]:
        """Peak isometric forces F0 [N], shape (m,)."""
        return self.muscles.peak_force

    def moment_arms(self, q: Float[Array, " n"]) -> Float[Array, "n m"]:
        """Return R(q) [m], shape (n, m), for q (n,) [rad]."""
        return self.paths.moment_arms(q)

    def muscle_length(self, q: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return the lengths l [L0], shape (m,), for q (n,) [rad]."""
        return self.paths.lengths(q) / self.paths.optimal_length

    def muscle_velocity(self, q: Float[Array, " n"], dq: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return v = dl/dt [L0/s], shape (m,), for q (n,) [rad] and dq (n,) [rad/s]."""
        return self.paths.velocities(q, dq) / self.paths.optimal_length

    def muscle_tension(self, x: Float[Array, " nx"]) -> Float[Array, " m"]:
        """Return the tensions T [N], shape (m,), in a state x (nx,)."""
        q, dq, a = self._parts(x)
        return self.muscles.tension(a, self.muscle_length(q), self.muscle_velocity(q, dq))

    def muscle_torque(self, x: Float[Array, " nx"]) -> Float[Array, " n"]:
        """Return the torques R(q) T at the joints [N m], shape (n,), in a state x (nx,)."""
        return self.paths.torque(x[: self.skeleton.n], self.muscle_tension(x))

    def joint_torque(self, x: Float[Array, " nx"], u: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return the muscles' torques R(q) T [N m], shape (n,); they do not depend on u (m,)."""
        return self.muscle_torque(x)

    def _rest(self, q, activation):
        return jnp.concatenate([q, jnp.zeros_like(q), self.as_activation(activation)])

    def as_activation(self, activation: ArrayLike) -> Float[Array, " m"]:
        """Return activations of shape (m,), from a scalar or (m,).

        Raises ValueError for what is not finite, of another shape, or outside 0 to 1.
        """
        a = state_part("activation", activation, self.muscles.pcsa, (self.muscles.m,))
        numbers = known(activation)
        if numbers is not None and ((numbers < 0) | (numbers > 1)).any():
            raise ValueError(f"activation: 0 to 1 is wanted, got {activation}")
        return a


class MusculoskeletalArm(AbstractMusculoskeletalArm):
    """Move any skeleton by any muscles; see `AbstractMusculoskeletalArm` for the equations.

    State x = (q [rad], dq [rad/s], activations), shape (2 n + m,); control u, the muscles'
    excitations between 0 and 1, shape (m,).

    Arguments:
        skeleton: n joints, such as `TwoLinkArm()`.
        paths: of m muscles over them, such as `CosinePaths(...)`.
        muscles: m of them.
        control_bounds: (lower, upper), scalars or of shape (m,), or None.
        nominal_control: where an optimisation starts, scalar or (m,).

    Raises ValueError when the numbers of joints or muscles do not agree, or naming what is of
    another shape.
    """

    skeleton: AbstractSkeleton
    paths: AbstractPaths
    muscles: Muscles
    control_bounds: Bounds | None
    nominal_control: Float[Array, " m"]

    def __init__(
        self,
        skeleton: AbstractSkeleton,
        paths: AbstractPaths,
        muscles: Muscles,
        *,
        control_bounds: tuple[ArrayLike, ArrayLike] | None = (0.0, 1.0),
        nominal_control: ArrayLike = 0.05,
    ):
        if (paths.n, paths.m) != (skeleton.n, muscles.m):
            raise ValueError(
                f"paths: {paths.m} muscles over {paths.n} joints, wanted {muscles.m} over "
                f"{skeleton.n}"
            )
        self.skeleton, self.paths, self.muscles = skeleton, paths, muscles
        self.control_bounds = as_bounds(control_bounds, (muscles.m,))
        self.nominal_control = parameter("nominal_control", nominal_control, (muscles.m,))

    def at_rest(self, q: ArrayLike, activation: ArrayLike = 0.0) -> Float[Array, " nx"]:
        """Return the state at rest, shape (nx,), for angles (n,) [rad] and activations, () or (m,).

        Raises ValueError for what is not finite, not of these shapes, in degrees, or a negative
        activation.
        """
        return self._rest(radians("q", q, self.muscles.pcsa, (self.skeleton.n,)), activation)


class MuscleArm(AbstractMusculoskeletalArm):
    """Move a two-link arm in the horizontal plane by six muscle groups, `MUSCLES`.

    M(q) ddq + C(q, dq) + B dq = R(q) T(a, l(q), v(q, dq))    (Li 2006, eq. 3.6 and section 3.1)
    R_ji = alpha_ji + beta_ji cos(c q_j)                      (moment arms [m])
    l_i  = l0_i - kappa_i sum_j (alpha_ji q_j + beta_ji/c sin(c q_j)),  v = dl/dt = -kappa R'dq
    da/dt = (u - a)/t(u, a)                                   (Li 2006, eq. 3.14)

    State x = (shoulder, elbow [rad], their rates [rad/s], activations), shape (10,); control u, the
    muscles' excitations between 0 and 1, shape (6,). Lengths are in units of the optimal length
    L0 = 1/kappa, velocities in L0/s. kappa and l0 are such that each muscle runs through exactly
    its range of lengths while the joints go from 0 to pi, or follow from `optimal_length`; see
    `CosinePaths`. Tension: see `tension`, and there what to know about its derivatives.

    Arguments:
        arms: "cosine" (Van Wouwe, Ting & De Groote 2022) or "constant" (Katayama & Kawato 1993):
            the defaults of alpha and beta.
        alpha, beta: coefficients of the moment arms [m], shape (2, 6), shoulder above elbow.
        arm_frequency: c.
        pcsa: cross-sections [cm^2], scalar or (6,).
        specific_tension: peak force per cross-section [N/cm^2].
        shortest, longest: range of lengths [L0], scalars or (6,).
        optimal_length: L0 [m], scalar or (6,), such as those of anatomy, `OPTIMAL_LENGTH`; None for
            the range's, with which the shoulder's muscles are too long (see docs/design.md).
        activation_time, deactivation_time: t_a and t_d [s].
        active_state: how force grows with the activation: "linear", "brown" or "brown-fixed"; see
            the function `active_state`.
        control_bounds: (lower, upper), scalars or of shape (6,), or None.
        nominal_control: where an optimisation starts, scalar or (6,); 0.05 is our choice: without
            any activation the gradient at rest is exactly zero.
        skeleton: m2, l1, l2, s2, I1, I2, friction, as `TwoLinkArm` takes them.

    Raises ValueError, naming the argument, for numbers that are not positive, a wrong shape, a
    longest length not above the shortest, a muscle without any moment arm, another word for `arms`
    or `active_state`, or what `TwoLinkArm` refuses.
    """

    skeleton: TwoLinkArm
    paths: CosinePaths
    muscles: Muscles
    control_bounds: Bounds | None
    nominal_control: Float[Array, "6"]

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
        optimal_length: ArrayLike | None = None,
        activation_time: ArrayLike = ACTIVATION_TIME,
        deactivation_time: ArrayLike = DEACTIVATION_TIME,
        active_state: Curve = "linear",
        control_bounds: tuple[ArrayLike, ArrayLike] | None = (0.0, 1.0),
        nominal_control: ArrayLike = 0.05,
        **skeleton: ArrayLike,
    ):
        defaults = {"cosine": COSINE_ARMS, "constant": CONSTANT_ARMS}
        if arms not in defaults:
            raise ValueError(f"arms: one of {sorted(defaults)} is wanted, got {arms!r}")
        self.skeleton = TwoLinkArm(**skeleton)
        self.paths = CosinePaths(
            parameter("alpha", defaults[arms][0] if alpha is None else alpha, (2, 6)),
            parameter("beta", defaults[arms][1] if beta is None else beta, (2, 6)),
            arm_frequency=arm_frequency,
            shortest=shortest,
            longest=longest,
            optimal_length=optimal_length,
        )
        self.muscles = Muscles(
            parameter("pcsa", pcsa, (6,)),
            specific_tension=specific_tension,
            activation_time=activation_time,
            deactivation_time=deactivation_time,
            active_state=active_state,
        )
        self.control_bounds = as_bounds(control_bounds, (6,))
        self.nominal_control = parameter("nominal_control", nominal_control, (6,))

    def inverse_kinematics(self, hand: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return joint angles (2,) [rad] for a hand position (2,) [m]; see `TwoLinkArm`."""
        return self.skeleton.inverse_kinematics(hand)

    def coriolis(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return C(q, dq) [N m], shape (2,), for q (2,) [rad] and dq (2,) [rad/s]."""
        return self.skeleton.coriolis(q, dq)

    def at_rest(
        self, shoulder: ArrayLike, elbow: ArrayLike, activation: ArrayLike = 0.0
    ) -> Float[Array, "10"]:
        """Return the state at rest, shape (10,), for angles [rad] and activations, scalar or (6,).

        Raises ValueError for what is not finite, not of these shapes, in degrees, or a negative
        activation.
        """
        return self._rest(self.skeleton.posture(shoulder, elbow), activation)
