"""Solve a case by jaxctrl, and let IPOPT try to do better."""

import time
from typing import NamedTuple

import jax.numpy as jnp
import nlp
import numpy as np
from oracle_cases import Case

import jaxctrl as jc


class Comparison(NamedTuple):
    """Both solvers' results on one case.

    Attributes:
        solution: jaxctrl's, with its controls us (T, nu) and states xs (T+1, nx).
        xs, cost: CasADi's roll-out of the same controls, (T+1, nx), and its cost.
        outcome: IPOPT's result when started there.
        found_cost: cost of CasADi's roll-out of IPOPT's controls, clipped to the bounds.
        num_lower, num_upper: how many of jaxctrl's controls are at a bound.
        seconds: wall time of jaxctrl (with compilation) and of IPOPT (with its set-up).
    """

    solution: jc.Solution
    xs: np.ndarray
    cost: float
    outcome: nlp.Outcome
    found_cost: float
    num_lower: int
    num_upper: int
    seconds: tuple[float, float]

    @property
    def improvement(self) -> float:
        """IPOPT's relative improvement of the cost, negative where it ends higher."""
        return (self.cost - self.found_cost) / self.cost


def compare(case: Case, us: np.ndarray | None = None) -> Comparison:
    """Solve `case` from the nominal controls; IPOPT starts from us (T, nu), or the solution's."""
    begin = time.perf_counter()
    solution = jc.solve(case.problem, jc.ILQR(), jnp.asarray(case.x0))
    ours = np.asarray(solution.us)
    middle = time.perf_counter()
    xs, cost = nlp.rollout(case.oracle, ours)
    start = ours if us is None else us
    outcome = nlp.improve(case.oracle, nlp.rollout(case.oracle, start)[0], start)
    found_cost = nlp.rollout(case.oracle, outcome.us)[1]
    return Comparison(
        solution=solution,
        xs=xs,
        cost=cost,
        outcome=outcome,
        found_cost=found_cost,
        num_lower=int((ours <= case.oracle.lower).sum()),
        num_upper=int((ours >= case.oracle.upper).sum()),
        seconds=(middle - begin, time.perf_counter() - middle),
    )
