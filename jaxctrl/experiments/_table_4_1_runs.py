"""The solves of table 4.1, timed."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxctrl as jc

from ._chapter_4 import Case, first_within, iterate, random_controls, timed
from ._differences import DifferencedDDP
from ._table_4_1_claims import BY_DIFFERENCES

METHODS = {
    "ILQR": jc.ILQR,
    "DDP": jc.DDP,
    "textbook DDP": partial(jc.DDP, start="exact"),
    "CG": jc.ConjugateGradient,
    "L-BFGS": jc.LBFGS,
    "BVP": jc.BoundaryValue,
}
NEAR = (1e-1, 1e-2, 1e-4)
AMPLITUDE = {True: 0.3, False: 1.0}
"""Amplitude of the random starts, with and without bounds."""


LONG = 20.0
"""A first call that takes longer [s] is timed once more, not thrice."""


def methods(config: Any) -> dict[str, Any]:
    """Return the methods of a run, by name."""
    return METHODS | ({BY_DIFFERENCES: DifferencedDDP} if config.differences else {})


class Row(NamedTuple):
    """What one method did on one problem; see the variables of the table's result."""

    cost: float
    status: str
    steps: int
    accepted: int
    seconds: list[float]
    spread: list[float]
    wall: list[float]
    iterations: list[float]
    first: float


def measure(case: Case, config: Any) -> tuple[list[Row], float, tuple[float, float]]:
    """Return a row for each method, the best cost known, and how ILQR fares undamped."""
    us = case.problem.nominal_controls
    jax.clear_caches()  # what has been solved before must not shorten the first calls
    each = methods(config)
    first = {name: _first(case, method(), config) for name, method in each.items()}
    solutions = [solution for solution, _ in first.values()]
    costs = [*(float(solution.cost) for solution in solutions), _search(case, config)]
    best = min(cost for cost in costs if np.isfinite(cost))
    iterates, times = _times(case, first, best, config)
    rows = [_row(*first[name], iterates[name], times[name]) for name in each]
    cost, count = iterate(case, jc.ILQR(), us, config.max_steps, _undamp)
    return rows, best, (float(cost) / best - 1, float(count))


def _search(case: Case, config: Any) -> float:
    """Return the lowest cost of ILQR from random controls, continued by DDP; inf from none."""
    if not config.starts:
        return np.inf
    amplitude = AMPLITUDE[case.problem.bounds is not None]
    starts = jnp.asarray(random_controls(case, config.starts, amplitude, config.seed))
    found = jc.best(jc.solve_batch(case.problem, jc.ILQR(), case.x0, starts))
    polished = jc.solve(case.problem, jc.DDP(), case.x0, found.us)
    return min(float(found.cost), float(polished.cost))


def _first(case: Case, solver: jc.AbstractSolver, config: Any) -> tuple[jc.Solution, float]:
    """Solve for the first time, and so compile; return the solution and the wall time [s]."""
    found: list[jc.Solution] = []

    def solve(x0):
        return jc.solve(case.problem, solver, x0, max_steps=config.max_steps)

    # Compiled as a whole: small operations outside are shared, and whoever came first would pay.
    whole = solve if isinstance(solver, jc.AbstractDirectSolver) else eqx.filter_jit(solve)

    def call():
        found.append(jax.block_until_ready(whole(case.x0)))

    taken = jc.stopwatch.take(jc.stopwatch.repeated(call))
    return found[0], taken.wall


def _times(
    case: Case, first: dict[str, tuple[jc.Solution, float]], best: float, config: Any
) -> tuple[dict[str, list[float]], dict[str, np.ndarray]]:
    """Time how soon the methods come near the best cost: by their histories, or by their ends.

    Returns, by method, the iterates (NEAR,), and the processor and wall times [s], each (repeats,
    NEAR), stacked; NaN where it does not come.
    """
    iterates, times, calls, places = {}, {}, [], []
    for name, (solution, taken) in first.items():
        solver = methods(config)[name]()
        if isinstance(solver, jc.AbstractDirectSolver):
            iterates[name] = [np.nan] * len(NEAR)
            whole = jc.stopwatch.repeated(partial(jc.solve, case.problem, solver, case.x0))
            with jc.stopwatch.one_core():
                again = range(1 if taken > LONG else min(3, config.repeats))
                took = np.array([jc.stopwatch.take(whole) for _ in again]).T
            reached = float(solution.cost) <= best * (1 + np.array(NEAR))
            times[name] = np.where(reached, took[..., None], np.nan)
        else:
            iterates[name] = first_within(np.asarray(solution.history.cost), best, NEAR)
            times[name] = np.full((2, config.repeats, len(NEAR)), np.nan)
            near = np.flatnonzero(~np.isnan(iterates[name]))
            to, us = timed(case, solver), case.problem.nominal_controls
            calls += [partial(to, us, int(iterates[name][i])) for i in near]
            places += [(name, i) for i in near]
    taken = np.array(jc.stopwatch.in_turns(calls, config.repeats))
    for k, (name, i) in enumerate(places):
        times[name][:, :, i] = taken[:, :, k]
    return iterates, times


def _row(solution: jc.Solution, first: float, iterates: list[float], times: np.ndarray) -> Row:
    quarter, half, three = np.percentile(times[0], (25, 50, 75), axis=0)
    return Row(
        cost=float(solution.cost),
        status=solution.status.name,
        steps=int(solution.num_steps),
        accepted=int((np.asarray(solution.history.step) > 0).sum()),
        seconds=half.tolist(),
        spread=((three - quarter) / 2).tolist(),
        wall=np.median(times[1], axis=0).tolist(),
        iterations=iterates,
        first=first,
    )


def _undamp(state):
    return eqx.tree_at(lambda s: s.lam, state, jnp.zeros_like(state.lam))
