"""The same problems through other programs: the C++ peers, and IPOPT by way of CasADi."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from problems import Case, cases
from stopwatch import measure, median_ms, one_core, seconds

sys.path.append(str(Path(__file__).resolve().parent / "peers"))
from build import PEERS, TH_STOP, build

RESTARTED = TRANSCRIBED = ("P1", "P2", "P3", "P3h")
MAXITER = 500
FACTORS = {"P1": "1e2", "P2": "1e2", "P3": "1e2", "P3h": "2e3"}
"""crocoddyl_peer's own factors on the cost, which must be repeated to ask for a feasible start."""

Emit = Callable[[dict[str, Any]], None]


def run_peer(
    program: Path, name: str, uss: np.ndarray, repeats: int, *more: str
) -> tuple[dict[str, Any], np.ndarray]:
    """Run a C++ peer on one core from the starts uss (B, T, nu); return its word and its us."""
    with tempfile.TemporaryDirectory() as folder:
        files = [str(Path(folder, file)) for file in ("start", "found")]
        np.ascontiguousarray(uss, float).tofile(files[0])
        numbers = [str(repeats), repr(TH_STOP[program.name][name]), str(MAXITER)]
        line = [str(program), name, *files, *numbers, *more]
        with one_core():
            run = subprocess.run(line, capture_output=True, text=True)
        if run.returncode != 0:
            raise RuntimeError(f"{program.name} {name}: {run.stderr.strip()[:300]}")
        return json.loads(run.stdout), np.fromfile(files[1]).reshape(uss.shape)


def measure_peer(program: Path, name: str, case: Case, settings: dict[str, Any], emit: Emit):
    """Measure one C++ peer on one problem: from its own start, and Crocoddyl from many."""
    label = {"floor_peer": "floor", "crocoddyl_peer": "Crocoddyl"}[program.name]
    base = {"mode": "peer", "problem": name}
    word, us = run_peer(program, name, case.start[None], settings["repeats"])
    figures = {"inside_ms": 1e3 * word["seconds"], "iterations": word["iterations"][0]}
    emit({"section": "single", **base, "solver": label, **figures, "cost": float(case.cost(us[0]))})
    if label != "Crocoddyl" or name not in RESTARTED:
        return
    starts = case.starts(name, settings["restarts"])
    for kind, more in (("", ()), (" feasible", (FACTORS[name], "feasible"))):
        word, us = run_peer(program, name, starts, settings["batches"], *more)
        threshold = TH_STOP[program.name][name]
        figures = {
            "total_ms": 1e3 * word["seconds"],
            "iterations": word["iterations"],
            "ok": [stop is not None and stop <= threshold for stop in word["stop"]],
            "costs": [float(case.cost(each)) for each in us],
        }
        emit({"section": "restarts", **base, "solver": label + kind, "devices": 1, **figures})


class CasadiNames:
    """CasADi's functions under the names that the dynamics in problems.py use."""

    def __init__(self, ca: Any):
        self.sin, self.cos, self.tanh, self.exp, self.log = ca.sin, ca.cos, ca.tanh, ca.exp, ca.log
        self.maximum, self.minimum, self.where = ca.fmax, ca.fmin, ca.if_else
        self.stack = self.concatenate = lambda parts: ca.vertcat(*parts)
        # The dynamics sum by the method that NumPy's and JAX's arrays have and CasADi's lack.
        ca.SX.sum = lambda array: ca.sum1(array)


def transcribe(ca: Any, case: Case) -> Callable[[np.ndarray], tuple[np.ndarray, dict[str, Any]]]:
    """Return a solve by multiple shooting: from us (T, nu) to the best us and IPOPT's word."""
    x, u = ca.SX.sym("x", case.nx), ca.SX.sym("u", case.nu)
    step = ca.Function("step", [x, u], [x + case.dt * case.dynamics(CasadiNames(ca), x, u)])
    U, X = ca.MX.sym("U", case.nu, case.T), ca.MX.sym("X", case.nx, case.T)
    gaps = X - step.map(case.T)(ca.horzcat(ca.DM(case.x0), X[:, :-1]), U)
    cost = 0.5 * ca.dot(case.w, (X[:, -1] - case.target) ** 2)
    cost += 0.5 * case.dt * case.r * ca.sumsqr(U)
    # IPOPT's thresholds and first barrier are absolute: this factor is Crocoddyl's, and by trial
    # among 1, 1e2 and 1e4 it leads to the lowest costs here too. Expanding doubles the speed.
    program = {"x": ca.vertcat(ca.vec(U), ca.vec(X)), "f": 1e2 * cost, "g": ca.vec(gaps)}
    options = {"ipopt.tol": 1e-10, "ipopt.max_iter": MAXITER, "ipopt.bound_relax_factor": 0.0}
    options |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False, "expand": True}
    solver = ca.nlpsol("solver", "ipopt", program, options)
    size = case.T * case.nu
    lower, upper = (-np.inf, np.inf) if case.bounds is None else case.bounds
    free = np.full(case.T * case.nx, np.inf)
    box = {"lbx": np.append(np.full(size, lower), -free), "lbg": 0, "ubg": 0}
    box["ubx"] = np.append(np.full(size, upper), free)

    def solve(us: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
        xs = [case.x0]
        for each in us:
            xs.append(xs[-1] + case.dt * case.dynamics(np, xs[-1], each))
        found = solver(x0=np.concatenate([us.ravel(), np.ravel(xs[1:])]), **box)
        return found["x"].full()[:size].reshape(us.shape), solver.stats()

    return solve


def measure_ipopt(ca: Any, name: str, case: Case, emit: Emit) -> None:
    """Measure IPOPT on one problem: exact Hessian, functions as CasADi's virtual machine has it."""
    solves = []
    with one_core():
        build_s = seconds(lambda: solves.append(transcribe(ca, case)))
        (taken,) = measure([lambda: solves[0](case.start)], 3)
    us, stats = solves[0](case.start)
    figures = {"inside_ms": median_ms(taken), "inside_min_ms": 1e3 * min(taken)}
    figures |= {"first_s": build_s, "iterations": stats["iter_count"]}
    figures |= {"status": stats["return_status"], "cost": float(case.cost(us))}
    base = {"section": "single", "mode": "peer", "problem": name, "solver": "IPOPT"}
    emit({**base, **figures})


def measure_others(names: Sequence[str], settings: dict[str, Any], emit: Emit) -> dict[str, str]:
    """Measure what is installed; return the reason for each program that is not."""
    user = os.getuid() if hasattr(os, "getuid") else "peers"
    programs, missing = build(Path(tempfile.gettempdir(), f"jaxctrl-peers-{user}"))
    missing = {name: missing[name] for name in PEERS if name in missing}
    known = {name: case for name, case in cases().items() if name in names}
    for program in programs.values():
        for name, case in known.items():
            if name not in TH_STOP[program.name]:
                continue
            try:
                measure_peer(program, name, case, settings, emit)
            except (RuntimeError, OSError, ValueError) as error:
                missing[f"{program.name} {name}"] = str(error)
    try:
        import casadi
    except ImportError as error:
        return {**missing, "IPOPT": f"{error} (pip install casadi)"}
    for name in (each for each in TRANSCRIBED if each in known):
        measure_ipopt(casadi, name, known[name], emit)
    return missing
