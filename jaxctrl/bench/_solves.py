"""Calls of our solvers that can be timed: jitted, eager, for the first time."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import jaxctrl as jc

from ..stopwatch import repeated, take

SOLVERS: dict[str, Callable[..., jc.AbstractSolver]] = {
    "ILQR": jc.ILQR, "DDP": jc.DDP, "LBFGS": jc.LBFGS, "ConjugateGradient": jc.ConjugateGradient,
}  # fmt: skip
NEWTON = ("ILQR", "DDP")
LIMIT = {"LBFGS": 2000, "ConjugateGradient": 2000}
"""Iterations at most, where 500 are few."""
Call = Callable[[], Any]


def converged(code: Any) -> bool:
    """Tell whether a status's code is a success."""
    return int(code) <= int(jc.Reason.STATIONARY_START)


def jitted(
    problem: jc.Problem, solver: jc.AbstractSolver, x0: Any, us: Any, max_steps: int = 500
) -> Call:
    """Return a call of a newly jitted solve; it returns us, cost, the status's code, the count."""

    @jax.jit
    def inside(x0, us):
        found = jc.solve(problem, solver, x0, us, max_steps=max_steps)
        return found.us, found.cost, found.status.code, found.num_steps

    x0 = jnp.asarray(x0)
    us = None if us is None else jnp.asarray(us)
    return lambda: jax.block_until_ready(inside(x0, us))


def first_call(make: Callable[[], Call]) -> tuple[Call, float]:
    """Return a jitted solve and the time of its first call [s], from tracing to the result.

    A first call is what a user waits for, so it has all cores: XLA compiles in parallel.
    """
    jax.clear_caches()
    call = make()
    return call, take(repeated(call)).wall
