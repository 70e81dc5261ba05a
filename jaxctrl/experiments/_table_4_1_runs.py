"""The solves of table 4.1, timed."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..solvers import DDP, ILQR, LBFGS, BoundaryValue, ConjugateGradient
from ..solvers._abstract import AbstractDirectSolver, AbstractSolver
from ..solvers._batch import best as best_of, solve_batch
from ..solvers._solution import Solution
from ..solvers._solve import solve
from ._chapter_4 import Case, first_within, iterate, random_controls, seconds, times_to

METHODS = {
    "ILQR": ILQR,
    "DDP": DDP,
    "CG": ConjugateGradient,
    "L-BFGS": LBFGS,
    "BVP": BoundaryValue,
}
NEAR = (1e-2, 1e-3, 1e-4)
AMPLITUDE = {True: 0.3, False: 1.0}
"""Amplitude of the random starts, with and without bounds."""


LONG = 20.0
"""A first call that takes longer [s] is timed once more, not thrice."""


class Row(NamedTuple):
    """What one method did on one problem; see the variables of the table's result."""

    cost: float
    status: str
    steps: int
    seconds: list[float]
    spread: list[float]
    iterations: list[float]
    first: float


def measure(case: Case, config: Any) -> tuple[list[Row], float, tuple[float, float]]:
    """Return a row for each method, the best cost known, and how ILQR fares undamped."""
    us = case.problem.nominal_controls
    first = {name: _first(case, method(), config) for name, method in METHODS.items()}
    starts = random_controls(
        case, config.starts, AMPLITUDE[case.problem.bounds is not None], config.seed
    )
    found = best_of(solve_batch(case.problem, ILQR(), case.x0, jnp.asarray(starts)))
    polished = solve(case.problem, DDP(), case.x0, found.us)
    solutions = [solution for solution, _ in first.values()]
    costs = [float(each.cost) for each in (*solutions, found, polished)]
    best = min(cost for cost in costs if np.isfinite(cost))
    rows = [_row(case, METHODS[name](), *first[name], best, config) for name in METHODS]
    cost, count = iterate(case, ILQR(), us, config.max_steps, _undamp)
    return rows, best, (float(cost) / best - 1, float(count))


def _first(case: Case, solver: AbstractSolver, config: Any) -> tuple[Solution, float]:
    """Solve with nothing compiled before; return the solution and the time [s]."""
    found: list[Solution] = []

    def call():
        found.append(solve(case.problem, solver, case.x0, max_steps=config.max_steps))
        return found[0].cost

    jax.clear_caches()
    taken = seconds(call)
    return found[0], taken


def _row(
    case: Case, solver: AbstractSolver, solution: Solution, first: float, best: float, config: Any
) -> Row:
    """Time how soon a solver comes near the best cost: by its history, or by its end."""
    cost = float(solution.cost)
    if isinstance(solver, AbstractDirectSolver):
        iterates = [np.nan] * len(NEAR)
        reached = np.array([cost <= best * (1 + near) for near in NEAR])
        calls = range(1 if first > LONG else min(3, config.repeats))
        taken = [[seconds(lambda: solve(case.problem, solver, case.x0).cost)] for _ in calls]
        times = np.where(reached, np.array(taken), np.nan)
    else:
        iterates = first_within(np.asarray(solution.history.cost), best, NEAR)
        reached = ~np.isnan(iterates)
        times = np.full((config.repeats, len(NEAR)), np.nan)
        limits = [i for i in iterates if not np.isnan(i)]
        us = case.problem.nominal_controls
        times[:, reached] = times_to(case, solver, us, limits, config.repeats)
    quarter, half, three = np.percentile(times, (25, 50, 75), axis=0)
    return Row(
        cost=cost,
        status=solution.status.name,
        steps=int(solution.num_steps),
        seconds=half.tolist(),
        spread=((three - quarter) / 2).tolist(),
        iterations=iterates,
        first=first,
    )


def _undamp(state):
    return eqx.tree_at(lambda s: s.lam, state, jnp.zeros_like(state.lam))
