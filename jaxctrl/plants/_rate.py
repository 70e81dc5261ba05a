"""An arm whose torques are part of its state, and whose controls are their rates of change."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._augmented import AbstractAugmented
from .._plant import AbstractArm, nominal_control
from .._types import Bounds
from ._parameters import state_part


class RateControlled(AbstractAugmented, AbstractArm):
    """Control the rate at which an arm's own controls change.

    d(x, c)/dt = (f(x, c, t), u)        (Uno, Kawato & Suzuki 1989, for torques)

    State (x, c), shape (nx + nu,), of the arm's state and the control c that acts on it; control u,
    the rates dc/dt, for torques in N m/s, shape (nu,). So a torque that cannot jump can be asked
    for, and what it costs to change it.

    Arguments:
        arm: any arm without bounds on its controls: here they are states, which have no bounds. It
            is the plant's `inner`.

    Raises ValueError for an arm with bounds or a discrete one, TypeError for what is no arm.
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    num_joints: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    inner: AbstractArm
    control_bounds: Bounds | None
    nominal_control: Float[Array, " nu"]

    def __init__(self, arm: AbstractArm):
        if not isinstance(arm, AbstractArm):
            raise TypeError(f"arm: a plant with joints is wanted, got {type(arm).__name__}")
        if arm.discrete:
            raise ValueError("arm: a continuous plant is wanted, got a discrete one")
        if arm.control_bounds is not None:
            raise ValueError(
                "arm: its controls have bounds, which cannot be kept where they are states; "
                "make it without control_bounds"
            )
        self.nx, self.nu = arm.nx + arm.nu, arm.nu
        self.num_joints, self.discrete = arm.num_joints, False
        self.inner = arm
        self.control_bounds = None
        self.nominal_control = jnp.zeros_like(nominal_control(arm))

    def __call__(self, x, u, t):
        """Return (f(x, c, t), u), shape (nx + nu,)."""
        return jnp.concatenate([self.inner(*self.split(x, u), t), u])

    def split(self, x: Float[Array, " nx"], u: Float[Array, " nu"]):
        """Return the arm's state (n,) and the control c (nu,) that acts on it."""
        return x[: self.inner.nx], self.command(x)

    def command(self, x: Float[Array, " nx"]) -> Float[Array, " nu"]:
        """Return the control c (nu,) that acts on the arm in a state (x, c)."""
        return x[self.inner.nx :]

    def lift(self, x: Float[Array, " n"], command: ArrayLike = 0.0) -> Float[Array, " nx"]:
        """Return the state (x, c) for a state x of the arm and a control c, scalar or (nu,).

        Raises ValueError when either is not finite or of another shape.
        """
        x = state_part("x", x, self.nominal_control, (self.inner.nx,))
        return jnp.concatenate(
            [x, state_part("command", command, self.nominal_control, (self.nu,))]
        )

    @property
    def dim(self) -> int:
        """That of the arm's hand, 2 or 3."""
        return self.inner.dim

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """That of the arm [m], shape ()."""
        return self.inner.longest_reach

    def hand_of_joints(self, q: Float[Array, " n"]) -> Float[Array, "2"]:
        """Return the hand's position [m], shape (2,), for joint angles q (n,) [rad]."""
        return self.inner.hand_of_joints(q)

    def mass_matrix(self, q: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Return M(q) [kg m^2], shape (n, n), for joint angles q (n,) [rad]."""
        return self.inner.mass_matrix(q)

    def joint_torque(self, x: Float[Array, " nx"], u: Float[Array, " nu"]) -> Float[Array, " n"]:
        """Return the torques at the joints [N m], shape (n,), in a state (x, c)."""
        return self.inner.joint_torque(*self.split(x, u))
