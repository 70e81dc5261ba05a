"""What the comparisons of chapter 4 of Li (2006) share: problems, random starts, timed solves."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.stats import norm

import jaxctrl as jc

TARGET = np.array([1.0, 1.5])
START = (1.5, 1.5)
COSTS = {"stop": "with a stopping term", "printed": "(4.20) as printed"}
"""The two costs of the arms, (4.20) with the term that the thesis's text asks for, and without."""
WINDOW = np.array([[0.95, 1.3], [1.55, 1.6]])
"""The axes of the thesis's figures 4.2 and 4.4: shoulder and elbow, from and to [rad]."""
SMOOTHING = 0.025
"""Standard deviation in time of the filter that makes random controls smooth [s]."""


class Case(NamedTuple):
    """One problem with its start x0 (nx,)."""

    problem: jc.Problem
    x0: jax.Array


def arm_case(
    kind: str,
    num_steps: int,
    *,
    stop: bool = True,
    duration: float = 0.5,
    effort: float = 1e-4,
) -> Case:
    """Return a movement of the "torque" or the "muscle" arm from (1.5, 1.5) to (1, 1.5) rad.

    Cost (4.20) with r = `effort`, T = `duration` [s]; `stop` adds the term that the thesis's text
    asks for and its formula lacks. The start is our choice.
    """
    arm = jc.plants.TorqueArm() if kind == "torque" else jc.plants.MuscleArm()
    return Case(
        jc.tasks.posture(arm, TARGET, duration, num_steps=num_steps, stop=stop, effort=effort),
        arm.at_rest(*START),
    )


def pendulum_case(duration: float, num_steps: int) -> Case:
    """Return the swing-up of the hanging pendulum in a duration [s], cost (4.23), r = 1e-5."""
    return Case(
        jc.tasks.swing_up(jc.plants.Pendulum(), duration, num_steps=num_steps),
        jnp.array([np.pi, 0.0]),
    )


def random_controls(case: Case, count: int, amplitude: float, seed: int) -> np.ndarray:
    """Return smooth random controls, shape (count, T, nu).

    White noise through a Gaussian filter of 25 ms, scaled to N(0, 1) at each time. Without bounds
    times the amplitude [N m]; for muscles mapped to U[0, amplitude] at each time. The thesis does
    not say how its 100 starts were drawn.
    """
    problem, rng = case.problem, np.random.default_rng(seed)
    width = SMOOTHING / float(problem.dt)
    pad = int(np.ceil(5 * width))
    shape = (count, problem.num_steps + 2 * pad, problem.plant.nu)
    impulse = np.zeros(2 * pad + 1)
    impulse[pad] = 1.0
    gain = np.sqrt(np.sum(gaussian_filter1d(impulse, width) ** 2))
    z = gaussian_filter1d(rng.standard_normal(shape), width, axis=1)[:, pad:-pad] / gain
    return amplitude * (z if problem.bounds is None else norm.cdf(z))


@eqx.filter_jit
def iterate(case: Case, solver: jc.AbstractSolver, us, limit, after: Callable[[Any], Any] | None):
    """Iterate until the solver stops, or to iterate `limit`, an integer that is not static.

    `after`, if given, changes the solver's state after each iteration.

    Returns: the iterate's cost and its number, both of shape ().
    """

    def unfinished(carry):
        state, count = carry
        return solver.status(state).is_(jc.Reason.RUNNING) & (count <= limit)

    def body(carry):
        state, count = carry
        state = solver.step(case.problem, state, jnp.array(False))
        return state if after is None else after(state), count + 1

    start = (solver.init(case.problem, case.x0, us), jnp.array(0))
    state, count = jax.lax.while_loop(unfinished, body, start)
    return solver.record(state).cost, count - 1


@eqx.filter_jit
def paths_of(case: Case, uss: jax.Array, shown: tuple[int, ...]) -> jax.Array:
    """Return the joint angles of an arm in some iterations of ILQR, (shown, start, time, joint).

    Iteration 0 is the first step from the controls of each start, uss (start, T, nu).
    """
    problem, solver = case.problem, jc.ILQR()

    def each(us):
        def body(state, _):
            state = solver.step(problem, state, jnp.array(False))
            return state, solver.found(problem, state).xs[:, :2]

        state = solver.init(problem, case.x0, us)
        return jax.lax.scan(body, state, length=max(shown) + 1)[1][jnp.array(shown)]

    return jnp.moveaxis(jax.lax.map(each, uss), 0, 1)


def timed(case: Case, solver: jc.AbstractSolver) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Return a function of (us, limit, count), for `in_turns`: solve `count` times, to iterate
    `limit`, in one compiled call.

    The solves follow one another inside: shared out among many, what the call itself takes, several
    iterations of a small problem, does not count. It returns the cost and the number
    of the last iterate, both of shape ().
    """
    arrays, static = eqx.partition((case, solver), eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)

    @jax.jit
    def repeated(leaves, us, limit, count):
        case, solver = eqx.combine(jax.tree.unflatten(tree, leaves), static)

        def body(_, last):  # which each needs from the one before: none can be left out
            return iterate(case, solver, us + 0 * last[0], limit, None)

        return jax.lax.fori_loop(0, count, body, (jnp.zeros((), us.dtype), jnp.array(0)))

    return lambda us, limit, count: jax.block_until_ready(repeated(leaves, us, limit, count))


def outside(paths: np.ndarray, window: np.ndarray) -> str:
    """Say how far joint angles, paths (..., joint) [rad], lie outside a window (2, joint).

    Returns: such as "elbow to 1.12", or nothing.
    """
    flat = paths.reshape(-1, 2)
    low, high = np.nanmin(flat, axis=0), np.nanmax(flat, axis=0)
    words = []
    for i, joint in enumerate(("shoulder", "elbow")):
        ends = [end for end in (low[i], high[i]) if not window[0, i] <= end <= window[1, i]]
        if ends:
            words.append(f"{joint} to " + " and ".join(f"{end:.2f}" for end in ends))
    return ", ".join(words)


def first_within(costs: np.ndarray, best: float, near: Sequence[float]) -> list[float]:
    """Return the first of the costs (n,) within each tolerance of the best one, NaN if none is."""
    hits = [costs <= best * (1 + tolerance) for tolerance in near]
    return [float(np.argmax(hit)) if hit.any() else np.nan for hit in hits]
