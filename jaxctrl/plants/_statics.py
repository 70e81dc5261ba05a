"""Statics of arms moved by muscles: isometric torques, and the stiffness of joints and hand."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._jit import jit
from ._muscle_arm import AbstractMusculoskeletalArm
from ._parameters import state_part


@jit
def isometric_torque(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, " n"]:
    """Return the muscles' torques at the joints [N m], shape (n,), of an arm that is held still.

    tau = R(q) T(a, l(q), 0)

    Arguments:
        arm: moved by m muscles.
        q: joint angles [rad], shape (n,).
        activation: a, scalar or (m,).

    Raises ValueError, naming the argument, for a wrong shape.
    """
    return _torque(arm, *_posture(arm, q, activation))


@jit
def joint_stiffness(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, "n n"]:
    """Return the stiffness of the joints [N m/rad], shape (n, n), activations held constant.

    K_q = -d tau/dq = -(dR/dq) T - R (dT/dl) (dl/dq)

    It is symmetric, since the torques of given activations have a potential. Where a muscle is on
    the falling branch of its force-length curve, it may have negative eigenvalues.

    Arguments: as `isometric_torque`. Raises ValueError, naming the argument, for a wrong shape.
    """
    q, a = _posture(arm, q, activation)
    return -jax.jacfwd(lambda q: _torque(arm, q, a))(q)


@jit
def endpoint_stiffness(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, "dim dim"]:
    """Return the stiffness of the hand [N/m], shape (dim, dim), activations held constant.

    K = (G (K_q - d(G'F)/dq)^-1 G')^-1,  G = dp/dq,  G'F = -tau

    A load -K dp moves the hand by dp from the posture q, in which the force F holds the muscles'
    torques. With as many joints as coordinates K = G^-T (K_q - d(G'F)/dq) G^-1 (Mussa-Ivaldi, Hogan
    & Bizzi 1985; the second term is geometric: McIntyre, Mussa-Ivaldi & Bizzi 1996). With more, F
    is that of least squares, and what torque is left is held at the joints. NaN or infinite where
    the arm is straight.

    Arguments: as `isometric_torque`. Raises ValueError, naming the argument, for a wrong shape.
    """
    q, a = _posture(arm, q, activation)
    torque, jacobian = _torque(arm, q, a), jax.jacfwd(arm.skeleton.hand)
    G = jacobian(q)
    force = -jnp.linalg.solve(G @ G.T, G @ torque)
    geometric = jax.jacfwd(lambda q: jacobian(q).T @ force)(q)
    stiffness = -jax.jacfwd(lambda q: _torque(arm, q, a))(q) - geometric
    return jnp.linalg.inv(G @ jnp.linalg.solve(stiffness, G.T))


def _posture(arm, q, activation):
    q = state_part("q", q, arm.muscles.pcsa, (arm.skeleton.n,))
    return q, state_part("activation", activation, arm.muscles.pcsa, (arm.muscles.m,))


def _torque(arm, q, a):
    still = jnp.zeros_like(arm.paths.optimal_length)
    return arm.paths.torque(q, arm.muscles.tension(a, arm.muscle_length(q), still))
