"""The suite `peers`: single solves in turns with other programs, restarts, gradients.

A solve's tolerances are chosen such that all stop by one rule: the first to end within 1e-6,
relatively, of the solver's own limit. All costs are computed anew by `Case.cost`.
"""

import statistics
from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxctrl as jc
from jaxctrl.bench._solves import LIMIT, NEWTON, SOLVERS, Call, converged, first_call, jitted
from jaxctrl.bench._timing import measure
from jaxctrl.bench._worker import Emitter
from jaxctrl.stopwatch import one_core

from . import programs
from .cases import Case, cases

GRADIENTS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
FIXED = 1e-3
"""The gradient tolerance of gradient methods."""
RULE = 1e-6
"""Where a solve may stop: this far, relatively, above the solver's own limit."""
RESTARTED = ("P1", "P2", "P3", "P3h")
DIFFERENTIATED = ("P1", "P2", "P3")


def stop_at(label: str, g: float) -> Any:
    """Return the solver that stops at gradient tolerance g."""
    return SOLVERS[label](gradient_tolerance=g, cost_tolerance=1e-7)


class Bench:
    """One problem to be measured, as the orders say."""

    def __init__(self, name: str, case: Case, orders: dict[str, Any], emit: Emitter):
        self.name, self.case, self.orders, self.emit = name, case, orders, emit
        self.problem = case.problem()
        self.x0, self.us = jnp.asarray(case.x0), jnp.asarray(case.start)
        self.chosen: dict[str, Any] = orders["chosen"].get(name) or {"limits": {}, "g": {}}

    def record(self, section: str, solver: str, **figures: Any) -> None:
        """Emit figures of this problem."""
        self.emit(section, problem=self.name, solver=solver, **figures)

    def solve(self, solver: Any, us: jax.Array, max_steps: int = 500) -> jc.Solution:
        """Solve eagerly, to the end."""
        return jax.block_until_ready(
            jc.solve(self.problem, solver, self.x0, us, max_steps=max_steps)
        )

    def limit(self, label: str) -> float:
        """Return the cost to which a solver tends: tight, then polished."""
        if label not in self.chosen["limits"]:
            polish = jc.DDP(gradient_tolerance=1e-9)
            found = self.solve(SOLVERS[label](), self.us, LIMIT.get(label, 500)).us
            us = min((self.solve(polish, found).us, found), key=self.case.cost)
            self.chosen["limits"][label] = float(self.case.cost(us))
            if label == "ILQR":
                self.chosen["optimum"] = us.tolist()
        return self.chosen["limits"][label]

    def make(self, label: str, g: float, max_steps: int | None = None) -> Call:
        """Return a newly jitted solve."""
        steps = LIMIT.get(label, 500) if max_steps is None else max_steps
        return jitted(self.problem, stop_at(label, g), self.x0, self.us, steps)

    def choose(self, label: str) -> tuple[Call, float]:
        """Note the largest gradient tolerance that obeys the rule; return its call and first time.

        Where none does it is the smallest one, and the report shows the gap. Gradient methods, of
        which each trial takes long, get one tolerance.
        """
        limit, known = self.limit(label), self.chosen["g"].get(label)
        if known is None and label not in NEWTON:
            known = FIXED
        for g in GRADIENTS if known is None else (known,):
            self.chosen["g"][label] = g
            call, first = first_call(partial(self.make, label, g))
            us, _, code, _ = call()
            if converged(code) and self.case.cost(us) <= limit * (1 + RULE):
                break
        return call, first


def singles(bench: Bench, rivals: Sequence[programs.Program]) -> dict[str, tuple[Call, float]]:
    """Measure one solve of each, in turns; return our jitted ones and their medians [ms]."""
    orders, ours = bench.orders, []
    for label in orders["solvers"]:
        call, first = bench.choose(label)
        g, firsts = bench.chosen["g"][label], [first]
        for _ in range(orders["firsts"] - 1 if label in NEWTON else 0):
            call, first = first_call(partial(bench.make, label, g))
            firsts.append(first)
        ours.append((label, g, call, firsts))
    calls = [call for _, _, call, _ in ours]
    eager = [
        partial(bench.solve, stop_at(label, g), bench.us, LIMIT.get(label, 500))
        for label, g, _, _ in ours
    ]
    with one_core():
        taken = measure(
            [*calls, *eager, *(rival.call for rival in rivals)], orders["rounds"], orders["budget"]
        )
    for (label, g, call, firsts), inside, outside in zip(
        ours, taken, taken[len(ours) :], strict=False
    ):
        us, _, code, iterations = call()
        cost, limit = float(bench.case.cost(us)), bench.limit(label)
        bench.record(
            "single", label, g=g, timing=inside, eager_ms=outside["cpu_ms"],
            first_s=statistics.median(firsts), iterations=int(iterations), cost=cost, limit=limit,
            gap=cost / limit - 1, best=bench.case.best,
            status=jc.Reason(int(code)).name, ok=converged(code),
        )  # fmt: skip
    for rival, timing in zip(rivals, taken[2 * len(ours) :], strict=True):
        us, figures = rival.found()
        figures = {**rival.figures, **figures, "cost": float(bench.case.cost(us))}
        bench.record("single", rival.label, mode="peer", timing=timing, **figures)
    return {
        label: (call, inside["ms"])
        for (label, _, call, _), inside in zip(ours, taken, strict=False)
    }


def restarts(bench: Bench, label: str, one_ms: float) -> None:
    """Measure solves from many random starts, shared among the devices."""
    uss = jnp.asarray(bench.case.starts(bench.name, bench.orders["restarts"]))
    solver = stop_at(label, bench.chosen["g"][label])
    batch = partial(jc.solve_batch, bench.problem, solver, bench.x0, uss)
    _, first = first_call(lambda: lambda: jax.block_until_ready(batch()))
    (taken,) = measure([lambda: jax.block_until_ready(batch())], bench.orders["batches"])
    found = batch()
    bench.record(
        "restarts", label, timing=taken, of_one=taken["ms"] / one_ms, first_s=first,
        devices=len(jax.devices()), costs=[bench.case.cost(us) for us in found.us],
        ok=np.asarray(found.status.ok).tolist(), iterations=np.asarray(found.num_steps).tolist(),
    )  # fmt: skip


def gradients(bench: Bench, whole: Call) -> None:
    """Measure what gradients cost beyond a forward solve that starts at the optimum.

    The unit is an iteration of ILQR: the difference between the `whole` solve, which stops by
    itself, and the same with `max_steps` 10 fewer, over 10 (or over all of them where it needs
    fewer). These last ones, mostly full steps accepted at once, are the cheapest kind, hence the
    strictest unit; with tolerances of 0 further ones would only fail at round-off, each after a
    whole line search.
    """
    g, iterations = bench.chosen["g"]["ILQR"], int(whole()[3])
    solver, last = stop_at("ILQR", g), min(10, iterations)
    arrays, static = eqx.partition(bench.problem, eqx.is_inexact_array)
    parameters, optimum = (arrays, bench.x0), jnp.asarray(bench.chosen["optimum"])

    def values(parameters):
        problem = eqx.combine(parameters[0], static)
        found = jc.solve(problem, solver, parameters[1], optimum)
        return found.cost, jnp.sum(found.xs**2) + jnp.sum(found.us**2)

    def call(function):
        function = jax.jit(function)
        return lambda: jax.block_until_ready(function(parameters))

    calls = [bench.make("ILQR", g, iterations - last), whole, call(values)]
    calls += [call(jax.grad(lambda p, i=i: values(p)[i])) for i in (0, 1)]
    # JAX takes its time to hand over as many arrays as a gradient has, however they are computed.
    calls += [call(lambda p: p[1][0] + 1), call(lambda p: jax.tree.map(lambda leaf: leaf + 1, p))]
    with one_core():
        taken = measure(calls, 2 * bench.orders["rounds"], 2 * bench.orders["budget"])
    cut, full, forward, cost, trajectory, one, many = (each["cpu_ms"] for each in taken)
    unit = (full - cut) / last
    bench.record(
        "gradients", "ILQR", iteration_ms=unit, over=last, forward_ms=forward,
        cost_ms=cost - forward, trajectory_ms=trajectory - forward, handing_ms=many - one,
        cost=(cost - forward) / unit, trajectory=(trajectory - forward) / unit,
        finite=all(np.isfinite(leaf).all() for c in calls for leaf in jax.tree.leaves(c())),
    )  # fmt: skip


def rivals_of(bench: Bench, built: dict, lacks: dict[str, str]) -> list[programs.Program]:
    """Return the rivals that are ready for a case; report those that fail."""
    ready = []
    for make in programs.programs(bench.name, bench.case, built, lacks):
        try:
            rival = make()
            rival.call()
            ready.append(rival)
        except (RuntimeError, OSError, ValueError) as error:
            bench.emit.failure(f"{bench.name} by another program", error)
    return ready


def run(orders: dict[str, Any], emit: Emitter) -> None:
    """Carry out the orders."""
    built, lacks = {}, {}
    if orders["peers"]:
        built, reasons = programs.compile_peers()
        lacks = programs.missing_packages()
        emit("missing", missing={**reasons, **lacks})
    for name in orders["names"]:
        try:
            bench = Bench(name, cases()[name], orders, emit)
            ours = singles(bench, rivals_of(bench, built, lacks) if orders["peers"] else [])
            if not orders["singles_alone"]:
                if orders["restarts"] and name in RESTARTED:
                    for label in NEWTON:
                        restarts(bench, label, ours[label][1])
                if name in DIFFERENTIATED:
                    gradients(bench, ours["ILQR"][0])
                program = built.get("crocoddyl_peer")
                if program is not None and name in RESTARTED:
                    counts = orders["restarts"], orders["batches"]
                    for figures in programs.crocoddyl_restarts(program, name, bench.case, *counts):
                        bench.record("restarts", **figures)
            emit("chosen", problem=name, chosen=bench.chosen)
        except Exception as error:
            emit.failure(name, error)
        jax.clear_caches()  # programs fill the process's memory maps
