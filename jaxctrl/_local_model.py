"""The linear-quadratic expansion of a problem along a trajectory, by automatic differentiation."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._jacobian import dependence, gradient, jacobian, value_and_gradient
from ._noise import diffusion
from ._problem import Problem
from ._sensor import reading, reading_noise
from ._types import LocalModel, Noise, Rows, Sensing
from .linear._riccati import costates


def expand(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    *,
    second_order: bool | Bool[Array, ""] = False,
    noise: bool = False,
) -> LocalModel:
    """Expand dynamics to first order and cost to second order along xs (T+1, nx), us (T, nu).

    Arguments:
        problem: what to expand.
        xs, us: a trajectory of the problem.
        second_order: add the dynamics' second derivatives, contracted with the costates, and those
            of `AbstractResidual`s: l_zz += p' f_zz + rho' rho_zz, z = (x, u). The
            model is then that of Newton's method in the controls; without, of Gauss and Newton's.
            May be traced.
        noise: expand the problem's noise, too, to first order: sqrt(dt) F and its slopes; and its
            sensor with that noise, G/sqrt(dt).

    Returns: `LocalModel`; the cost blocks include the time step, and events are folded in: an event
    between x_k and x_{k+1} = f(x_k, u_k) is a function of (x_k, u_k).
    """
    nx = problem.plant.nx
    zs = jnp.concatenate([xs[:-1], us], axis=1)
    ts = problem.ts[:-1]

    def step(z, t):
        return problem.step(z[:nx], z[nx:], t)

    fz = jax.vmap(jacobian(step))(zs, ts)
    lz, lzz = _running_terms(problem, zs, ts)
    vx = gradient(problem.end)(xs[-1])
    vxx = jacobian(gradient(problem.end), symmetric=True)(xs[-1])

    rho, added, squared = _residual_terms(problem, zs, ts)
    lz, lzz = lz + added, lzz + squared

    disturbance = _noise_terms(problem, zs, ts) if noise else None
    weights = []
    for group in problem.terms.events:
        k, z_gradient, z_hessian, weight, between = _event_terms(problem, group, xs, fz)
        lz = lz.at[k].add(z_gradient)
        lzz = lzz.at[k].add(z_hessian)
        weights.append((k, weight))
        if disturbance is not None:
            disturbance = _weighed(disturbance, k, between)
    uncertain = {"noise": disturbance} | (_uncertain(problem, zs, xs[0], ts) if noise else {})
    model = _blocks(fz, lz, lzz, vx, vxx)._replace(**uncertain)
    if second_order is False:
        return model

    # An event within step k depends on x_{k+1} too, and weighs on f_zz like a costate.
    p, _ = costates(model)
    for k, weight in weights:
        p = p.at[k].add(weight)

    def exact():
        return lzz + _curvature(problem, zs, ts, p, rho)

    lzz = exact() if second_order is True else jax.lax.cond(second_order, exact, lambda: lzz)
    return _blocks(fz, lz, lzz, vx, vxx)._replace(**uncertain)


def _uncertain(problem: Problem, zs, x0, ts) -> dict[str, Any]:
    """Return what is sensed, and the start's spread, where there is a sensor."""
    if problem.sensor is None:
        return {}
    cov = jnp.zeros((x0.size, x0.size), x0.dtype) if problem.x0_cov is None else problem.x0_cov
    return {"sensing": _sensing_terms(problem, zs[:, : x0.size], ts), "x0_cov": cov}


def _noise_terms(problem: Problem, zs, ts) -> Noise | None:
    """Return the columns of sqrt(dt) F (T, nw, nx) with their slopes in x and u, None if none.

    Residuals of the state after a step weigh them within it.
    """
    noise, plant, nx = problem.noise, problem.plant, problem.plant.nx
    if noise is None:
        return None

    def columns(z, t):
        F = jnp.sqrt(problem.rate) * diffusion(noise, plant, z[:nx], z[nx:], t)
        return F.T.reshape(-1)

    c, slopes, rows, sloping = _columns(columns, zs, ts, nx)
    cx = slopes[..., :nx] if sloping[:nx].any() else None
    cu = slopes[..., nx:] if sloping[nx:].any() else None
    weight = _after_terms(problem, zs, ts) if problem.terms.residuals else None
    return Noise(c, cx, cu, rows, weight)


def _columns(columns, zs, ts, n: int) -> tuple[Array, Array, Rows | None, np.ndarray]:
    """Expand the columns (nw n,) that a function returns of z (nz,) and t along a trajectory.

    Returns: columns (T, nw, n), their slopes (T, nw, r, nz) in the rows named, and of which
    entries of z there are any, (nz,).
    """
    c = jax.vmap(columns)(zs, ts)
    slopes = jax.vmap(jacobian(columns))(zs, ts)
    c, slopes = c.reshape(len(zs), -1, n), slopes.reshape(len(zs), -1, n, zs.shape[1])
    pattern = dependence(columns, zs[0], ts[0]).reshape(-1, n, zs.shape[1])
    rows = _rows(np.asarray(pattern.any(axis=2)))
    if rows is not None:
        slopes = slopes[:, np.arange(len(rows.of))[:, None], rows.index]
    return c, slopes, rows, np.asarray(pattern.any(axis=(0, 1)))


def _weighed(noise: Noise, k, weight) -> Noise:
    """Return the noise with a weight (m, nx, nx) added in steps k (m,)."""
    T, _, nx = noise.c.shape
    before = jnp.zeros((T, nx, nx), noise.c.dtype) if noise.weight is None else noise.weight
    return noise._replace(weight=before.at[k].add(weight))


def _after_terms(problem: Problem, zs, ts) -> Float[Array, "T nx nx"]:
    """Return J'J of each step, J the residuals' Jacobian in the state after the step alone."""
    nx = problem.plant.nx

    def residual(after, z, i):
        return problem.residual(z[:nx], z[nx:], after, i)

    after = jax.vmap(lambda z, t: problem.step(z[:nx], z[nx:], t))(zs, ts)
    slopes = jax.vmap(jacobian(residual))(after, zs, jnp.arange(len(zs)))
    return jnp.einsum("tmx,tmy->txy", slopes, slopes)


def _sensing_terms(problem: Problem, xs, ts) -> Sensing:
    """Return what is sensed, to first order, and the columns of G/sqrt(dt)."""
    sensor, plant = problem.sensor, problem.plant
    assert sensor is not None

    def sensed(x, t):
        return reading(sensor, plant, x, t)

    def columns(x, t):
        return (reading_noise(sensor, plant, x, t) / jnp.sqrt(problem.rate)).T.reshape(-1)

    F, y = jax.vmap(jacobian(sensed))(xs, ts), jax.vmap(sensed)(xs, ts)
    F = jnp.where(jnp.isfinite(y)[..., None], F, jnp.nan)  # log(-1) has a slope
    d, slopes, rows, sloping = _columns(columns, xs, ts, F.shape[1])
    return Sensing(F, noise=Noise(d, slopes if sloping.any() else None, rows=rows))


def _rows(sloping: np.ndarray) -> Rows | None:
    """Return the rows of each column that may have a slope, of (nw, nx) flags; None for all.

    Of columns with fewer than others some rows without any are named too.
    """
    most = int(sloping.sum(axis=1).max(initial=0))
    if most in (0, sloping.shape[1]):
        return None
    order = np.argsort(~sloping, axis=1, kind="stable")[:, :most]
    return Rows(tuple(tuple(int(row) for row in rows) for rows in order))


def _curvature(problem: Problem, zs, ts, p, rho):
    """Return p' f_zz + rho' rho_zz, shape (T, nz, nz)."""
    nx = problem.plant.nx

    def slope(z, p, rho, t, i):
        def weighted(z):
            x, u = z[:nx], z[nx:]
            after = problem.step(x, u, t)
            value = jnp.sum(p * after)
            return value + jnp.sum(rho * problem.residual(x, u, after, i)) if rho.size else value

        return gradient(weighted)(z)

    steps = jnp.arange(len(zs))
    return jax.vmap(jacobian(slope, symmetric=True))(zs, p, rho, ts, steps)


def _running_terms(problem: Problem, zs, ts):
    """Return the gradients (T, nz) and Hessians (T, nz, nz) of the running cost in z = (x, u)."""
    nx, steps = problem.plant.nx, jnp.arange(len(zs))

    def running(z, t, i):
        return problem.rate * problem.running(z[:nx], z[nx:], t, i)

    # What does not depend on z, t and i, as the Hessian of a quadratic rate, `vmap` computes once.
    hessian = jacobian(gradient(running), symmetric=True)
    return jax.vmap(gradient(running))(zs, ts, steps), jax.vmap(hessian)(zs, ts, steps)


def _residual_terms(problem: Problem, zs, ts):
    """Return the residuals (T, m), and what half their square adds to gradients and Hessians."""
    nx, steps = problem.plant.nx, jnp.arange(len(zs))
    if not problem.terms.residuals:
        return jnp.zeros((len(zs), 0), zs.dtype), 0.0, 0.0

    def residual(z, t, i):
        x, u = z[:nx], z[nx:]
        return problem.residual(x, u, problem.step(x, u, t), i)

    rho = jax.vmap(residual)(zs, ts, steps)
    slopes = jax.vmap(jacobian(residual))(zs, ts, steps)
    added = jnp.einsum("tmz,tm->tz", slopes, rho)
    return rho, added, jnp.einsum("tmz,tmw->tzw", slopes, slopes)


def _event_terms(problem: Problem, group, xs, fz):
    """Return each event's step, its gradient and Hessian in z, and both in x_{k+1}."""
    k, _, states = problem.event_values(group, xs)
    _, fraction = problem.event_steps(group.times)
    index = jnp.arange(k.size)

    def value(x, i):
        return group.value(problem.plant, x, i)

    slope = jax.vmap(gradient(value))(states, index)
    hessian = jax.vmap(jax.jacfwd(gradient(value)))(states, index)
    nx = problem.plant.nx
    here = jnp.eye(nx, fz.shape[-1], dtype=xs.dtype)
    jacobian = (1 - fraction)[:, None, None] * here + fraction[:, None, None] * fz[k]
    z_gradient = jnp.einsum("mxz,mx->mz", jacobian, slope)
    z_hessian = jnp.einsum("mxz,mxy,myw->mzw", jacobian, hessian, jacobian)
    own = fraction[:, None, None] ** 2 * hessian
    return k, z_gradient, z_hessian, fraction[:, None] * slope, own


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


def stage_lagrangian(
    problem: Problem, xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"], p: Float[Array, "T nx"]
) -> tuple[Array, tuple[Array, Array, Array]]:
    """Return sum_k L_k + v(x_T), L_k = l_k + p_{k+1}'f_k, along a trajectory, and its gradients.

    Events within step k are functions of (x_k, u_k), as in `expand`.

    Arguments: xs (T+1, nx), us (T, nu), and p, the costates p_1 ... p_T (T, nx), held fixed.

    Returns: the value, shape (), and its gradients in x_0 ... x_{T-1} (T, nx), in us (T, nu) and in
    x_T (nx,).
    """
    nx = problem.plant.nx
    zs, ts = jnp.concatenate([xs[:-1], us], axis=1), problem.ts[:-1]

    terms = problem.terms

    def stage(z, p, t, i):
        x, u = z[:nx], z[nx:]
        cost = problem.rate * problem.running(x, u, t, i)
        after = problem.step(x, u, t)
        if terms.residuals:
            cost = cost + 0.5 * jnp.sum(problem.residual(x, u, after, i) ** 2)
        return cost + jnp.sum(p * after)

    values, lz = jax.vmap(value_and_gradient(stage))(zs, p, ts, jnp.arange(len(zs)))
    last, vx = value_and_gradient(problem.end)(xs[-1])
    total = jnp.sum(values) + last
    for group in terms.events:
        k, fraction = problem.event_steps(group.times)

        def event(z, t, fraction, i, value=group.value):
            x = z[:nx] + fraction * (problem.step(z[:nx], z[nx:], t) - z[:nx])
            return value(problem.plant, x, i)

        values, slopes = jax.vmap(value_and_gradient(event))(
            zs[k], ts[k], fraction, jnp.arange(k.size)
        )
        total, lz = total + jnp.sum(values), lz.at[k].add(slopes)
    return total, (lz[:, :nx], lz[:, nx:], vx)
