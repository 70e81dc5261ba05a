"""The problems stated in CasADi by multiple shooting, for IPOPT and for fatrop."""

import hashlib
import os
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from jaxctrl.stopwatch import repeated, take

from .build import Missing, find_compiler
from .cases import Case
from .programs import MAXITER, Program, cache

FACTOR = 1e2
"""On the cost: thresholds and first barriers are absolute numbers, and at a tolerance of 1e-8 costs
of 1e-6 are left 32 % too high. Of 1, 1e2 and 1e4 this one led to the lowest costs or the least
time, for both programs."""
TOLERANCE = 1e-10
FLAGS = ("-x", "c", "-O3", "-march=native", "-shared", "-fPIC", "-w")


class _Names:
    """CasADi's functions under the names that the dynamics in cases.py use."""

    def __init__(self):
        self.sin, self.cos, self.tanh, self.exp, self.log = ca.sin, ca.cos, ca.tanh, ca.exp, ca.log
        self.maximum, self.minimum, self.where = ca.fmax, ca.fmin, ca.if_else
        self.sum = ca.sum1
        self.stack = self.concatenate = lambda parts: ca.vertcat(*parts)


def _program(case: Case) -> tuple[dict[str, Any], np.ndarray]:
    """State a case with the variables x_0, u_0, x_1, ... x_T and their constraints in that order.

    That order is what fatrop finds the stages by. Also returns which variables are controls.
    """
    nx, nu, T = case.nx, case.nu, case.T
    x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
    step = ca.Function("step", [x, u], [x + case.dt * case.dynamics(_Names(), x, u)])
    z = ca.MX.sym("z", T * (nx + nu) + nx)
    stages, last = ca.reshape(z[: T * (nx + nu)], nx + nu, T), z[-nx:]
    X, U = stages[:nx, :], stages[nx:, :]
    gaps = ca.vec(ca.horzcat(X[:, 1:], last) - step.map(T)(X, U))
    cost = 0.5 * case.dt * case.r * ca.sumsqr(U)
    cost += 0.5 * ca.dot(case.w, (last - case.target) ** 2)
    start = X[:, 0] - case.x0
    g = ca.vertcat(gaps[:nx], start, gaps[nx:])
    is_control = np.append(np.tile(np.arange(nx + nu) >= nx, T), np.zeros(nx, bool))
    return {"x": z, "f": FACTOR * cost, "g": g}, is_control


def _options(plugin: str, constraints: int) -> dict[str, Any]:
    """Return a program's options: tight, and silent."""
    own = {"tol": TOLERANCE, "max_iter": MAXITER, "print_level": 0}
    options: dict[str, Any] = {"print_time": False}
    if plugin == "ipopt":
        own |= {"bound_relax_factor": 0.0, "sb": "yes"}
    else:
        options |= {"structure_detection": "auto", "equality": [True] * constraints}
    return options | {f"{plugin}.{key}": value for key, value in own.items()}


def _compile(solver: ca.Function) -> Path:
    """Compile a solver's functions from C; a library that is there already is taken."""
    folder = cache()
    folder.mkdir(parents=True, exist_ok=True)
    compiler = find_compiler()
    source = folder / f"casadi_{os.getpid()}.c"
    here = os.getcwd()
    try:
        os.chdir(folder)  # CasADi writes into the working folder alone
        solver.generate_dependencies(source.name)
        digest = hashlib.sha256("\n".join([compiler, *FLAGS, source.read_text()]).encode())
        library = folder / f"casadi-{digest.hexdigest()[:20]}.so"
        if not library.exists():
            made = library.with_suffix(f".{os.getpid()}")
            line = [compiler, *FLAGS, str(source), "-o", str(made)]
            run = subprocess.run(line, capture_output=True, text=True)
            if run.returncode != 0:
                raise Missing(f"it does not compile: {run.stderr.strip()[:300]}")
            made.replace(library)
    finally:
        os.chdir(here)
        source.unlink(missing_ok=True)
    return library


def transcribed(label: str, plugin: str, case: Case) -> Program:
    """Return IPOPT or fatrop for one case: exact Hessians, compiled from C where possible."""
    program, is_control = _program(case)
    options = _options(plugin, program["g"].numel())
    made: list[Any] = []

    def first() -> None:
        try:
            solver = ca.nlpsol("solver", plugin, program, options)
            made[:] = [ca.nlpsol("solver", plugin, str(_compile(solver)), options), "compiled"]
        except Missing:
            expanded = {**options, "expand": True}  # twice as fast as the virtual machine without
            made[:] = [ca.nlpsol("solver", plugin, program, expanded), "CasADi VM"]

    ready = take(repeated(first)).wall
    solver, how = made
    lower, upper = (-np.inf, np.inf) if case.bounds is None else case.bounds
    box = {"lbx": np.where(is_control, lower, -np.inf), "ubx": np.where(is_control, upper, np.inf)}
    xs = [case.x0]
    for u in case.start:
        xs.append(xs[-1] + case.dt * case.dynamics(np, xs[-1], u))
    stages = np.concatenate([np.array(xs[:-1]), case.start], axis=1)
    start = np.append(stages.ravel(), xs[-1])
    last: list[Any] = []

    def call() -> None:
        last[:] = [solver(x0=start, lbg=0, ubg=0, **box)]

    def found() -> tuple[np.ndarray, dict[str, Any]]:
        us = last[0]["x"].full().ravel()[is_control].reshape(case.start.shape)
        stats = solver.stats()
        # fatrop leaves bounds by as much as its tolerance.
        word = {"iterations": stats["iter_count"], "status": str(stats["return_status"])}
        return np.clip(us, lower, upper), word | {"ok": bool(stats["success"])}

    return Program(f"{label} ({how})", call, found, {"first_s": ready})
