"""Where muscles run: their lengths as a function of the joint angles."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._parameters import known, parameter, positive

LONGEST_FIBRE = 1.0
"""No muscle's fibres are longer [m]: a number in centimetres is noticed."""


class AbstractPaths(eqx.Module):
    """The paths of m muscles over n joints.

    Lengths are all there is to state. Moment arms are minus their slope, R = -(dL/dq)', since a
    tendon that stores no energy turns the power -T'dL/dt into tau'dq: so tau = R T.

    Attributes:
        n, m: numbers of joints and of muscles; static.
        optimal_length: L0 [m], at which each muscle is strongest, shape (m,).
    """

    n: eqx.AbstractVar[int]
    m: eqx.AbstractVar[int]
    optimal_length: eqx.AbstractVar[Float[Array, " m"]]

    @abc.abstractmethod
    def lengths(self, q: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return the lengths L(q) of the muscles [m], shape (m,), for joint angles q (n,) [rad]."""

    def moment_arms(self, q: Float[Array, " n"]) -> Float[Array, "n m"]:
        """Return R = -(dL/dq)' [m], shape (n, m), for joint angles q (n,) [rad]."""
        return -jax.jacfwd(self.lengths)(q).T

    def velocities(self, q: Float[Array, " n"], dq: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return dL/dt [m/s], shape (m,), for q (n,) [rad] and dq (n,) [rad/s]."""
        return jax.jvp(self.lengths, (q,), (dq,))[1]

    def torque(self, q: Float[Array, " n"], tension: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return R(q) T [N m], shape (n,), for q (n,) [rad] and tensions T (m,) [N]."""
        return -jax.vjp(self.lengths, q)[1](tension)[0]


class CosinePaths(AbstractPaths):
    """Paths whose moment arms are R_ji = alpha_ji + beta_ji cos(c q_j) [m].

    L_i = L0_i l0_i - sum_j (alpha_ji q_j + beta_ji/c sin(c q_j))

    L0 and l0 are such that each muscle runs through exactly its range of lengths while the joints
    go from 0 to pi (Van Wouwe, Ting & De Groote 2022); with constant arms (beta = 0) the same rule
    is our choice. Or L0 is given: then the middle of the range stays where it is, and its width
    follows.

    Arguments:
        alpha, beta: coefficients of the moment arms [m], shape (n, m).
        arm_frequency: c.
        shortest, longest: range of lengths [L0], scalars or (m,).
        optimal_length: L0 [m], scalar or (m,), or None: that of the range.

    Raises ValueError, naming the argument, for a wrong shape, numbers that are not positive, a
    longest length not above the shortest, or a muscle without any moment arm.
    """

    n: int = eqx.field(static=True)
    m: int = eqx.field(static=True)
    alpha: Float[Array, "n m"]
    beta: Float[Array, "n m"]
    arm_frequency: Float[Array, ""]
    shortest: Float[Array, " m"]
    longest: Float[Array, " m"]
    given_length: Float[Array, " m"] | None

    def __init__(
        self,
        alpha: ArrayLike,
        beta: ArrayLike,
        *,
        arm_frequency: ArrayLike,
        shortest: ArrayLike,
        longest: ArrayLike,
        optimal_length: ArrayLike | None = None,
    ):
        if jnp.ndim(alpha) != 2:
            raise ValueError(f"alpha: shape {jnp.shape(alpha)}, wanted (n, m), joints and muscles")
        self.n, self.m = jnp.shape(alpha)
        self.alpha = parameter("alpha", alpha, (self.n, self.m))
        self.beta = parameter("beta", beta, (self.n, self.m))
        self.arm_frequency = positive("arm_frequency", arm_frequency)
        self.shortest = positive("shortest", shortest, (self.m,))
        self.longest = positive("longest", longest, (self.m,))
        self.given_length = None
        if optimal_length is not None:
            self.given_length = positive("optimal_length", optimal_length, (self.m,))
            metres = known(optimal_length)
            if metres is not None and (metres > LONGEST_FIBRE).any():
                raise ValueError(f"optimal_length: {optimal_length}; are these metres?")
        low, high = known(shortest), known(longest)
        if low is not None and high is not None and not (high > low).all():
            raise ValueError(f"longest: above shortest is wanted, got {longest} and {shortest}")
        excursion = known(self.excursion)
        if excursion is not None and (excursion == 0).any():
            raise ValueError("alpha: every muscle needs a moment arm, or its length has no range")

    def _wound(self, q):
        """Return the integral of the arms from 0 to q, summed over the joints [m], (m,)."""
        q = jnp.asarray(q)
        swing = jnp.sin(self.arm_frequency * q) / self.arm_frequency
        return jnp.sum(self.alpha * q[:, None] + self.beta * swing[:, None], axis=0)

    @property
    def excursion(self) -> Float[Array, " m"]:
        """E_i = sum_j (alpha_ji pi + beta_ji/c sin(c pi)) [m], shape (m,); positive for flexors."""
        return self._wound(jnp.full((self.n,), jnp.pi, self.alpha.dtype))

    @property
    def optimal_length(self) -> Float[Array, " m"]:
        """L0 [m], shape (m,): as given, or |E|/(longest - shortest)."""
        if self.given_length is not None:
            return self.given_length
        return jnp.abs(self.excursion) / (self.longest - self.shortest)

    @property
    def length_at_zero(self) -> Float[Array, " m"]:
        """Lengths l0 at q = 0 [L0], shape (m,): the flexors' longest, the extensors' shortest."""
        if self.given_length is not None:
            return 0.5 * (self.shortest + self.longest + self.excursion / self.given_length)
        return jnp.where(self.excursion > 0, self.longest, self.shortest)

    def lengths(self, q: Float[Array, " n"]) -> Float[Array, " m"]:
        """Return the lengths L(q) of the muscles [m], shape (m,), for joint angles q (n,) [rad]."""
        return self.optimal_length * self.length_at_zero - self._wound(q)
