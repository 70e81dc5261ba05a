"""The suite `problems`: every problem of `jaxctrl.problems` by ILQR and DDP."""

from typing import Any

import jax
import jax.numpy as jnp

import jaxctrl as jc

from ..stopwatch import one_core
from . import _peers
from ._solves import NEWTON, SOLVERS, converged, first_call, jitted
from ._timing import measure
from ._worker import Emitter


def run(orders: dict[str, Any], emit: Emitter) -> None:
    """Carry out the orders."""
    for name in orders["names"] or jc.problems.names():
        try:
            one(name, orders, emit)
        except Exception as error:
            emit.failure(name, error)
        jax.clear_caches()  # programs fill the process's memory maps


def one(name: str, orders: dict[str, Any], emit: Emitter) -> None:
    """Measure one problem, all solvers in turns."""
    found = jc.problems.load(name)
    ours = [
        first_call(lambda label=label: jitted(found.problem, SOLVERS[label](), found.x0, found.us))
        for label in NEWTON
    ]
    rivals = []
    if orders["peers"]:
        scipy = _peers.load("minimised")
        rivals = [scipy.minimised(found.problem, found.x0, found.us)]
    with one_core():
        taken = measure(
            [*(call for call, _ in ours), *(rival.call for rival in rivals)],
            orders["rounds"], orders["budget"],
        )  # fmt: skip
    for label, (call, first), timing in zip(NEWTON, ours, taken, strict=False):
        _, cost, code, iterations = call()
        emit(
            "single", problem=name, solver=label, timing=timing, first_s=first,
            iterations=int(iterations), cost=float(cost), optimum=found.optimum,
            status=jc.Reason(int(code)).name, ok=converged(code),
        )  # fmt: skip
    for rival, timing in zip(rivals, taken[len(ours) :], strict=True):
        us, figures = rival.found()
        cost = jc.simulate(found.problem, jc.OpenLoop(jnp.asarray(us)), found.x0).cost
        emit(
            "single", problem=name, solver=rival.label, mode="peer", timing=timing,
            cost=float(cost), optimum=found.optimum, **rival.figures, **figures,
        )  # fmt: skip
