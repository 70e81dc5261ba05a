"""Ask IPOPT for a better solution of the same discretised problem, by multiple shooting."""

from typing import NamedTuple

import casadi as ca
import numpy as np
from casadi_models import Model

OPTIONS = {
    # Of the gradient, in units of the cost; closer, rounding ends some programs of muscles.
    "tol": 1e-8,
    "constr_viol_tol": 1e-10,
    "compl_inf_tol": 1e-10,
    "acceptable_iter": 0,
    "max_iter": 300,
    "max_cpu_time": 120.0,
    "nlp_scaling_method": "none",
    # The bounds hold as they are given, and the start is left where it is.
    "bound_relax_factor": 0.0,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
    "print_level": 0,
    "sb": "yes",
}
BARRIERS = (1e-9, 1e-7, 1e-5)
"""Weights of the barrier to begin with. From the first IPOPT hardly leaves the start. With muscles,
whose activation has a kink at u = a, it may stop dead there; it tries again from further out."""


class Discretised(NamedTuple):
    """A problem as CasADi has it: J = terminal(x_T) + dt sum_k running(x_k, u_k), from x0 (nx,).

    The bounds lower and upper on the controls have shape (nu,).
    """

    model: Model
    running: ca.Function
    terminal: ca.Function
    x0: np.ndarray
    dt: float
    lower: np.ndarray
    upper: np.ndarray


class Outcome(NamedTuple):
    """What IPOPT found: its word for it, its iterations, and the controls (T, nu)."""

    status: str
    num_steps: int
    us: np.ndarray


class Program(NamedTuple):
    """The nonlinear program and the units of its variables.

    These are, step by step, (u_k, x_{k+1}) divided by `units` (nu+nx,).
    """

    nlp: dict
    units: np.ndarray


def rollout(problem: Discretised, us: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the states (T+1, nx) under the controls us (T, nu), clipped, and the cost."""
    x, xs, cost = problem.x0, [problem.x0], 0.0
    for u in np.clip(us, problem.lower, problem.upper):
        cost += problem.dt * float(problem.running(x, u))
        x = problem.model.step(x, u, problem.dt).full().ravel()
        xs.append(x)
    return np.array(xs), cost + float(problem.terminal(x))


def transcribe(problem: Discretised, xs: np.ndarray, us: np.ndarray) -> Program:
    """Write the problem as a program that is well scaled about xs (T+1, nx), us (T, nu).

    States and controls are in units of their largest magnitudes, the cost in units of its value
    there, and each equation in units of its largest derivative with respect to a scaled variable.
    """
    num_steps, nu = us.shape
    u_size, x_size = np.abs(us).max(axis=0), np.abs(xs).max(axis=0)
    units = np.r_[np.maximum(u_size, 1e-3 * u_size.max()), np.maximum(x_size, 1e-3)]

    W = ca.MX.sym("w", units.size, num_steps)
    physical = W * ca.repmat(ca.DM(units), 1, num_steps)
    controls, after = physical[:nu, :], physical[nu:, :]
    before = ca.horzcat(problem.x0, after[:, :-1])
    gaps = problem.model.residual.map(num_steps)(before, controls, after, problem.dt)
    running = problem.dt * ca.sum2(problem.running.map(num_steps)(before, controls))
    cost = (problem.terminal(after[:, -1]) + running) / rollout(problem, us)[1]

    jacobian = ca.Function("jacobian", [ca.vec(W)], [ca.jacobian(ca.vec(gaps), ca.vec(W))])
    steepest = np.abs(jacobian(pack(xs, us, units)).sparse()).max(axis=1).toarray()
    equations = steepest.reshape(num_steps, -1).max(axis=0)
    gaps = gaps / ca.repmat(ca.DM(equations), 1, num_steps)
    return Program({"x": ca.vec(W), "f": cost, "g": ca.vec(gaps)}, units)


def pack(xs: np.ndarray, us: np.ndarray, units: np.ndarray) -> np.ndarray:
    """Return the program's variables for a trajectory, shape (T (nu+nx),)."""
    return (np.concatenate([us, xs[1:]], axis=1) / units).ravel()


def multipliers(program: Program, w: np.ndarray, nu: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the equations' multipliers at w, and the gradient that the controls are left with.

    The first make the Lagrangian stationary in the states, exactly; the second is its derivative
    with respect to each variable, zero for the states.
    """
    x, f, g = (program.nlp[name] for name in "xfg")
    derivatives = ca.Function("derivatives", [x], [ca.gradient(f, x), ca.jacobian(g, x)])
    gradient, jacobian = derivatives(w)
    index = np.arange(w.size).reshape(-1, program.units.size)
    states = index[:, nu:].ravel().tolist()
    lam = ca.solve(jacobian[:, states].T, -gradient[states], "csparse")
    return lam.full().ravel(), (gradient + jacobian.T @ lam).full().ravel()


def improve(problem: Discretised, xs: np.ndarray, us: np.ndarray) -> Outcome:
    """Start IPOPT from the trajectory xs (T+1, nx), us (T, nu) and its multipliers.

    Returns: its first success with one of `BARRIERS`, or else its last outcome.
    """
    num_steps, nu = us.shape
    program = transcribe(problem, xs, us)
    units = program.units
    w = pack(xs, us, units)
    free = np.full(xs.shape[1], np.inf)
    lower = np.tile(np.r_[problem.lower, -free] / units, num_steps)
    upper = np.tile(np.r_[problem.upper, free] / units, num_steps)
    lam, left = multipliers(program, w, nu)
    held = ((w <= lower) & (left > 0)) | ((w >= upper) & (left < 0))
    start = {"x0": w, "lam_g0": lam, "lam_x0": np.where(held, -left, 0.0)}
    for barrier in BARRIERS:
        options = {"ipopt": {**OPTIONS, "mu_init": barrier}, "print_time": False}
        solver = ca.nlpsol("solver", "ipopt", program.nlp, options)
        found = solver(**start, lbx=lower, ubx=upper, lbg=0, ubg=0)
        stats = solver.stats()
        if stats["success"]:
            break
    us = found["x"].full().reshape(num_steps, -1)[:, :nu] * units[:nu]
    return Outcome(stats["return_status"], stats["iter_count"], us)
