"""The two-link planar arm moved by joint torques."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._types import Bounds, as_bounds
from ._skeleton import AbstractSkeletalArm, TwoLinkArm


class TorqueArm(AbstractSkeletalArm):
    """Move a two-link arm in the horizontal plane by torques at shoulder and elbow.

    ddq = M(q)^-1 (u - C(q, dq) - B dq)        (Li 2006, eq. 3.6; model 1 of section 4.3)

    State x = (shoulder, elbow [rad], their rates [rad/s]), shape (4,); control u, the torques
    [N m], shape (2,).

    Arguments:
        control_bounds: (lower, upper) [N m], scalars or of shape (2,), or None.
        skeleton: m2, l1, l2, s2, I1, I2, friction, as `TwoLinkArm` takes them.

    Raises ValueError for what `TwoLinkArm` refuses.
    """

    nx: ClassVar[int] = 4
    nu: ClassVar[int] = 2
    skeleton: TwoLinkArm
    control_bounds: Bounds | None

    def __init__(
        self, *, control_bounds: tuple[ArrayLike, ArrayLike] | None = None, **skeleton: ArrayLike
    ):
        self.skeleton = TwoLinkArm(**skeleton)
        self.control_bounds = as_bounds(control_bounds, (2,))

    def __call__(self, x, u, t):
        """Return (dq, M^-1 (u - C - B dq)), shape (4,)."""
        return jnp.concatenate([x[2:], self.skeleton.acceleration(x[:2], x[2:], u)])

    def joint_torque(self, x: Float[Array, "4"], u: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the torques at shoulder and elbow [N m], shape (2,): the control u (2,) itself."""
        return u

    def inverse_kinematics(self, hand: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return joint angles (2,) [rad] for a hand position (2,) [m]; see `TwoLinkArm`."""
        return self.skeleton.inverse_kinematics(hand)

    def coriolis(self, q: Float[Array, "2"], dq: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return C(q, dq) [N m], shape (2,), for q (2,) [rad] and dq (2,) [rad/s]."""
        return self.skeleton.coriolis(q, dq)

    def at_rest(self, shoulder: ArrayLike, elbow: ArrayLike) -> Float[Array, "4"]:
        """Return the state (shoulder, elbow, 0, 0), shape (4,), for angles in rad.

        Raises ValueError when an angle is not a finite scalar, or can only be in degrees.
        """
        q = self.skeleton.posture(shoulder, elbow)
        return jnp.concatenate([q, jnp.zeros_like(q)])
