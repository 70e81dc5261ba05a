"""Pontryagin's conditions as a two-point boundary-value problem, solved by collocation."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import _status
from .._checks import check_integer, is_concrete
from .._controller import AffinePolicy, clip
from .._jit import jit
from .._linalg import matmul
from .._local_model import expand
from .._problem import Problem
from .._solution import Solution, last_finite
from .._solver import AbstractDirectSolver, Record
from .._status import Reason, Status, first_nonfinite
from ..linear._factorised import factorise
from ..linear._riccati import costates
from ._collocation import Path, collocate, controls
from ._hamiltonian import Hamiltonian
from ._judging import cost_scale, input_status, projected_gradient, start_status
from ._rollout import rollout_law

NODES = 41
"""How many nodes the first mesh has."""
LOOSE = 0.05
"""The tolerance on the way to the problem itself."""
FACTOR, LARGEST_FACTOR, SMALLEST_FACTOR = 4.0, 100.0, 1.05
"""How much the price falls at a time: first, at most, and the least that is tried."""
CHEAP = 0.02
"""The relative price below which the next is zero."""

OFF_GRID = 1.1
"""How many times the continuous cost the grid's may be."""


class BoundaryValue(AbstractDirectSolver):
    """Solve the continuous-time problem by its two-point boundary-value problem.

    dx/dt = f(x, u*, t),  dp/dt = -dH/dx,  x(0) = x_0,  p(T) = dh/dx(x(T)),
    u* = argmin_u H within the bounds,  H = l(x, u, t) + p'f(x, u, t)

    (Pontryagin et al. 1962; the method "ODE" of Li 2006, section 4.3), by collocation on an
    adapted mesh: `scipy.integrate.solve_bvp`, with the residuals of BVP4C (Kierzenka & Shampine
    2001; Ascher, Mattheij & Russell 1995) and exact Jacobians. The minimum of H is the global one
    where H is quadratic in u, as for control-affine plants with quadratic effort, or a sum of terms
    of one control each, as for muscles; else it is a local one.

    The first guess is the roll-out of the starting controls and its costates. Where a step down the
    gradient would reduce the cost by more than the cost itself, continuation leads there: a price
    c W/2 |u - u_nominal|^2 of the controls, W the diagonal of d2l/du2 at the start, is added,
    first so large that the guess is nearly a solution, then lowered to zero; where Newton's method
    fails, in smaller steps.

    The controls are then held over the problem's steps, and are judged there: by four roll-outs,
    with the controls of the beginning or of the middle of each step, open loop or with
    the feedback of a Riccati sweep around the continuous trajectory. The one of lowest cost is
    returned. Its `gradient` is that on the grid, which is not zero: the continuous optimum is not
    the grid's. With explicit Euler they differ by O(dt), and a long or unstable movement whose
    control is cheap may end far off; with `RK4` much less so. Where the cost on the grid is more
    than 1.1 times that in continuous time the status is `BVP_OFF_GRID`, no success. An extremal
    need not be a minimum, nor the best one.

    It runs on the host: under jit, vmap and grad, and in `solve_batch`, it raises TypeError; its
    solution has no derivative. `max_steps` of `solve` does not apply; `num_steps` counts the rounds
    of collocation, each up to eight Newton steps, and `history` has one entry.

    Arguments:
        tol: of the residual of the differential equations in each mesh interval and of the
            boundary conditions, with time in units of T and each state and costate in units of its
            largest value; above 0.
        max_nodes: limit of the mesh; at least 4.

    Raises ValueError, naming the argument, for other values; `solve` raises it for a discrete
    plant and for costs with events (via-points) or of whole steps (`AbstractResidual`), which have
    no such form.
    """

    tol: float = eqx.field(static=True, default=1e-4)
    max_nodes: int = eqx.field(
        static=True, default=2000, converter=lambda value: check_integer("max_nodes", value, 4)
    )

    def __check_init__(self):
        if not (isinstance(self.tol, int | float) and self.tol > 0):
            raise ValueError(f"tol: a number above 0 is wanted, got {self.tol!r}")

    def run(self, problem: Problem, x0: Array, us: Array) -> Solution:
        """Return the solution from x0 (nx,), first guessed from the controls us (T, nu)."""
        _check(problem, x0, us)
        us = clip(us, problem.bounds)
        guess = _guess(problem, x0, us)
        if not bool(guess.status.is_(Reason.RUNNING)):
            xs = last_finite(guess.ys[:, : x0.size])
            return _solution(problem, xs, us, guess.status, 0)
        path, price, reason, rounds = self._follow(problem, x0, guess)
        xs, us, minimised, cost = _on_grid(problem, x0, path, price)
        status = Status.of(reason)
        if reason is Reason.CONVERGED_COLLOCATION:
            if not minimised.all():
                status = Status.of(Reason.BVP_NO_MINIMUM, int(np.argmin(minimised)))
            elif float(problem.total_cost(xs, us)) > cost + (OFF_GRID - 1) * abs(cost):
                status = Status.of(Reason.BVP_OFF_GRID)
        # On the grid, what the continuous trajectory avoids may still happen.
        status = start_status(problem, xs, us, status)
        return _solution(problem, last_finite(xs), us, status, rounds)

    def _follow(self, problem: Problem, x0: Array, guess: "_Guess"):
        """Lower the price of the controls to zero; return path, price, reason and rounds."""
        start, nodes = np.asarray(x0, float), min(NODES, self.max_nodes)
        path = _from_grid(np.asarray(guess.ys, float)).sampled(np.linspace(0.0, 1.0, nodes))
        rounds, reduction = 0, float(guess.reduction)

        def attempt(c):
            nonlocal rounds
            tol, nodes = (self.tol, self.max_nodes) if c == 0 else (LOOSE, 4 * NODES)
            tol, nodes = max(tol, self.tol), min(nodes, self.max_nodes)
            hamiltonian = Hamiltonian(problem, c * guess.weight)
            found = collocate(hamiltonian, start, path, tol, nodes)
            rounds += found.rounds
            return found

        c = reduction if reduction > 1 else 0.0
        found = attempt(c)
        if found.reason is not Reason.RUNNING and c == 0:
            c = max(reduction, 1.0)
            found = attempt(c)
        factor = FACTOR
        if found.reason is not Reason.RUNNING:
            return path, c * guess.weight, found.reason, rounds
        while c > 0:
            path = found.path
            if len(path.s) > 2 * NODES:
                path = path.sampled(np.linspace(0.0, 1.0, 2 * NODES))
            lower = c / factor if c / factor > CHEAP else 0.0
            trial = attempt(lower)
            if trial.reason is Reason.RUNNING:
                found, c = trial, lower
                factor = min(factor ** (2.0 if trial.rounds <= 2 else 1.5), LARGEST_FACTOR)
            elif factor > SMALLEST_FACTOR:
                factor = factor**0.5
            else:
                return found.path, c * guess.weight, trial.reason, rounds
        return found.path, c * guess.weight, Reason.CONVERGED_COLLOCATION, rounds


class _Guess(NamedTuple):
    """A roll-out and its costates, ys (T+1, 2 nx), and what continuation needs to start.

    `weight` (nu,) is the diagonal of d2l/du2, averaged over time; `reduction` is what a step down
    the gradient, in the metric of `weight`, would reduce the cost by, relative to the cost.
    """

    ys: Array
    weight: Array
    reduction: Array
    status: Status


@jit
def _guess(problem: Problem, x0: Array, us: Array) -> _Guess:
    """Roll the starting controls out, and follow the costates back."""
    xs = problem.rollout(x0, us)
    model = expand(problem, xs, us)
    p, gradient = costates(model)
    first = model.lx[0] + matmul(model.fx[0].T, p[0])
    ys = jnp.concatenate([xs, jnp.concatenate([first[None], p])], axis=1)
    weight = jnp.mean(jnp.diagonal(model.luu, axis1=1, axis2=2), axis=0) / problem.dt
    weight = jnp.maximum(weight, 1e-3 * weight.max())
    weight = jnp.where(weight > 0, weight, 1.0)
    cost = problem.total_cost(xs, us)
    reduction = jnp.sum(gradient**2 / weight) / (problem.dt * cost_scale(cost, cost))
    status = start_status(problem, xs, us, input_status(problem, x0, us))
    fine = jnp.isfinite(ys).all() & jnp.isfinite(reduction)
    bad = Status.of(Reason.NONFINITE_DERIVATIVE, first_nonfinite(ys[:-1]))
    running = status.is_(Reason.RUNNING)
    return _Guess(ys, weight, reduction, _status.where(running & ~fine, bad, status))


def _from_grid(ys: np.ndarray) -> Path:
    """Return the path through states and costates at the grid's points, (T+1, 2 nx)."""
    s = np.linspace(0.0, 1.0, len(ys))
    return Path(s, ys, lambda at: np.stack([np.interp(at, s, y) for y in ys.T], axis=1))


def _on_grid(problem: Problem, x0: Array, path: Path, price: Array):
    """Return the best roll-out of a path's controls, xs, us, where H is minimised (T,), and the
    cost in continuous time."""
    T, hamiltonian = problem.num_steps, Hamiltonian(problem, price)
    begins = np.arange(T) / T
    choices, fine = [], np.ones(T, bool)
    for s in (begins, begins + 0.5 / T):
        us, minimised = controls(hamiltonian, s, path.at(s))
        choices.append(us)
        fine &= minimised
    # Between the grid's points too.
    nodes, minimised = controls(hamiltonian, path.s, path.ys)
    steps = np.minimum((path.s * T).astype(int), T - 1)
    np.logical_and.at(fine, steps, minimised)
    xs = path.at(np.linspace(0.0, 1.0, T + 1))[:, : x0.size]
    best = _best(problem, x0, jnp.asarray(xs, x0.dtype), jnp.asarray(choices, x0.dtype))
    along = [jnp.asarray(a, x0.dtype) for a in (path.s, path.ys[:, : x0.size], nodes)]
    return *best, fine, float(_continuous_cost(problem, *along))


@jit
def _continuous_cost(problem: Problem, s: Array, xs: Array, us: Array) -> Array:
    """Return the cost of a path, by the trapezoidal rule over its nodes s (n,), shape ()."""
    t = s * problem.duration
    rates = jax.vmap(problem.running)(xs, us, t)
    return jnp.sum(0.5 * (rates[1:] + rates[:-1]) * jnp.diff(t)) + problem.end(xs[-1])


@jit
def _best(problem: Problem, x0: Array, xs: Array, choices: Array) -> tuple[Array, Array]:
    """Return the cheapest roll-out (T+1, nx), (T, nu) of controls (n, T, nu) along states xs."""
    bounds = problem.bounds
    choices = clip(choices, bounds)

    def both(us):
        system = factorise(expand(problem, xs, us), _inside(us, bounds))
        closed = rollout_law(problem, xs.at[0].set(x0), us, jnp.zeros_like(us), system.K, bounds)
        return jax.tree.map(lambda *a: jnp.stack(a), (problem.rollout(x0, us), us), closed)

    rolled, us = jax.vmap(both)(choices)
    rolled, us = (a.reshape(-1, *a.shape[2:]) for a in (rolled, us))
    costs = jax.vmap(problem.total_cost)(rolled, us)
    best = jnp.argmin(jnp.where(jnp.isnan(costs), jnp.inf, costs))
    return rolled[best], us[best]


def _inside(us: Array, bounds) -> Array:
    """Tell which controls are at no bound, (T, nu)."""
    return jnp.ones(us.shape, bool) if bounds is None else (us > bounds[0]) & (us < bounds[1])


@jit
def _solution(problem: Problem, xs: Array, us: Array, status: Status, rounds: int) -> Solution:
    """Return a trajectory of the grid as a solution, with its gradient and gains there."""
    bounds = problem.bounds
    model = expand(problem, xs, us)
    system = factorise(model, _inside(us, bounds))
    cost = problem.total_cost(xs, us)
    curvature = jnp.diagonal(system.Quu, axis1=1, axis2=2)
    gradient = costates(model)[1]
    gradient = projected_gradient(us, gradient, curvature, cost_scale(cost, cost), bounds)
    none = jnp.zeros_like(us)
    record = Record(cost, gradient, jnp.full_like(cost, jnp.nan), jnp.zeros_like(cost))
    return Solution(
        xs=xs,
        us=us,
        nominal_cost=cost,
        expected_cost=cost,
        policy=AffinePolicy(xs, us, none, system.K, bounds, problem.dt),
        status=status,
        gradient=gradient,
        history=jax.tree.map(lambda a: a[None], record),
        num_steps=jnp.asarray(rounds),
    )


def _check(problem: Problem, x0: Array, us: Array) -> None:
    """Raise TypeError for what is traced, and ValueError for what has no boundary-value problem."""
    if not is_concrete(*jax.tree.leaves((problem, x0, us))):
        raise TypeError(
            "BoundaryValue runs on the host, in SciPy: it cannot be traced by jit, vmap, grad or "
            "solve_batch; solve one problem after another, or use ILQR or DDP"
        )
    if problem.plant.discrete:
        raise ValueError(
            "problem: BoundaryValue solves problems in continuous time, got a discrete plant"
        )
    if problem.terms.events:
        raise ValueError(
            "problem: BoundaryValue knows running and terminal costs alone, got a cost with "
            "events (via-points)"
        )
    if problem.terms.residuals:
        names = ", ".join(name.removesuffix(".residual") for _, name in problem.terms.residuals)
        raise ValueError(
            "problem: BoundaryValue knows running and terminal costs alone, got a cost of whole "
            f"steps, {names}"
        )
