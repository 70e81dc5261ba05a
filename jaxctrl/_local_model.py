"""The linear-quadratic expansion of a problem along a trajectory, by automatic differentiation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._problem import Problem
from ._types import LocalModel
from .linear import costates


def expand(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    *,
    second_order: bool = False,
) -> LocalModel:
    """Expand dynamics to first order and cost to second order along xs (T+1, nx), us (T, nu).

    Arguments:
        problem: what to expand.
        xs, us: a trajectory of the problem.
        second_order: add the dynamics' second derivatives, contracted with the costates:
            l_zz += p' f_zz, z = (x, u). The model is then that of Newton's method in the controls;
            without, of Gauss and Newton's.

    Returns: `LocalModel`; the cost blocks include the time step, and events are folded in: an event
    between x_k and x_{k+1} = f(x_k, u_k) is a function of (x_k, u_k).
    """
    nx = problem.plant.nx
    zs = jnp.concatenate([xs[:-1], us], axis=1)
    ts = problem.ts[:-1]

    def step(z, t):
        return problem.step(z[:nx], z[nx:], t)

    def running(z, t):
        return problem.rate * problem.cost.running(problem.plant, z[:nx], z[nx:], t)

    def terminal(x):
        return problem.cost.terminal(problem.plant, x)

    fz = jax.vmap(jax.jacfwd(step))(zs, ts)
    lz = jax.vmap(jax.grad(running))(zs, ts)
    if problem.cost.running_is_quadratic:
        hessian = jax.hessian(running)(jnp.zeros_like(zs[0]), ts[0])
        lzz = jnp.broadcast_to(hessian, (len(zs), *hessian.shape))
    else:
        lzz = jax.vmap(jax.hessian(running))(zs, ts)
    vx = jax.grad(terminal)(xs[-1])
    at = jnp.zeros_like(xs[-1]) if problem.cost.terminal_is_quadratic else xs[-1]
    vxx = jax.hessian(terminal)(at)

    weights = []
    for group in problem.cost.events:
        k, z_gradient, z_hessian, weight = _event_terms(problem, group, xs, fz)
        lz = lz.at[k].add(z_gradient)
        lzz = lzz.at[k].add(z_hessian)
        weights.append((k, weight))
    model = _blocks(fz, lz, lzz, vx, vxx)
    if not second_order:
        return model

    # An event within step k depends on x_{k+1} too, and weighs on f_zz like a costate.
    p, _ = costates(model)
    for k, weight in weights:
        p = p.at[k].add(weight)

    def contracted(p, z, t):
        return jax.hessian(lambda z: p @ step(z, t))(z)

    return _blocks(fz, lz, lzz + jax.vmap(contracted)(p, zs, ts), vx, vxx)


def _event_terms(problem: Problem, group, xs, fz):
    """Return each event's step, its gradient and Hessian in z, and its weight on x_{k+1}."""
    k, _, states = problem.event_values(group, xs)
    _, fraction = problem.event_steps(group.times)
    index = jnp.arange(k.size)

    def value(x, i):
        return group.value(problem.plant, x, i)

    gradient = jax.vmap(jax.grad(value))(states, index)
    hessian = jax.vmap(jax.hessian(value))(states, index)
    nx = problem.plant.nx
    here = jnp.eye(nx, fz.shape[-1], dtype=xs.dtype)
    jacobian = (1 - fraction)[:, None, None] * here + fraction[:, None, None] * fz[k]
    z_gradient = jnp.einsum("mxz,mx->mz", jacobian, gradient)
    z_hessian = jnp.einsum("mxz,mxy,myw->mzw", jacobian, hessian, jacobian)
    return k, z_gradient, z_hessian, fraction[:, None] * gradient


def _blocks(fz, lz, lzz, vx, vxx) -> LocalModel:
    nx = vx.size
    return LocalModel(
        fx=fz[:, :, :nx],
        fu=fz[:, :, nx:],
        lx=lz[:, :nx],
        lu=lz[:, nx:],
        lxx=lzz[:, :nx, :nx],
        lux=lzz[:, nx:, :nx],
        luu=lzz[:, nx:, nx:],
        vx=vx,
        vxx=vxx,
    )
