"""Movements as control problems: a posture, a swing up, a path to track."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._checks import check_array, check_radians, check_weights, is_concrete, known
from .._cost import QuadraticCost
from .._integrate import AbstractIntegrator
from .._noise import SignalDependentNoise
from .._plant import AbstractArm, AbstractHand, AbstractPlant
from .._problem import Problem
from .._sensor import AbstractSensor
from .._terms import AbstractCost
from .._types import as_bounds
from ._checks import LONGEST, check_hand, check_reach, grid
from ._costs import Effort, HandPath, JointLimits, PostureTarget

LONG = 1000.0
"""The longest duration [s] of what is no single movement of a limb."""


def task(
    plant,
    cost: AbstractCost,
    duration,
    *,
    num_steps,
    effort,
    motor_noise,
    sensor,
    x0_cov,
    integrator,
    longest: float = LONGEST,
) -> Problem:
    """Return a problem of a cost and effort; arguments as in `reach`."""
    check_weights(effort=effort, **({} if motor_noise is None else {"motor_noise": motor_noise}))
    strength = None if motor_noise is None else known(motor_noise)
    if strength is not None and (strength > 1).any():
        raise ValueError(
            f"motor_noise: at most 1 s^(1/2), ten times each control over 10 ms, is wanted, got "
            f"{motor_noise}; 20 % over 10 ms is 0.02"
        )
    num_steps, dt = grid(duration, num_steps, longest)
    noise = None if motor_noise is None else SignalDependentNoise(motor_noise)
    return Problem(
        plant, cost + Effort(effort), num_steps=num_steps, dt=dt, noise=noise, sensor=sensor,
        x0_cov=x0_cov, integrator=integrator,
    )  # fmt: skip


def posture(
    plant: AbstractArm,
    angles: Float[ArrayLike, " num_joints"],
    duration: ArrayLike = 0.5,
    *,
    stop: bool = True,
    num_steps: int | None = None,
    effort: ArrayLike = 1e-4,
    motor_noise: ArrayLike | None = None,
    sensor: AbstractSensor | None = None,
    x0_cov: ArrayLike | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Problem:
    """Bring the joints to given angles.

    J = |theta(T) - theta*|^2 / 2 + |dtheta(T)/dt|^2 / 2 + int r |u|^2 / 2 dt  (Li 2006, eq. 4.20)

    Arguments:
        plant: any arm.
        angles: theta* [rad], shape (num_joints,).
        stop: whether to have the second term. The thesis's text demands it and its formula lacks
            it: `stop=False` gives the formula as printed.
        duration, num_steps, effort, motor_noise, sensor, x0_cov, integrator: as in `reach`.

    Returns: `Problem`. Raises as `reach` does, and ValueError for angles beyond two turns.
    """
    if not isinstance(plant, AbstractArm):
        raise TypeError(f"plant: one with joints is wanted, got {type(plant).__name__}")
    angles = check_array("angles", angles, (plant.num_joints,))
    check_radians("angles", angles)
    cost = PostureTarget(angles, velocity_weight=1.0 if stop else 0.0)
    return task(
        plant, cost, duration, num_steps=num_steps, effort=effort, motor_noise=motor_noise,
        sensor=sensor, x0_cov=x0_cov, integrator=integrator,
    )  # fmt: skip


def swing_up(
    plant: AbstractPlant,
    duration: ArrayLike = 4.0,
    *,
    num_steps: int | None = None,
    effort: ArrayLike = 1e-5,
    motor_noise: ArrayLike | None = None,
    sensor: AbstractSensor | None = None,
    x0_cov: ArrayLike | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Problem:
    """Bring the whole state to zero, as in swinging a pendulum up.

    J = |x(T)|^2 / 2 + int r |u|^2 / 2 dt  (Li 2006, eq. 4.23)

    Arguments:
        plant: one whose wanted end is x = 0, such as `Pendulum`.
        duration: T [s], at most 1000 s; 4 s is our choice.
        effort: r [1/(control unit^2 s)]; 1e-5 as in the thesis.
        num_steps, motor_noise, sensor, x0_cov, integrator: as in `reach`.

    Returns: `Problem`. Raises as `reach` does.
    """
    return task(
        plant, QuadraticCost(Qf=1.0), duration, num_steps=num_steps, effort=effort,
        motor_noise=motor_noise, sensor=sensor, x0_cov=x0_cov, integrator=integrator, longest=LONG,
    )  # fmt: skip


def track(
    plant: AbstractHand,
    path: Float[ArrayLike, "m dim"] | Callable[[Float[Array, ""]], Float[ArrayLike, " dim"]],
    duration: ArrayLike,
    *,
    num_steps: int | None = None,
    path_weight: ArrayLike = 10.0,
    effort: ArrayLike = 1e-4,
    motor_noise: ArrayLike | None = None,
    sensor: AbstractSensor | None = None,
    x0_cov: ArrayLike | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Problem:
    """Follow a path in time with the hand.

    J = int w |e - e*(t)|^2 dt + w dt |e(T) - e*(T)|^2 + int r |u|^2 / 2 dt

    The second term gives the last state the weight of all the others.

    Arguments:
        plant: any with a hand.
        path: e*, positions [m] evenly spaced in time from 0 to T, shape (m, dim), m >= 2, linear in
            between; or a function of the time t [s], written in jax.numpy, that returns one, shape
            (dim,), and is sampled at the grid points. Start the hand where the path starts.
        duration: T [s], at most 1000 s.
        path_weight: w [1/(m^2 s)]; 10 is our choice.
        num_steps, effort, motor_noise, sensor, x0_cov, integrator: as in `reach`.

    Returns: `Problem`. Raises as `reach` does.
    """
    check_weights(path_weight=path_weight)
    num_steps, dt = grid(duration, num_steps, LONG)
    plant = check_hand(plant)
    if isinstance(path, Callable):
        position = path  # may return a list of two
        path = jax.vmap(lambda t: jnp.asarray(position(t)))(jnp.arange(num_steps + 1) * dt)
    shape = np.shape(path)
    if len(shape) != 2 or shape[0] < 2 or shape[1] != plant.dim:
        hint = "; transpose it" if len(shape) == 2 and shape[0] == plant.dim else ""
        raise ValueError(f"path: got shape {shape}, wanted (m, {plant.dim}) with m >= 2{hint}")
    points = check_array("path", path, shape)
    check_reach(plant, "path", points)
    cost = HandPath(points, path_weight, path_weight * dt)
    return task(
        plant, cost, duration, num_steps=num_steps, effort=effort, motor_noise=motor_noise,
        sensor=sensor, x0_cov=x0_cov, integrator=integrator, longest=LONG,
    )  # fmt: skip


def limit_joints(
    problem: Problem,
    lower: ArrayLike,
    upper: ArrayLike,
    *,
    weight: ArrayLike = 1.0,
) -> Problem:
    """Add to a task that the joints stay within limits, softly.

    J + int w sum_j max(0, lower_j - q_j, q_j - upper_j)^2 dt

    The hand alone does not tell an elbow that bends the wrong way: on fast movements with a long
    way to go, turning it through the straight arm may be the cheapest, though no elbow does.

    Arguments:
        problem: a task of an arm.
        lower, upper: limits [rad], scalars or (num_joints,), -inf and inf for none; a human elbow:
            0 to 2.6.
        weight: w [1/(rad^2 s)]; 1 is our choice.

    Returns: `Problem`. Raises TypeError for a plant without joints, ValueError for a wrong shape,
    lower > upper or limits beyond two turns, which can only be degrees.
    """
    check_weights(weight=weight)
    if not isinstance(problem.plant, AbstractArm):
        raise TypeError(
            f"problem: one of a plant with joints is wanted, got {type(problem.plant).__name__}"
        )
    limits = as_bounds((lower, upper), (problem.plant.num_joints,), "lower, upper")
    assert limits is not None
    for name, limit in zip(("lower", "upper"), limits, strict=True):
        check_radians(name, limit)
    if is_concrete(*limits) and not bool((limits[0] <= limits[1]).all()):
        raise ValueError(f"lower: at most upper is wanted, got {limits[0]} and {limits[1]}")
    # A limit that is never reached stands for none: `solve` refuses what is not finite.
    lower, upper = (jnp.clip(limit, -1e6, 1e6) for limit in limits)
    return problem + JointLimits(lower, upper, weight)
