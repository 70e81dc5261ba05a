"""Statics of arms moved by muscles: isometric torques, and the stiffness of joints and hand."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import check_instance, known, shape_of
from .._jit import jit
from ._muscle_arm import AbstractMusculoskeletalArm
from ._parameters import radians

SHORTEST, LONGEST = 0.56, 1.9
"""The lengths [L0] between which the muscles' curves hold, and the muscles pull."""


def isometric_torque(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, " n"]:
    """Return the muscles' torques at the joints [N m], shape (n,), of an arm that is held still.

    tau = R(q) T(a, l(q), 0)

    Arguments:
        arm: moved by m muscles.
        q: joint angles [rad], shape (n,).
        activation: a, scalar or (m,).

    Raises ValueError, naming the argument, for a wrong shape, what is not finite, angles in
    degrees, an activation outside 0 to 1, or a posture in which a muscle is shorter than 0.56
    optimal lengths, where it would push (`passive_force`), or longer than 1.9, where the curves do
    not hold; where these can be known. TypeError for an arm without muscles.
    """
    return _torque(arm, *_posture(arm, q, activation))


def joint_stiffness(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, "n n"]:
    """Return the stiffness of the joints [N m/rad], shape (n, n), activations held constant.

    K_q = -d tau/dq = -(dR/dq) T - R (dT/dl) (dl/dq)

    It is symmetric, since the torques of given activations have a potential. It may have negative
    eigenvalues: where moment arms grow with the angle that a muscle turns its joint to, and on the
    falling branch of the force-length curve.

    Arguments, and what is refused: as `isometric_torque`.
    """
    return _joint_stiffness(arm, *_posture(arm, q, activation))


def endpoint_stiffness(
    arm: AbstractMusculoskeletalArm, q: ArrayLike, activation: ArrayLike
) -> Float[Array, "dim dim"]:
    """Return the stiffness of the hand [N/m], shape (dim, dim), activations held constant.

    K = (G (K_q - d(G'F)/dq)^-1 G')^-1,  G = dp/dq,  G'F = -tau

    A load K dp moves the hand by dp from the posture q, in which the force F holds the muscles'
    torques. With as many joints as coordinates K = G^-T (K_q - d(G'F)/dq) G^-1 (Mussa-Ivaldi, Hogan
    & Bizzi 1985; the second term is geometric: McIntyre, Mussa-Ivaldi & Bizzi 1996). With more, F
    is that of least squares, and what torque is left is held at the joints. A straight arm lets
    the hand move to one side only; along itself what comes out is round-off over round-off.

    Arguments, and what is refused: as `isometric_torque`.
    """
    return _endpoint_stiffness(arm, *_posture(arm, q, activation))


def _posture(arm, q, activation):
    """Check what is known of the arguments, which within a compiled function nothing would be."""
    check_instance(
        "arm", arm, AbstractMusculoskeletalArm, "an arm moved by muscles, MuscleArm() or its like"
    )
    if shape_of(q) != (arm.skeleton.n,):
        raise ValueError(f"q: shape {shape_of(q)}, wanted ({arm.skeleton.n},)")
    q = radians("q", q, arm.muscles.pcsa, (arm.skeleton.n,))
    lengths = known(arm.muscle_length(q))
    if lengths is not None and ((lengths < SHORTEST) | (lengths > LONGEST)).any():
        raise ValueError(
            f"q: {q} gives the muscles lengths {lengths.round(3)} L0; their curves hold, and "
            f"muscles pull, from {SHORTEST:g} to {LONGEST:g}"
        )
    return q, arm.as_activation(activation)


@jit
def _torque(arm, q, a):
    still = jnp.zeros_like(arm.paths.optimal_length)
    return arm.paths.torque(q, arm.muscles.tension(a, arm.muscle_length(q), still))


@jit
def _joint_stiffness(arm, q, a):
    return -jax.jacfwd(lambda q: _torque(arm, q, a))(q)


@jit
def _endpoint_stiffness(arm, q, a):
    torque, jacobian = _torque(arm, q, a), jax.jacfwd(arm.skeleton.hand)
    G = jacobian(q)
    force = -jnp.linalg.solve(G @ G.T, G @ torque)
    geometric = jax.jacfwd(lambda q: jacobian(q).T @ force)(q)
    stiffness = _joint_stiffness(arm, q, a) - geometric
    return jnp.linalg.inv(G @ jnp.linalg.solve(stiffness, G.T))
