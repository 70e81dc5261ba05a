"""The suite `scaling`: time over the horizon, the number of links, and the size of a batch.

Horizons: the torque arm's reach of 0.5 s, cut into ever more steps, so that the movement and the
iterations stay about the same. Links: a reach of `Chain(n)`, 50 steps. Batches: reaches of the
muscle arm from different postures, 50 steps, by `solve_batch`; each size in a process of its own,
because its peak of memory is reported.
"""

import resource
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxctrl as jc

from ..stopwatch import one_core
from ._solves import converged, first_call, jitted
from ._timing import measure
from ._worker import Emitter

ENGINES = ("sequential", "parallel")
STEPS = {"sequential": 12, "parallel": 6}
"""Iterations at most: enough to tell the time of one."""


def reach_over(horizon: int) -> tuple[jc.Problem, Any]:
    """Return the torque arm's reach in so many steps, and where it starts."""
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(shoulder=0.785, elbow=1.571)
    target = arm.hand(x0) + jnp.array([-0.08, 0.08])
    return jc.tasks.reach(arm, target, 0.5, num_steps=horizon), x0


def reach_with(links: int) -> tuple[jc.Problem, Any]:
    """Return a chain's reach, and where it starts."""
    chain = jc.plants.Chain(links)
    x0 = chain.at_rest(1.2 / links)
    target = chain.hand(x0) + jnp.array([-0.08, 0.08])
    # Without a price on joint rates, light outer links crack like a whip.
    rates = jnp.concatenate([jnp.zeros(links), jnp.full(links, 1e-4)])
    task = jc.tasks.reach(chain, target, 0.5, num_steps=50)
    return task + jc.QuadraticCost(Q=rates, R=0.0), x0


def single(
    emit: Emitter, name: str, engine: str, problem: jc.Problem, x0: Any, orders: dict[str, Any]
) -> None:
    """Measure one solve, cut off after a few iterations."""
    steps, solver = STEPS[engine], jc.ILQR(sweep=engine)
    call, first = first_call(lambda: jitted(problem, solver, x0, None, steps))
    with one_core():
        (taken,) = measure([call], orders["rounds"], orders["budget"])
    _, cost, code, count = call()
    cut = not converged(code) and int(count) == steps
    emit(
        "single", problem=name, solver=f"ILQR {engine}", timing=taken, first_s=first,
        iterations=int(count), cost=float(cost), ok=cut or converged(code),
        **({"note": "cut off"} if cut else {"status": jc.Reason(int(code)).name}),
    )  # fmt: skip


def batch(emit: Emitter, size: int, orders: dict[str, Any]) -> None:
    """Measure a batch of reaches, and this process's peak of memory."""
    arm = jc.plants.MuscleArm()
    rng = np.random.default_rng(0)
    shoulders, elbows = 0.785 + rng.uniform(-0.3, 0.3, size), 1.571 + rng.uniform(-0.3, 0.3, size)
    x0s = jax.vmap(arm.at_rest)(jnp.asarray(shoulders), jnp.asarray(elbows))
    target = arm.hand(arm.at_rest(shoulder=0.785, elbow=1.571)) + jnp.array([-0.08, 0.08])
    problem = jc.tasks.reach(arm, target, 0.5, num_steps=50)

    def make():
        return lambda: jax.block_until_ready(jc.solve_batch(problem, jc.ILQR(), x0s))

    call, first = first_call(make)
    (taken,) = measure([call], orders["batches"], orders["budget"])
    found = call()
    emit(
        "batch", problem=f"batch {size}", solver="ILQR", timing=taken, first_s=first,
        each_ms=taken["ms"] / size, iterations=int(np.median(np.asarray(found.num_steps))),
        memory_mib=peak_memory(), converged=int(np.asarray(found.status.ok).sum()), size=size,
        cost=float(np.median(np.asarray(found.cost))), ok=bool(np.asarray(found.status.ok).all()),
    )  # fmt: skip


def peak_memory() -> float:
    """Return the most memory that this process has had [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def run(orders: dict[str, Any], emit: Emitter) -> None:
    """Carry out the orders."""
    jobs = [("horizon", n, reach_over) for n in orders["horizons"]]
    jobs += [("links", n, reach_with) for n in orders["links"]]
    for what, number, build in jobs:
        for engine in ENGINES if what == "horizon" else ENGINES[:1]:
            name = f"{what} {number}"
            try:
                problem, x0 = build(number)
                single(emit, name, engine, problem, x0, orders)
            except Exception as error:
                emit.failure(name, error)
            jax.clear_caches()
    for size in orders["sizes"]:
        try:
            batch(emit, size, orders)
        except Exception as error:
            emit.failure(f"batch {size}", error)
