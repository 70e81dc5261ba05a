"""What a plant is: dynamics as a pure function, with its own bounds and nominal control."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._types import Bounds


class AbstractPlant(eqx.Module):
    """Dynamics of a body, as a function of state, control and time.

    A subclass is a frozen dataclass whose physical parameters are array leaves, so that changing
    one does not recompile and every one has a gradient. Sizes are static.

    Attributes:
        nx, nu: sizes of the state and of the control.
        discrete: True when the plant returns the next state rather than the state's derivative.
        control_bounds: lower and upper bounds, each of shape (nu,), or None.
        nominal_control: the control from which an optimisation starts, shape (nu,). Muscles start
            at a small activation: at rest with no activation the gradient is exactly zero.
    """

    nx: eqx.AbstractVar[int]
    nu: eqx.AbstractVar[int]
    discrete: eqx.AbstractVar[bool]
    control_bounds: eqx.AbstractVar[Bounds | None]
    nominal_control: eqx.AbstractVar[Float[Array, " nu"]]

    @abc.abstractmethod
    def __call__(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"], t: ArrayLike
    ) -> Float[Array, " nx"]:
        """Return the derivative of the state (continuous) or the next state (discrete), (nx,)."""


class AbstractHand(AbstractPlant):
    """A plant with a hand that moves in the plane: what every movement task asks for.

    Attributes:
        longest_reach: the largest distance of the hand from the origin [m], shape (); tasks refuse
            goals beyond it.
    """

    longest_reach: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def hand(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the position of the hand [m], shape (2,), at a state x (nx,)."""

    @abc.abstractmethod
    def hand_velocity(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the velocity of the hand [m/s], shape (2,), at a state x (nx,)."""


class AbstractArm(AbstractHand):
    """A plant of joints whose state begins with the joint angles and their velocities.

    State x = (q, dq, ...), with q of shape (num_joints,) in rad and dq in rad/s; the joints obey
    M(q) ddq = tau(x, u) + ..., with tau the torques that the arm is moved by.
    """

    num_joints: eqx.AbstractVar[int]

    @abc.abstractmethod
    def hand_of_joints(self, q: Float[Array, " num_joints"]) -> Float[Array, "2"]:
        """Return the position e(q) of the hand [m], shape (2,), for joint angles q [rad]."""

    @abc.abstractmethod
    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""

    @abc.abstractmethod
    def joint_torque(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"]
    ) -> Float[Array, " num_joints"]:
        """Return the torques tau [N m] by which motors or muscles move the joints, (num_joints,).

        Friction and forces from outside are not among them.
        """

    def hand(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the position e(q) of the hand [m], shape (2,), at a state x (nx,).

        Raises ValueError for another shape; a trajectory goes through `jax.vmap`.
        """
        self._check_state(x)
        return self.hand_of_joints(x[: self.num_joints])

    def hand_velocity(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the velocity of the hand, de/dq dq [m/s], shape (2,); raises as `hand` does."""
        self._check_state(x)
        n = self.num_joints
        return jax.jvp(self.hand_of_joints, (x[:n],), (x[n : 2 * n],))[1]

    def _check_state(self, x) -> None:
        if jnp.shape(x) != (self.nx,):
            raise ValueError(
                f"x: got shape {jnp.shape(x)}, wanted ({self.nx},); a trajectory goes through "
                "jax.vmap(arm.hand)"
            )
