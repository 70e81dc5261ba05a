"""Derivatives of an optimum by the implicit function theorem.

The optimal controls are a zero of r(u; p) = u - clip(u - g(u; p), lower, upper), with g the
gradient of the cost in the controls and p everything else: x0, the plant, the cost, dt, bounds.
With A the set of controls at a bound and F the others, differentiating r = 0 gives

    du_A = dbound_A,     H_FF du_F = -(dg/dp dp)_F - H_FA du_A,

with H the exact Hessian of the cost in the controls, the dynamics' second derivatives included:
Gauss and Newton's would be wrong wherever the optimal cost is not zero. With the Lagrangian
L_k = l_k + p_{k+1}'f_k of each step, p the costates, this is one linear-quadratic problem,

    minimise   sum_k z_k'(L_zz)_k z_k / 2 + z_k'(dL_z)_k + x_T'v_xx x_T / 2 + x_T'dv_x,
    dx_{k+1} = f_x dx_k + f_u du_k + (df)_k,

where (dL_z), (dv_x) and (df) are the changes with p along the fixed trajectory: all local in time.
Its solution, one Riccati sweep, is the derivative of the states and of the controls. That of the
cost needs no sweep (the envelope theorem): sum_k (dL)_k + dv + p_0'dx0 + g_A'dbound_A.

Which controls are at a bound is what the solver's last sweep held, not what a comparison of floats
says: a control may settle a unit of rounding inside its bound.

The gains are those of one sweep of the solver's own model at the optimum, K = K(x, u; p), with the
controls at bounds held; their derivative is that sweep's, along the derivatives of x, u and p.
"""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array

from ._jacobian import push_forward
from ._local_model import expand, stage_lagrangian
from ._problem import Problem
from ._solver import AbstractSolver
from .linear._factorised import factorise, solve_factorised
from .linear._riccati import costates

Found = tuple[Array, Array, Array]


def known_sides(problem: Problem, us: Array, side: Array) -> Array:
    """Return which bound each control is at, (T, nu): `side`, or, where that is NaN, the one that
    it all but touches."""
    if problem.bounds is None:
        return jnp.zeros_like(us)
    lower, upper = problem.bounds
    size = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
    room = jnp.finfo(us.dtype).eps ** 0.4 * jnp.where(jnp.isfinite(size), size, 0.0)
    touched = jnp.where(us <= lower + room, -1.0, jnp.where(us >= upper - room, 1.0, 0.0))
    return jnp.where(jnp.isnan(side), touched, side).astype(us.dtype)


@eqx.filter_custom_jvp
def attach(found: Found, problem: Problem, x0: Array, side: Array, ok: Array) -> Found:
    """Return an optimum, found = (xs (T+1, nx), us (T, nu), cost ()), with its derivatives.

    Differentiable in the problem and in x0 (nx,); `found` itself is taken as it is: the optimum
    does not depend on how it was reached. `side` (T, nu) tells which controls are at a bound. Where
    `ok` is False all derivatives are NaN, except that a zero cotangent gives zero. To first order
    `found` need only be near the optimum; second derivatives follow by differentiating the rule, in
    which the optimum is again a function of p.
    """
    return found


@attach.def_jvp
def _attach_jvp(primals, tangents):
    found, problem, x0, side, ok = primals
    _, t_problem, t_x0, _, _ = tangents
    found = attach(found, problem, x0, side, ok)
    # What overflows in a failed lane must not reach the others, multiplied by zero.
    xs, us, problem = tame((found[0], found[1], problem), ok)
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)
    t_arrays, t_x0 = instantiate(arrays, t_problem), instantiate(x0, t_x0)
    every, _ = jax.flatten_util.ravel_pytree((t_arrays, t_x0))

    model = expand(problem, xs, us, second_order=True)
    p, gradient = costates(model)

    def local(arrays):
        problem = eqx.combine(arrays, static)
        along = problem.replay(xs, us)
        value, slopes = stage_lagrangian(problem, xs, us, p)
        return along, value, slopes, problem.bounds

    _, (offset, value, (lx, lu, vx), t_bounds) = push_forward(local, arrays, t_problem)
    free = side == 0
    held = jnp.zeros_like(us)
    if t_bounds is not None:
        held = jnp.where(side < 0, t_bounds[0], jnp.where(side > 0, t_bounds[1], 0.0))
    system = factorise(model, free)
    t_xs, t_us = solve_factorised(system, lu, held, lx=lx, vx=vx, offset=offset, dx0=t_x0)
    start = model.lx[0] + model.fx[0].T @ p[0]
    t_cost = value + start @ t_x0 + jnp.sum(jnp.where(free, 0.0, gradient * held))
    # Not a strict minimum, the trajectory has no derivative; the cost still has one.
    fine = ok & system.ok.all()
    alarm = jnp.sum(nan_unless(fine, every))
    return found, (
        t_xs + nan_unless(fine, t_xs) + alarm,
        t_us + nan_unless(fine, t_us) + alarm,
        t_cost + nan_unless(ok, t_cost) + jnp.sum(nan_unless(ok, every)),
    )


@eqx.filter_custom_jvp
def attach_gains(
    K: Array,
    problem: Problem,
    xs: Array,
    us: Array,
    side: Array,
    ok: Array,
    solver: AbstractSolver,
) -> Array:
    """Return an optimum's gains K (T, nu, nx) with their derivatives.

    Differentiable in the problem and in the optimum's xs (T+1, nx) and us (T, nu), as
    `solver.gains` is. Where `ok` is False, or where that gives other gains, derivatives are NaN.
    """
    return K


@attach_gains.def_jvp
def _gains_jvp(primals, tangents):
    K, problem, xs, us, side, ok, solver = primals
    _, t_problem, t_xs, t_us, _, _, _ = tangents
    K = attach_gains(K, problem, xs, us, side, ok, solver)
    xs, us, problem = tame((xs, us, problem), ok)
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)
    given = (arrays, xs, us)
    along = (instantiate(arrays, t_problem), instantiate(xs, t_xs), instantiate(us, t_us))

    def gains(given):
        arrays, xs, us = given
        return solver.gains(eqx.combine(arrays, static), xs, us, side)

    again, t_K = push_forward(gains, given, (t_problem, t_xs, t_us))
    room = jnp.finfo(K.dtype).eps ** (1 / 3) * jnp.max(jnp.abs(K), initial=0.0)
    fine = ok & (jnp.abs(again - K) <= room).all()
    every, _ = jax.flatten_util.ravel_pytree(along)
    return K, t_K + nan_unless(fine, t_K) + jnp.sum(nan_unless(fine, every))


def nan_unless(ok: Array, tangent: Array) -> Array:
    """Return zeros where `ok`; else NaN, but zero for a zero tangent. Linear, and transposed so.

    Nothing finite stays finite after three factors `huge`, and inf times zero is NaN; zero stays
    zero, which a product with NaN would not leave it. The factors read the same backwards.
    """
    huge = jnp.where(ok, 0.0, jnp.finfo(tangent.dtype).max).astype(tangent.dtype)
    for factor in (huge, huge, huge, jnp.zeros_like(huge), huge, huge, huge):
        tangent = tangent * factor
    return tangent


def tame(tree, ok: Array):
    """Unless `ok`, replace by 1 what is not finite, or so large that its powers would overflow."""

    def tamed(leaf):
        if not eqx.is_inexact_array(leaf):
            return leaf
        small = jnp.abs(leaf) <= jnp.finfo(leaf.dtype).max ** 0.03
        return jnp.where(ok | small, leaf, jnp.ones((), leaf.dtype))

    return jax.tree.map(tamed, tree)


def instantiate(tree, tangents):
    """Return tangents of the shape of `tree`'s arrays, zero where None."""

    def instantiated(leaf, tangent):
        if leaf is None:
            return None
        return jnp.zeros_like(leaf) if tangent is None else tangent

    arrays = eqx.filter(tree, eqx.is_inexact_array)
    return jax.tree.map(instantiated, arrays, tangents, is_leaf=lambda leaf: leaf is None)
