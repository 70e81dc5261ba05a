"""Derivatives of an optimum by the implicit function theorem.

The optimal controls are a zero of r(u; p) = u - clip(u - g(u; p), lower, upper), with g the
gradient of the cost in the controls and p everything else: x0, the plant, the cost, dt, bounds.
With A the set of controls at a bound and F the others, differentiating r = 0 gives

    du_A = dbound_A,     H_FF du_F = -(dg/dp dp)_F - H_FA du_A,

with H the exact Hessian of the cost in the controls, the dynamics' second derivatives included:
Gauss and Newton's would be wrong wherever the optimal cost is not zero. H has the structure of a
linear-quadratic problem, so that one Riccati sweep solves the system.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._local_model import expand
from .._problem import Problem
from ..linear import factorise, lqr_rollout, solve_factorised


def _gradient(problem: Problem, x0: Array, us: Array) -> Array:
    """Return dJ/du, shape (T, nu), of the cost as a function of the controls alone."""
    return jax.grad(lambda us: problem.total_cost(problem.rollout(x0, us), us))(us)


@eqx.filter_custom_jvp
def attach(us: Array, problem: Problem, x0: Array, converged: Array) -> Array:
    """Return the optimal controls us (T, nu), differentiable in the problem and in x0 (nx,).

    `us` itself is taken as found: the optimum does not depend on how it was reached. Where
    `converged` is False, derivatives are NaN.
    """
    return us


def _instantiate(tree, tangents):
    """Return tangents of the shape of `tree`'s arrays, zero where None."""

    def instantiate(leaf, tangent):
        if leaf is None:
            return None
        return jnp.zeros_like(leaf) if tangent is None else tangent

    arrays = eqx.filter(tree, eqx.is_inexact_array)
    return jax.tree.map(instantiate, arrays, tangents, is_leaf=lambda leaf: leaf is None)


@attach.def_jvp
def _attach_jvp(primals, tangents):
    us, problem, x0, converged = primals
    _, t_problem, t_x0, _ = tangents
    us = attach(us, problem, x0, converged)
    arrays, static = eqx.partition((problem, x0), eqx.is_inexact_array)
    t_arrays = _instantiate((problem, x0), (t_problem, t_x0))

    def gradient(arrays):
        problem, x0 = eqx.combine(arrays, static)
        return _gradient(problem, x0, us)

    def bounds(arrays):
        problem, _ = eqx.combine(arrays, static)
        return problem.bounds

    g, t_gradient = jax.jvp(gradient, (arrays,), (t_arrays,))
    if problem.bounds is None:
        free, held = jnp.ones(us.shape, bool), jnp.zeros_like(us)
    else:
        (lower, upper), (t_lower, t_upper) = jax.jvp(bounds, (arrays,), (t_arrays,))
        at_lower, at_upper = (us <= lower) & (g >= 0), (us >= upper) & (g <= 0)
        free = ~(at_lower | at_upper)
        held = jnp.where(at_lower, t_lower, jnp.where(at_upper, t_upper, 0.0))
    model = expand(problem, problem.rollout(x0, us), us, second_order=True)
    system = factorise(model, free)
    k = solve_factorised(system, t_gradient, held)
    _, t_us = lqr_rollout(system.model, k, system.K, jnp.zeros_like(x0))
    return us, t_us * jnp.where(converged & system.ok.all(), 1.0, jnp.nan)
