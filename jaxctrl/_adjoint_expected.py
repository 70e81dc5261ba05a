"""Derivatives of a stochastic solver's end: of controls, gains, expected cost and covariances.

Such a solver ends where its own law is at rest: g(u; p) = 0 for the controls that are free, with g
the gradient of its local model, noise included, and the others at their bounds. That is no gradient
of the expected cost, whose envelope theorem does not hold here. Differentiating g,

    (dg/du)_FF du_F = -(dg/dp dp)_F - (dg/du)_FA dbound_A,

a linear system with one unknown for each free control. dg/du holds third derivatives of the
dynamics, weighed by the noise; it is applied, never formed, in GMRES iterations (Saad & Schultz
1986) that the Hessian of the nominal cost and of the noise's own second moments preconditions: one
Riccati sweep each. First Newton steps with the same system bring g to round-off.

All else is a function of the controls and of p: the derivatives follow by the chain rule.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jax.scipy.sparse.linalg import gmres
from jaxtyping import Array, Bool, Float

from ._adjoint import instantiate, nan_unless, tame
from ._estimator import LinearFilter, filter_around
from ._jacobian import push_forward
from ._local_model import expand
from ._prediction import Prediction, foresee, noise_cost, predict
from ._problem import Problem
from ._solver import AbstractSolver
from .linear._factorised import factorise, solve_factorised
from .linear._riccati import Holding, sweep

NEWTON_STEPS = 3
POLISHED = 0.6
"""What the last Newton step is worth on the model is below this power of eps, squared, of the cost:
4e-10 in float64."""
RESTART, ROUNDS = 30, 10
"""Of GMRES: how many directions it keeps, and how often it begins again."""
PRECISE = 0.75
"""The relative error at which the linear system ends, as a power of eps: 2e-12 in float64."""


class Expected(NamedTuple):
    """What a stochastic solver has found: a movement, its gains, and what they promise."""

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    nominal_cost: Float[Array, ""]
    expected_cost: Float[Array, ""]
    prediction: Prediction | None
    estimator: LinearFilter | None = None


def outcome(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
) -> Expected:
    """Return what gains K (T, nu, nx) around a trajectory xs (T+1, nx), us (T, nu) promise.

    With a sensor they act on the estimate of the best filter for them.
    """
    model = expand(problem, xs, us, noise=True)
    cost = problem.total_cost(xs, us)
    if model.sensing is None:
        expected = cost + noise_cost(problem, model, K)
        return Expected(xs, us, K, cost, expected, predict(problem, model, xs, us, K))
    prediction, found = foresee(model, xs, us, K)
    estimator = filter_around(problem, model, xs, us, found)
    return Expected(xs, us, K, cost, cost + found.cost, prediction, estimator)


@eqx.filter_custom_jvp
def attach_expected(
    found: Expected, problem: Problem, x0: Array, side: Array, ok: Array, solver: AbstractSolver
) -> Expected:
    """Return what was found with its derivatives in the problem and in x0 (nx,).

    `side` (T, nu) tells which controls are at a bound. Where `ok` is False, or the law cannot be
    brought to rest, derivatives are NaN, except that a zero cotangent gives zero.
    """
    return found


@attach_expected.def_jvp
def _attach_jvp(primals, tangents):
    found, problem, x0, side, ok, solver = primals
    _, t_problem, t_x0, _, _, _ = tangents
    found = attach_expected(found, problem, x0, side, ok, solver)
    us, x0, problem = tame((found.us, x0, problem), ok)
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)
    given = jax.lax.stop_gradient((us, arrays, x0, side))
    us, rested = _rest(*given, static, solver, jax.lax.stop_gradient(found.expected_cost))

    def everything(given):
        arrays, x0 = given
        problem = eqx.combine(arrays, static)
        at_rest = _attach_controls(us, arrays, x0, side, static, solver)
        xs = problem.rollout(x0, at_rest)
        return outcome(problem, xs, at_rest, solver.gains(problem, xs, at_rest, side))

    _, pushed = push_forward(everything, (arrays, x0), (t_problem, t_x0))
    along = (instantiate(arrays, t_problem), instantiate(x0, t_x0))
    every, _ = jax.flatten_util.ravel_pytree(along)
    fine = ok & rested
    alarm = jnp.sum(nan_unless(fine, every))
    return found, jax.tree.map(lambda t: t + nan_unless(fine, t) + alarm, pushed)


def _residual(us, arrays, x0, side, static, solver) -> Float[Array, "T nu"]:
    """Return the model's gradient in the free controls, and how far others are from bounds."""
    problem = eqx.combine(arrays, static)
    model = solver.known(problem, problem.rollout(x0, us), us, side)
    none = jnp.zeros_like(us)
    rule = Holding(side == 0, none, none, none)
    gradient = sweep(model, rule, lambda step: step.gradient)[1]
    if problem.bounds is None:
        return gradient
    lower, upper = problem.bounds
    return jnp.where(side < 0, us - lower, jnp.where(side > 0, us - upper, gradient))


def _solve(us, arrays, x0, side, static, solver, rhs) -> tuple[Array, Array]:
    """Return du with (dr/du) du = rhs, r the residual, both (T, nu), and the diagonal of Q_uu."""
    free = side == 0
    problem = eqx.combine(arrays, static)
    slope = jax.linearize(lambda us: _residual(us, arrays, x0, side, static, solver), us)[1]
    fixed = jax.lax.stop_gradient(solver.known(problem, problem.rollout(x0, us), us, side))
    near = factorise(fixed, free)

    def apply(du):
        return jnp.where(free, slope(jnp.where(free, du, 0.0)), du)

    def precondition(r):
        return jnp.where(free, solve_factorised(near, -r, jnp.zeros_like(r))[1], r)

    held = jnp.where(free, 0.0, rhs)
    rhs = jnp.where(free, rhs - slope(held), rhs)

    def solve(apply, rhs):
        tol = float(jnp.finfo(rhs.dtype).eps) ** PRECISE
        return gmres(apply, rhs, tol=tol, restart=RESTART, maxiter=ROUNDS, M=precondition)[0]

    # Transposed, it is the same system's transpose, which the same preconditioner fits.
    du = jax.lax.custom_linear_solve(apply, rhs, solve=solve, transpose_solve=solve)
    return du, jnp.diagonal(near.Quu, axis1=1, axis2=2)


def _rest(us, arrays, x0, side, static, solver, cost) -> tuple[Array, Bool[Array, ""]]:
    """Bring the law to rest by Newton's method; return the controls (T, nu), and whether it is."""

    def newton(_, carry):
        us, _ = carry
        off = _residual(us, arrays, x0, side, static, solver)
        step, curvature = _solve(us, arrays, x0, side, static, solver, off)
        return us - step, jnp.sum(curvature * step**2)

    start = (us, jnp.full((), jnp.inf, us.dtype))
    us, worth = jax.lax.fori_loop(0, NEWTON_STEPS, newton, start)
    return us, worth <= jnp.finfo(us.dtype).eps ** (2 * POLISHED) * jnp.abs(cost)


@eqx.filter_custom_jvp
def _attach_controls(us, arrays, x0, side, static, solver) -> Float[Array, "T nu"]:
    """Return controls at rest, us (T, nu), with their derivatives in the arrays and x0 (nx,)."""
    return us


@_attach_controls.def_jvp
def _controls_jvp(primals, tangents):
    us, arrays, x0, side, static, solver = primals
    _, t_arrays, t_x0, _, _, _ = tangents
    us = _attach_controls(us, arrays, x0, side, static, solver)

    def residual(given):
        arrays, x0 = given
        return _residual(us, arrays, x0, side, static, solver)

    _, pushed = push_forward(residual, (arrays, x0), (t_arrays, t_x0))
    return us, -_solve(us, arrays, x0, side, static, solver, pushed)[0]
