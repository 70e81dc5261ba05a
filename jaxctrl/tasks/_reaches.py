"""Movements of the hand to targets as control problems: reach, hit, avoid, pass through."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from .._checks import check_array, check_integer, check_weights, is_concrete, known
from .._integrate import AbstractIntegrator
from .._plant import AbstractHand
from .._problem import Problem
from .._sensor import AbstractSensor
from ._checks import check_hand, check_reach, grid
from ._costs import HandTarget, Obstacle, ViaPoints
from ._movements import task


def _check_further(task: str, arguments: dict) -> None:
    """Raise TypeError, naming the task, for a further argument that `reach` has not."""
    for name in arguments.keys() - inspect.signature(reach).parameters.keys():
        raise TypeError(f"{task}() got an unexpected keyword argument {name!r}")


def reach(
    plant: AbstractHand,
    target: Float[ArrayLike, " dim"],
    duration: ArrayLike = 0.5,
    *,
    num_steps: int | None = None,
    position_weight: ArrayLike = 1.0,
    velocity_weight: ArrayLike = 0.01,
    effort: ArrayLike = 1e-4,
    motor_noise: ArrayLike | None = None,
    sensor: AbstractSensor | None = None,
    x0_cov: ArrayLike | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Problem:
    """Bring the hand to a target and stop there.

    J = w1 |e(T) - e*|^2 + w2 |de(T)/dt|^2 + int r |u|^2 / 2 dt  (Li 2006, eq. 3.20)

    Arguments:
        plant: any with a hand: an arm, an arm in a force field.
        target: e* [m], shape (dim,): (2,), or (3,) for a hand in space.
        duration: T [s], at most 100 s, so that milliseconds are noticed.
        num_steps: steps in it; by default as many as make the time step about 10 ms. Static.
        position_weight, velocity_weight: w1 [1/m^2] and w2 [s^2/m^2]; 1 and 0.01 are our choice.
        effort: r, weight of the squared control per second; 1e-4 as in Li (2006), eq. 4.20.
        motor_noise: intensity [s^(1/2)] of `SignalDependentNoise`, 0.02 for 20 % over 10 ms; none
            by default. Other noises are added: `reach(...) + jc.AdditiveNoise(...)`.
        sensor, x0_cov: what a controller is told of the state, such as `jc.JointSensor()`, and the
            covariance of the start, shape (nx, nx), as in `Problem`; none by default, where it
            knows the state.
        integrator: as in `Problem`; explicit Euler by default.

    Returns: `Problem`. Raises ValueError or TypeError naming the argument that does not fit.
    """
    return hit(
        plant,
        target,
        jnp.zeros(check_hand(plant).dim),
        duration,
        num_steps=num_steps,
        position_weight=position_weight,
        velocity_weight=velocity_weight,
        effort=effort,
        motor_noise=motor_noise,
        sensor=sensor,
        x0_cov=x0_cov,
        integrator=integrator,
    )


def hit(
    plant: AbstractHand,
    target: Float[ArrayLike, " dim"],
    velocity: Float[ArrayLike, " dim"],
    duration: ArrayLike = 0.5,
    *,
    num_steps: int | None = None,
    position_weight: ArrayLike = 1.0,
    velocity_weight: ArrayLike = 0.01,
    effort: ArrayLike = 1e-4,
    motor_noise: ArrayLike | None = None,
    sensor: AbstractSensor | None = None,
    x0_cov: ArrayLike | None = None,
    integrator: AbstractIntegrator | None = None,
) -> Problem:
    """Bring the hand to a target with a given velocity, as in hitting a ball.

    J = w1 |e(T) - e*|^2 + w2 |de(T)/dt - v*|^2 + int r |u|^2 / 2 dt  (Li 2006, eq. 3.22)

    Arguments as in `reach`, and velocity: v* [m/s], shape (dim,).
    """
    check_weights(position_weight=position_weight, velocity_weight=velocity_weight)
    plant = check_hand(plant)
    target = check_array("target", target, (plant.dim,))
    check_reach(plant, "target", target)
    cost = HandTarget(
        target,
        check_array("velocity", velocity, (plant.dim,)),
        position_weight,
        velocity_weight,
    )
    return task(
        plant, cost, duration, num_steps=num_steps, effort=effort, motor_noise=motor_noise,
        sensor=sensor, x0_cov=x0_cov, integrator=integrator,
    )  # fmt: skip


def obstacle(
    plant: AbstractHand,
    target: Float[ArrayLike, " dim"],
    centre: Float[ArrayLike, " dim"],
    radius: ArrayLike = 0.02,
    duration: ArrayLike = 0.5,
    *,
    obstacle_weight: ArrayLike = 1e-8,
    **reach_arguments,
) -> Problem:
    """Reach a target around a disc that the hand must not enter.

    J = J_reach + k1 int (|e - e_ob| - r_ob)^-2 dt, infinite inside the disc  (Li 2006, eq. 3.21)

    The disc is kept clear at the grid points; between them a fast hand may cut its rim.

    Arguments:
        centre, radius: e_ob [m], shape (dim,), and r_ob [m].
        obstacle_weight: k1 [m^2/s]. The larger beside the rest of the cost, the wider the
            detour: muscles, whose effort is small, go around further than torques do. Either side
            may be a local optimum: try other starts.
        plant, target, duration and all further arguments: as in `reach`.

    Returns: `Problem`. Raises as `reach` does, and ValueError when the disc contains the target;
    `jc.solve` raises it when the disc contains the hand at x0 (under jit: a status). Either needs
    known values.
    """
    _check_further("obstacle", reach_arguments)
    check_weights(radius=radius, obstacle_weight=obstacle_weight)
    problem = reach(plant, target, duration, **reach_arguments)
    centre = check_array("centre", centre, (plant.dim,))
    disc = Obstacle(centre, check_array("radius", radius, ()), obstacle_weight)
    return problem + disc


def via(
    plant: AbstractHand,
    target: Float[ArrayLike, " dim"],
    points: Float[ArrayLike, "m dim"],
    times: Float[ArrayLike, " m"],
    duration: ArrayLike = 0.5,
    *,
    via_weight: ArrayLike = 1.0,
    **reach_arguments,
) -> Problem:
    """Reach a target, passing given points at given times.

    J = J_reach + w sum_i |e(t_i) - e_i|^2  (Li 2006, eq. 3.23, with the sum that it lost)

    Times need not lie on the grid: the state is interpolated linearly, so that they have
    gradients.

    Arguments:
        points: e_i [m], shape (m, dim). times: t_i [s], shape (m,), within the duration.
        via_weight: w [1/m^2], scalar or shape (m,).
        plant, target, duration and all further arguments: as in `reach`.

    Returns: `Problem`. Raises as `reach` does, and ValueError for times outside the movement.
    """
    _check_further("via", reach_arguments)
    check_weights(via_weight=via_weight)
    problem = reach(plant, target, duration, **reach_arguments)
    m = np.shape(times)[0] if np.ndim(times) == 1 else 1
    times = check_array("times", times, (m,))
    points = check_array("points", points, (m, plant.dim), "one row for each of `times`")
    check_reach(plant, "points", points)
    if is_concrete(times, problem.dt):
        known, last = np.asarray(times), problem.num_steps * float(np.asarray(problem.dt))
        if ((known < 0) | (known > last * (1 + 1e-6))).any():
            raise ValueError(f"times: between 0 and {last:.6g} s are wanted, got {known}")
    return problem + ViaPoints(points, times, via_weight)


def centre_out(
    plant: AbstractHand,
    x0: Float[ArrayLike, " nx"],
    *,
    n: int = 8,
    radius: ArrayLike = 0.1,
    duration: ArrayLike = 0.5,
    **reach_arguments,
) -> Problem:
    """Reach from where the hand is to n targets evenly spaced on a circle around it.

    A batch of `reach` problems, each array with a leading axis n: solve it with
    `jax.vmap(lambda problem: jc.solve(problem, jc.ILQR(), x0))(problems)`.

    Arguments:
        x0: the common starting state, shape (nx,).
        n: number of directions, the first along +x, counter-clockwise.
        radius: distance of the targets [m].
        plant, duration and all further arguments: as in `reach`.

    Returns: `Problem` with batched arrays. Raises as `reach` does.
    """
    _check_further("centre_out", reach_arguments)
    n = check_integer("n", n, 1)
    x0 = check_array("x0", x0, (check_hand(plant).nx,))
    if plant.dim != 2:
        raise ValueError(f"plant: a hand in the plane is wanted, got one in {plant.dim} dimensions")
    metres = known(radius)
    if metres is not None and not (metres > 0).all():
        raise ValueError(f"radius: above 0 is wanted, got {radius}")
    num_steps, dt = grid(duration, reach_arguments.pop("num_steps", None))
    angles = 2 * jnp.pi * jnp.arange(n) / n
    offsets = radius * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    targets = plant.hand(x0) + offsets
    check_reach(plant, "radius", targets)

    def problem(target):
        return reach(plant, target, num_steps * dt, num_steps=num_steps, **reach_arguments)

    return jax.vmap(problem)(targets)
