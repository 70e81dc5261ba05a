"""Record optima and runs of `jaxctrl.problems`: `python tests/oracle/record_library.py [NAME ...]`.

For each benchmark, both solvers run in float64 and in float32 with default options, once from its
start and `NUDGES` times from starts that differ from it by rounding. The optimum is the lowest
cost, in CasADi's roll-out, of IPOPT started from `us`, from each float64 solution, and from the
best of `RESTARTS`. A solver's own cost takes its place where it is lower by 1e-8, more than an
interior point's distance from its bounds.
Without names all are done; the records of the others are kept.
"""

import json
import platform
import sys

import casadi
import jax
import jax.numpy as jnp
import library_cases
import nlp
import numpy as np

import jaxctrl as jc
from jaxctrl.problems._benchmark import RECORDS
from jaxctrl.problems._library import LIBRARY

SOLVERS = {"ILQR": jc.ILQR, "DDP": jc.DDP}
NUDGES = 8
RESTARTS = {"muscle-arm": 100, "muscle-arm-brown": 100}
"""From how many random starts DDP looks for better optima. Of the pendulums, cart-pole, acrobot,
quadrotor and torque arm 16 starts found none; car parking and chains were not searched."""


def run(name: str, solver: str) -> tuple[jc.Solution, list[int]]:
    """Solve a benchmark in the float type of the moment; also count iterations from near starts."""
    problem, x0, us = LIBRARY[name][1]()
    counts = []
    for seed in range(NUDGES):
        noise = np.random.default_rng(seed).standard_normal(us.shape)
        nudge = 4 * float(jnp.finfo(us.dtype).eps) * noise * (0.01 + np.abs(us))
        near = us + jnp.asarray(nudge, us.dtype)
        counts.append(int(jc.solve(problem, SOLVERS[solver](), x0, near).num_steps))
    return jc.solve(problem, SOLVERS[solver](), x0, us), counts


def entry(solution: jc.Solution, counts: list[int]) -> dict:
    """Write a solution as a recorded run."""
    iterations = int(solution.num_steps)
    return {
        "status": solution.status.name,
        "iterations": iterations,
        "cost": float(solution.cost),
        "fewest": min(iterations, *counts),
        "most": max(iterations, *counts),
    }


def restarted(name: str) -> np.ndarray:
    """Return the best of DDP's controls (T, nu) from random starts: a level with noise on it."""
    problem, x0, us = LIBRARY[name][1]()
    starts = []
    for seed in range(RESTARTS[name]):
        rng = np.random.default_rng(seed)
        level = rng.uniform(0.02, 0.4, (1, us.shape[1]))
        starts.append(np.clip(level + 0.03 * rng.standard_normal(us.shape), 0.0, 1.0))
    found = jc.solve_batch(problem, jc.DDP(), x0, jnp.asarray(np.array(starts)))
    return np.asarray(jc.best(found).us)


def optimum(name: str, start: np.ndarray, solutions: dict[str, np.ndarray]) -> tuple[float, str]:
    """Return the lowest cost found for a benchmark, and by what."""
    oracle = library_cases.LIBRARY[name]()
    first = next(iter(solutions.values()))
    found = {"IPOPT from the start": library_cases.from_afar(oracle, start, first)}
    if name in RESTARTS:
        solutions = solutions | {f"DDP, the best of {RESTARTS[name]} starts": restarted(name)}
    for solver, us in solutions.items():
        label = f"IPOPT from the solution of {solver}"
        found[label] = nlp.improve(oracle, nlp.rollout(oracle, us)[0], us)
    costs = {label: nlp.rollout(oracle, each.us)[1] for label, each in found.items()}
    for label, cost in costs.items():
        print(
            f"  {label:32s} {cost:.14g} {found[label].status} {found[label].num_steps}", flush=True
        )
    costs |= {solver: nlp.rollout(oracle, us)[1] for solver, us in solutions.items()}
    by, best = "IPOPT from the start", costs["IPOPT from the start"]
    for label, cost in costs.items():
        if cost < best * (1 - 1e-8):
            by, best = label, cost
    return best, by


def record(name: str) -> dict:
    """Solve a benchmark in every way; print and return its record."""
    print(name, flush=True)
    with jax.enable_x64(True):
        wide = {solver: run(name, solver) for solver in SOLVERS}
        start = np.asarray(LIBRARY[name][1]().us)
    with jax.enable_x64(False):
        narrow = {solver: run(name, solver) for solver in SOLVERS}
    solutions = {solver: np.asarray(found.us) for solver, (found, _) in wide.items()}
    with jax.enable_x64(True):
        best, by = optimum(name, start, solutions)
    runs = {f"{solver} float64": entry(*found) for solver, found in wide.items()}
    runs |= {f"{solver} float32": entry(*found) for solver, found in narrow.items()}
    for key, value in runs.items():
        print(
            f"  {key:32s} {value['cost']:.14g} {value['status']} {value['iterations']} "
            f"({value['fewest']} to {value['most']})",
            flush=True,
        )
    return {"optimum": best, "optimum_by": by, "runs": runs}


def main(names: list[str]) -> None:
    """Record the benchmarks named, or all."""
    records = json.loads(RECORDS.read_text()) if names and RECORDS.exists() else {"benchmarks": {}}
    done = records["benchmarks"]
    for name in names or LIBRARY:
        done[name] = record(name)
        jax.clear_caches()
        write(done)


def write(done: dict[str, dict]) -> None:
    """Write the records, with the versions of the programs that made them."""
    made_with = {
        "jaxctrl": jc.__version__,
        "JAX": jax.__version__,
        "CasADi": casadi.__version__,
        "Python": platform.python_version(),
        "processor": platform.machine(),
    }
    ordered = {name: done[name] for name in LIBRARY if name in done}
    text = json.dumps({"made_with": made_with, "benchmarks": ordered}, indent=1)
    RECORDS.write_text(text + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
