"""The suite `thesis`, chapter 5: what planning with noise, and trials with it, take.

All are reaches of the six-muscle arm, 10 cm in 50 steps, under signal-dependent noise: iterations
of `ILQG` beside those of `ILQR`, many noisy trials, and 16 directions as one batch beside the same
one by one. The bars that they are held to are in `_bars`.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

import jaxctrl as jc

from ..stopwatch import one_core
from ._bars import BATCH, CUT, DIRECTIONS, LOOP, NUM_TRIALS, REACH, TRIALS
from ._solves import Call, converged, first_call, jitted
from ._timing import measure
from ._worker import Emitter

NOISE = 0.02
"""Standard deviation of the signal-dependent noise [s^(1/2)]: 20 % of each control over 10 ms."""
ONE = 6
"""The direction that is reached alone: inwards to the left, at 135 degrees."""


def reaches(noise: float | None) -> tuple[jc.Problem, Any]:
    """Return a batch of reaches, one for each direction, and their start."""
    arm = jc.plants.MuscleArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    return jc.tasks.centre_out(arm, x0, n=DIRECTIONS, num_steps=50, motor_noise=noise), x0


def lane(problems: jc.Problem, i: int) -> jc.Problem:
    """Return one problem of a batch."""
    return jax.tree.map(lambda leaf: leaf[i], problems)


def measured(
    makes: Sequence[Callable[[], Call]], orders: dict[str, Any]
) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Time calls in turns; yield what each returns, and the figures of its times."""
    made = [first_call(make) for make in makes]
    with one_core():
        timings = measure([call for call, _ in made], orders["rounds"], orders["budget"])
    for (call, first), timing in zip(made, timings, strict=True):
        yield call(), {"timing": timing, "first_s": first}


def iterations(orders: dict[str, Any], emit: Emitter) -> None:
    """Measure a reach by ILQR without noise and by ILQG with it, whole and cut short."""
    names, makes = [], []
    for label, solver, noise in (("ILQR", jc.ILQR(), None), ("ILQG", jc.ILQG(), NOISE)):
        problems, x0 = reaches(noise)
        for name, steps in ((REACH, 500), (CUT, 1)):
            names.append((name, label))
            makes.append(partial(jitted, lane(problems, ONE), solver, x0, None, steps))
    for (name, label), (found, figures) in zip(names, measured(makes, orders), strict=True):
        _, cost, code, count = found
        emit(
            "noise", problem=name, solver=label, iterations=int(count), cost=float(cost),
            ok=name == CUT or converged(code), **figures,
        )  # fmt: skip


def trials(orders: dict[str, Any], emit: Emitter) -> None:
    """Measure many noisy trials of ILQG's policy, run from Python."""
    problems, x0 = reaches(NOISE)
    problem, key = lane(problems, ONE), jax.random.key(0)
    policy = jc.solve(problem, jc.ILQG(), x0).policy

    def call():
        return jax.block_until_ready(
            jc.evaluate(problem, policy, x0, key=key, trials=NUM_TRIALS).costs
        )

    for costs, figures in measured([lambda: call], orders):
        emit("noise", problem=TRIALS, solver="evaluate", cost=float(costs.mean()), **figures)


def directions(orders: dict[str, Any], emit: Emitter) -> None:
    """Measure all directions in one batch, run from Python, and one by one, by a jitted solve."""
    problems, x0 = reaches(NOISE)
    each = [lane(problems, i) for i in range(DIRECTIONS)]

    def batch():
        return jax.block_until_ready([jc.solve_batch(problems, jc.ILQG(), x0)])

    @jax.jit
    def one(problem):
        return jc.solve(problem, jc.ILQG(), x0)

    def loop():
        return [jax.block_until_ready(one(problem)) for problem in each]

    makes = [lambda: batch, lambda: loop]
    for name, (found, figures) in zip((BATCH, LOOP), measured(makes, orders), strict=True):
        emit(
            "noise", problem=name, solver="ILQG",
            iterations=int(sum(np.sum(solution.num_steps) for solution in found)),
            cost=float(np.mean([np.mean(solution.cost) for solution in found])),
            ok=all(np.all(solution.status.ok) for solution in found), **figures,
        )  # fmt: skip


def run(orders: dict[str, Any], emit: Emitter) -> None:
    """Carry out the orders."""
    for part in (iterations, trials, directions):
        try:
            part(orders, emit)
        except Exception as error:
            emit.failure(part.__name__, error)
