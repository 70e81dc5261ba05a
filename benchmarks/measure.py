"""What one process measures of jaxctrl, with or without whole loops compiled.

Begun by solvers.py: its orders come as JSON on the standard input, its figures leave as lines of
JSON on the standard output.
"""

import json
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from problems import Case, cases
from stopwatch import measure, median_ms, one_core, seconds

import jaxctrl as jc

SOLVERS = {"ILQR": jc.ILQR, "DDP": jc.DDP}
GRADIENTS = (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5)
RULE = 1e-6
"""Where a solve may stop: this far, relatively, above the solver's own limit."""
Call = Callable[[], Any]
RESTARTED = ("P1", "P2", "P3", "P3h")
DIFFERENTIATED = ("P1", "P2", "P3")
DEVICES = 2


def emit(section: str, **figures: Any) -> None:
    """Hand one record of figures to the parent."""
    print(json.dumps({"section": section, **figures}), flush=True)


class Bench:
    """One problem to be measured, as the orders say."""

    def __init__(self, name: str, case: Case, orders: dict[str, Any]):
        self.name, self.case, self.orders = name, case, orders
        self.problem = case.problem()
        self.x0, self.us = jnp.asarray(case.x0), jnp.asarray(case.start)

    def record(self, section: str, solver: str, **figures: Any) -> None:
        """Emit figures of this problem."""
        emit(section, mode=self.orders["mode"], problem=self.name, solver=solver, **figures)

    def solve(self, solver: jc.AbstractSolver, us: jax.Array) -> jc.Solution:
        """Solve eagerly, to the end."""
        return jax.block_until_ready(jc.solve(self.problem, solver, self.x0, us))

    def limits(self) -> dict[str, Any]:
        """Return the cost to which each solver tends, and where ILQR does: tight, then polished."""
        polish, limits, optimum = jc.DDP(gradient_tolerance=1e-9), {}, None
        for label, tight in (("ILQR", jc.ILQR()), ("DDP", polish)):
            found = self.solve(tight, self.us).us
            us = min((self.solve(polish, found).us, found), key=self.case.cost)
            limits[label] = float(self.case.cost(us))
            optimum = us.tolist() if optimum is None else optimum
        return {"limits": limits, "optimum": optimum, "g": {}}


def stop_at(label: str, g: float) -> jc.AbstractSolver:
    """Return the solver that stops at gradient tolerance g."""
    return SOLVERS[label](gradient_tolerance=g, cost_tolerance=1e-7)


def jitted(bench: Bench, solver: jc.AbstractSolver, max_steps: int = 500) -> Call:
    """Return a call of a newly jitted solve, a function of (x0, us)."""

    @jax.jit
    def inside(x0, us):
        found = jc.solve(bench.problem, solver, x0, us, max_steps=max_steps)
        return found.us, found.cost, found.status.code, found.num_steps

    return lambda: jax.block_until_ready(inside(bench.x0, bench.us))


def first_call(bench: Bench, solver: jc.AbstractSolver) -> tuple[Call, float]:
    """Return a jitted solve and the time of its first call [s], from tracing to the result.

    A first call is what a user waits for, so it has all cores: XLA compiles in parallel.
    """
    jax.clear_caches()
    call = jitted(bench, solver)
    return call, seconds(call)


def converged(code: Any) -> bool:
    """Tell whether a status's code is a success."""
    return int(code) <= int(jc.Reason.STATIONARY_START)


def choose(bench: Bench, label: str, chosen: dict[str, Any]) -> tuple[Call, float]:
    """Note the largest gradient tolerance that obeys the rule; return its call and first time.

    Where none does it is the smallest one, and the report shows the gap.
    """
    limit = chosen["limits"][label]
    known = chosen["g"].get(label)
    for g in GRADIENTS if known is None else (known,):
        chosen["g"][label] = g
        call, first = first_call(bench, stop_at(label, g))
        us, _, code, _ = call()
        if converged(code) and bench.case.cost(us) <= limit * (1 + RULE):
            break
    return call, first


def single(bench: Bench, label: str, chosen: dict[str, Any]) -> tuple[Call, float]:
    """Measure one solve; return the jitted one and its median [ms]."""
    call, first = choose(bench, label, chosen)
    g, limit, firsts = chosen["g"][label], chosen["limits"][label], [first]
    solver = stop_at(label, g)
    for _ in range(bench.orders["firsts"] - 1):
        call, first = first_call(bench, solver)
        firsts.append(first)
    with one_core():
        calls = [call, lambda: bench.solve(solver, bench.us)]
        inside, eager = measure(calls, bench.orders["repeats"])
    us, _, code, iterations = call()
    cost = float(bench.case.cost(us))
    bench.record(
        "single", label, g=g, inside_ms=median_ms(inside), inside_min_ms=1e3 * min(inside),
        eager_ms=median_ms(eager), first_s=1e-3 * median_ms(firsts), iterations=int(iterations),
        cost=cost, limit=limit, gap=cost / limit - 1, status=jc.Reason(int(code)).name,
        ok=converged(code),
    )  # fmt: skip
    return call, median_ms(inside)


def restarts(bench: Bench, label: str, g: float, one_ms: float) -> None:
    """Measure solves from many random starts, shared among the devices."""
    uss = jnp.asarray(bench.case.starts(bench.name, bench.orders["restarts"]))
    batch = partial(jc.solve_batch, bench.problem, stop_at(label, g), bench.x0, uss)
    first = seconds(lambda: jax.block_until_ready(batch()))
    (taken,) = measure([lambda: jax.block_until_ready(batch())], bench.orders["batches"])
    found = batch()
    bench.record(
        "restarts", label, total_ms=median_ms(taken), of_one=median_ms(taken) / one_ms,
        first_s=first, devices=len(jax.devices()), costs=[bench.case.cost(us) for us in found.us],
        ok=np.asarray(found.status.ok).tolist(), iterations=np.asarray(found.num_steps).tolist(),
    )  # fmt: skip


def gradients(bench: Bench, chosen: dict[str, Any], whole: Call) -> None:
    """Measure what gradients cost beyond a forward solve that starts at the optimum.

    The unit is an iteration of ILQR: the difference between the `whole` solve, which stops by
    itself, and the same with `max_steps` 10 fewer, over 10 (or over all of them where it needs
    fewer). These last ones, mostly full steps accepted at once, are the cheapest kind, hence the
    strictest unit; with tolerances of 0 further ones would only fail at round-off, each after a
    whole line search.
    """
    solver, iterations = stop_at("ILQR", chosen["g"]["ILQR"]), int(whole()[3])
    last = min(10, iterations)
    arrays, static = eqx.partition(bench.problem, eqx.is_inexact_array)
    parameters, optimum = (arrays, bench.x0), jnp.asarray(chosen["optimum"])

    def values(parameters):
        problem = eqx.combine(parameters[0], static)
        found = jc.solve(problem, solver, parameters[1], optimum)
        return found.cost, jnp.sum(found.xs**2) + jnp.sum(found.us**2)

    def call(function):
        function = jax.jit(function)
        return lambda: jax.block_until_ready(function(parameters))

    calls = [jitted(bench, solver, iterations - last), whole, call(values)]
    calls += [call(jax.grad(lambda p, i=i: values(p)[i])) for i in (0, 1)]
    # JAX takes its time to hand over as many arrays as a gradient has, however they are computed.
    calls += [call(lambda p: p[1][0] + 1), call(lambda p: jax.tree.map(lambda leaf: leaf + 1, p))]
    with one_core():
        taken = measure(calls, 3 * bench.orders["repeats"])
    cut, full, forward, cost, trajectory, one, many = (median_ms(each) for each in taken)
    unit = (full - cut) / last
    bench.record(
        "gradients", "ILQR", iteration_ms=unit, over=last, forward_ms=forward,
        cost_ms=cost - forward, trajectory_ms=trajectory - forward, handing_ms=many - one,
        cost=(cost - forward) / unit, trajectory=(trajectory - forward) / unit,
        finite=all(np.isfinite(leaf).all() for c in calls for leaf in jax.tree.leaves(c())),
    )  # fmt: skip


def start(mode: str) -> None:
    """Set JAX up as the mode wants it, before it is used."""
    if mode == "fast":
        if not jc.enable_fast_cpu(DEVICES):
            sys.exit("enable_fast_cpu came too late")
    else:
        jax.config.update("jax_num_cpu_devices", DEVICES)
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", False)  # it would hide the first calls
    jax.devices()  # before any pinning: JAX counts the cores when it starts its threads


def main() -> None:
    """Carry out the orders."""
    orders = json.load(sys.stdin)
    start(orders["mode"])
    emit("versions", python=sys.version.split()[0], jax=jax.__version__, jaxctrl=jc.__version__)
    for name in orders["names"]:
        bench = Bench(name, cases()[name], orders)
        chosen = orders["chosen"].get(name) or bench.limits()
        for label in SOLVERS:
            call, one_ms = single(bench, label, chosen)
            if orders["singles_alone"]:
                continue
            if name in RESTARTED:
                restarts(bench, label, chosen["g"][label], one_ms)
            if label == "ILQR" and name in DIFFERENTIATED:
                gradients(bench, chosen, call)
        emit("chosen", problem=name, chosen=chosen)
        jax.clear_caches()  # programs fill the process's memory maps


if __name__ == "__main__":
    main()
