"""The duration of a movement, and when it passes its via-points, as variables of the optimum."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, ArrayLike

from .._checks import is_concrete
from .._jit import jit
from .._problem import Problem, check_us, check_x0
from .._solution import Solution
from .._solve import solve
from .._terms import AbstractCost, AbstractEvents, terms
from ..solvers import AbstractSolver

GAP = 0.02
"""Least time between two events, as a fraction of the duration; our choice."""

SLACK = 1e-6
"""By how much of the first duration a gap may be too small: the search's own round-off."""

FIRST = 0.2
"""Largest first change of a time, as a fraction of the duration; our choice."""


@dataclass(frozen=True, repr=False)
class OptimalTimes:
    """Hold a movement whose times were optimised.

    Arguments:
        problem: the problem with these times. solution: its solution.
        value: J + price T, at these times.
        duration: T [s]. times: passing times t_i [s], shape (m,).
        ok: whether the search over times, and every solve on its way, converged.
        message: what SciPy or the solve says of it.
        history: the values of J + price T that were tried, in order.
    """

    problem: Problem
    solution: Solution
    value: float
    duration: float
    times: np.ndarray
    ok: bool
    message: str
    history: tuple[float, ...]

    def __str__(self) -> str:
        head = f"Optimal times, {'converged' if self.ok else 'NOT converged'}"
        rows = [
            ("value", f"{self.value:.6g}"),
            ("duration", f"{self.duration:.6g} s"),
            ("evaluations", f"{len(self.history)}"),
        ]
        if self.times.size:
            rows.insert(2, ("passing", ", ".join(f"{t:.6g}" for t in self.times) + " s"))
        return "\n".join([head, *(f"  {n:<12}{v}" for n, v in rows), f"  {self.message}"])

    __repr__ = __str__


def optimise_times(
    problem: Problem,
    solver: AbstractSolver,
    x0: ArrayLike,
    us: ArrayLike | None = None,
    *,
    duration: tuple[float, float] | None = None,
    price: ArrayLike = 0.0,
    passing: bool = False,
) -> OptimalTimes:
    """Choose a movement's duration, or when it passes its via-points, at the least total cost.

    minimise  J*(T, t_1 ... t_m) + price T,  J* the optimal cost for fixed times

    by SciPy's SLSQP with the exact derivatives of J* (the envelope theorem, through `solve`). The
    number of steps stays, the time step follows the duration. Passing times that are free keep the
    order they begin in, and are kept apart, and from start and end, by a fiftieth of the duration.
    Each solve starts from the controls of the best one so
    far: the optimum is a local one. Between two grid points a path is linear, so that the optimal
    cost has a slight kink where a passing time meets a grid point, and the search may end in one:
    with more steps it ends closer to the optimum.

    Arguments:
        problem: what to move; a continuous plant. Via-points are all costs that are
            `AbstractEvents`, your own too; what depends on `at.s`, as a tracked path does, is
            stretched with the duration.
        solver, x0, us: as in `jc.solve`; us is the start of the first solve.
        duration: least and largest T [s] when T is free; given passing times stay what they are.
            None leaves T as it is.
        price: cost of a second. With a free duration it should be positive: slower is cheaper.
        passing: whether the passing times of via-points are free.

    Returns: `OptimalTimes`; look at `ok`.

    Raises ValueError or TypeError, naming the argument, for what does not fit: no free time, a pair
    that is no range, no via-points, a discrete plant.
    """
    if not isinstance(problem, Problem):
        raise TypeError(f"problem: a jc.Problem is wanted, got {problem!r}")
    if not is_concrete(x0, *jax.tree.leaves(eqx.filter(problem, eqx.is_array))):
        raise ValueError(
            "problem, x0: known values are wanted, got traced ones (under jit or grad)"
        )
    if problem.plant.discrete:
        raise ValueError(
            "problem: one of a continuous plant is wanted, whose steps can be longer or shorter, "
            f"got the discrete plant {type(problem.plant).__name__}"
        )
    x0, us = check_x0(problem, x0), check_us(problem, us)
    start = float(problem.duration)
    given = _passing(problem.cost)
    if duration is None and not passing:
        raise ValueError("duration, passing: at least one is wanted, or no time is free")
    if passing and not given.size:
        raise ValueError("passing: the problem has no via-points whose times could be free")
    low, high = _range(duration, start, _fixed(problem.cost, passing))
    search = _Search(problem, solver, x0, us, jnp.asarray(price, x0.dtype), given, passing)
    begin = np.concatenate([[np.clip(start, low, high)], given[: given.size * passing]])
    try:
        found = scipy.optimize.minimize(
            search,
            begin / start,
            jac=True,
            method="SLSQP",
            bounds=[(low / start, high / start)] + [(0.0, high / start)] * (begin.size - 1),
            constraints=search.constraints(),
            options={"ftol": 1e-9, "maxiter": 100},
        )
    except _Failed as error:
        return search.result(False, f"a solve on the way failed: {error}")
    message = found.message + search.remarks(low, high, passing)
    return search.result(bool(found.success) and search.apart, message)


def _range(duration, now: float, fixed: np.ndarray) -> tuple[float, float]:
    """Return the least and largest duration [s], checked against passing times that stay."""
    pair = (now, now) if duration is None else duration
    if np.shape(pair) != (2,) or not 0 < pair[0] <= pair[1] < np.inf:
        raise ValueError(f"duration: a pair 0 < low <= high [s] is wanted, got {duration}")
    if fixed.size and fixed.max() > pair[1]:
        raise ValueError(
            f"duration: a via-point is passed at {fixed.max():g} s, after the largest duration, "
            f"{pair[1]:g} s; free the passing times too"
        )
    return pair


class _Failed(Exception):
    """Report that a solve did not converge."""


class _Search:
    """The value of the times, in units of the first duration, and its gradient, for SciPy."""

    def __init__(self, problem, solver, x0, us, price, given, passing):
        self.problem, self.solver, self.x0, self.us, self.price = problem, solver, x0, us, price
        self.given, self.passing = given, passing
        self.order = np.argsort(given, kind="stable")  # parts of a cost may stand in any
        self.unit = float(problem.duration)
        self.scale: float | None = None
        self.history: list[float] = []
        self.best: tuple[float, np.ndarray, Any] | None = None
        self.apart = False  # whether the best keeps the gaps: the times given may not

    def seconds(self, variables) -> tuple[float, np.ndarray]:
        """Return the duration and the passing times [s]."""
        times = self.unit * np.asarray(variables[1:]) if self.passing else self.given
        return self.unit * float(variables[0]), times

    def gaps(self, variables) -> np.ndarray:
        """Return how much more than wanted lies between neighbours, start and end among them.

        Where passing times stay, all that is wanted is that the last is not after the end.
        """
        duration, times = self.seconds(variables)
        ends = np.concatenate([[0.0], times[self.order], [duration]])
        apart = np.diff(ends)[-1:] if not self.passing else np.diff(ends) - GAP * duration
        return apart / self.unit

    def constraints(self):
        """Keep the events in order, between start and end; none where there is no event."""
        return {"type": "ineq", "fun": self.gaps} if self.given.size else ()

    def allowed(self, variables) -> bool:
        """Tell whether a trial keeps the gaps, which SLSQP leaves on its way."""
        return not self.given.size or bool((self.gaps(variables) >= -SLACK).all())

    def __call__(self, variables) -> tuple[float, np.ndarray]:
        duration, times = self.seconds(variables)
        leaves = (jnp.asarray(duration, self.x0.dtype), jnp.asarray(times, self.x0.dtype))
        (value, solution), slopes = _value(
            leaves, self.problem, self.solver, self.x0, self.us, self.price
        )
        value, ok = float(value), bool(solution.status.ok)
        self.history.append(value)
        allowed = self.allowed(variables)
        if self.best is None or (ok and allowed and (value < self.best[0] or not self.apart)):
            self.apart = allowed
            self.best = (value, np.array(variables), solution)
            self.us = solution.us
        if not ok:
            raise _Failed(solution.status.message)
        slope = self.unit * np.concatenate(
            [[slopes[0]], slopes[1] if self.passing else []], dtype=float
        )
        if self.scale is None:  # SLSQP's first step is the gradient's: far away is another optimum
            self.scale = max(abs(value), np.abs(slope).max() / FIRST, 1e-300)
        return value / self.scale, slope / self.scale

    def remarks(self, low: float, high: float, passing: bool) -> str:
        """Say where the best times lie at a limit or, in a kink, on a grid point."""
        assert self.best is not None
        duration, times = self.seconds(self.best[1])
        said = "" if self.apart else "; no times that are far enough apart were found"
        for limit, name in ((low, "lower"), (high, "upper")):
            if low < high and abs(duration - limit) < 1e-3 * high:
                said += f"; the duration is at its {name} limit"
        position = times / duration * self.problem.num_steps
        if passing and (np.abs(position - np.round(position)) < 1e-3).any():
            said += "; a passing time lies on a grid point, in a kink: more steps tell more"
        return said

    def result(self, ok: bool, message: str) -> OptimalTimes:
        """Return the best of what was tried."""
        assert self.best is not None
        value, variables, solution = self.best
        duration, times = self.seconds(variables)
        problem = with_times(self.problem, jnp.asarray(duration), jnp.asarray(times))
        history = tuple(self.history)
        return OptimalTimes(
            problem, solution, value, duration, np.asarray(times), ok, message, history
        )


@jit
def _value(leaves, problem, solver, x0, us, price):
    """Return ((J + price T, solution), derivatives by T and the passing times)."""

    def total(leaves):
        solution = solve(with_times(problem, *leaves), solver, x0, us)
        return solution.cost + price * leaves[0], solution

    return eqx.filter_value_and_grad(total, has_aux=True)(leaves)


def _is_events(cost) -> bool:
    return isinstance(cost, AbstractEvents)


def _passing(cost: AbstractCost) -> np.ndarray:
    """Return the times of all events that may change, in the order of the cost's parts."""
    found = [part for part in jax.tree.leaves(cost, is_leaf=_is_events) if _is_events(part)]
    return np.concatenate([np.zeros(0), *(np.asarray(part.times, float) for part in found)])


def _fixed(cost: AbstractCost, passing: bool) -> np.ndarray:
    """Return the times of all events that stay where they are."""
    times = np.concatenate([np.zeros(0), *(np.asarray(e.times, float) for e in terms(cost).events)])
    return np.setdiff1d(times, _passing(cost)) if passing else times


def with_times(problem: Problem, duration: Array, times: Array) -> Problem:
    """Return the problem with another duration [s], shape (), and passing times (m,)."""
    left = times

    def change(part):
        nonlocal left
        if not _is_events(part):
            return part
        own, left = left[: part.times.size], left[part.times.size :]
        return part.with_times(own)

    cost = jax.tree.map(change, problem.cost, is_leaf=_is_events)
    return eqx.tree_at(lambda p: (p.dt, p.cost), problem, (duration / problem.num_steps, cost))
