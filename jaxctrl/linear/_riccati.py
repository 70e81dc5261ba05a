"""The Riccati sweep over a local model, with or without bounds on the controls.

    Q_x  = l_x + f_x' V_x          Q_xx = l_xx + f_x' V_xx f_x
    Q_u  = l_u + f_u' V_x          Q_ux = l_ux + f_u' V_xx f_x
                                   Q_uu = l_uu + f_u' V_xx f_u

    k = -Q_uu^-1 Q_u,  K = -Q_uu^-1 Q_ux

    V_x  <- l_x + l_ux'k + K'(l_u + l_uu k) + F'(V_x + V_xx f_u k),     F = f_x + f_u K
    V_xx <- l_xx + l_ux'K + K'l_ux + K'l_uu K + F'V_xx F

The last two lines hold for any k and K. They are Joseph's form: it subtracts no large numbers,
where Q_xx - Q_ux'Q_uu^-1 Q_ux would lose V_xx to round-off, and needs as many products.

Damping d >= 0 adds sum_ki d_ki du_ki^2 / 2 to the model (Levenberg and Marquardt).

Li (2006), eq. 4.12-4.18 (Theorem 1) is its special case l_xx = Q, l_uu = R, l_x = Q x, l_u = R u.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._linalg import cholesky, cholesky_solve, symmetrise
from .._types import LocalModel
from ._boxqp import free_factor


class Sweep(NamedTuple):
    """A law du = k + K dx, and what it promises.

    A step of length a along it changes the model's cost, without the damping, by
    a `linear` + a^2 `quadratic`. `free` tells which controls are not held at a bound, `curvature`
    is the diagonal of each Q_uu, without the damping. `ok` tells whether every Q_uu was positive
    definite; where it was not, `failed` is the last such step of time. `settled` tells whether
    the set of controls at bounds was found.
    """

    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    free: Bool[Array, "T nu"]
    curvature: Float[Array, "T nu"]
    linear: Float[Array, ""]
    quadratic: Float[Array, ""]
    ok: Bool[Array, ""]
    failed: Int[Array, ""]
    settled: Bool[Array, ""]


def costates(model: LocalModel) -> tuple[Float[Array, "T nx"], Float[Array, "T nu"]]:
    """Return the costates and the gradient of the total cost in the controls.

    p_T = v_x, p_k = l_x + f_x' p_{k+1}, and dJ/du_k = l_u + f_u' p_{k+1} (Pontryagin's
    principle on the grid).

    Returns: p_1 ... p_T, shape (T, nx), and the gradient, shape (T, nu).
    """

    def body(p, stage):
        fx, fu, lx, lu = stage
        return lx + fx.T @ p, (p, lu + fu.T @ p)

    stages = (model.fx, model.fu, model.lx, model.lu)
    _, (p, gradient) = jax.lax.scan(body, model.vx, stages, reverse=True)
    return p, gradient


def damp(model: LocalModel, damping: ArrayLike) -> LocalModel:
    """Return the model with damping, a scalar or (T, nu), added to the diagonal of each l_uu."""
    damping = jnp.broadcast_to(damping, model.lu.shape)
    return model._replace(luu=model.luu + jax.vmap(jnp.diag)(damping))


def last_failure(ok: Bool[Array, " T"]) -> Int[Array, ""]:
    """Return the last step that is not ok, or -1."""
    last = ok.size - 1 - jnp.argmax(~ok[::-1])
    return jnp.where(ok.all(), -1, last).astype(jnp.int32)


def lqr(model: LocalModel, damping: ArrayLike = 0.0) -> Sweep:
    """Sweep the Riccati recursion backwards through a local model (the module's equations).

    Arguments:
        model: local expansion; every array but the last two leads with time.
        damping: d >= 0, scalar or (T, nu) [cost per control unit squared].

    Returns: `Sweep`.
    """

    def body(V, stage):
        Vx, Vxx = V
        fx, fu, lx, lu, lxx, lux, luu = stage
        VB = Vxx @ fu
        Qu, Qux = lu + fu.T @ Vx, lux + VB.T @ fx
        Quu = symmetrise(luu + fu.T @ VB)
        factor, ok = cholesky(Quu)
        solved = -cholesky_solve(factor, jnp.concatenate([Qu[:, None], Qux], axis=1))
        solved = jnp.where(ok, solved, 0.0)
        k, K = solved[:, 0], solved[:, 1:]
        F = fx + fu @ K
        Vx = lx + lux.T @ k + K.T @ (lu + luu @ k) + F.T @ (Vx + VB @ k)
        Vxx = _closed_loop(Vxx, F, K, lxx, lux, luu)
        return (Vx, Vxx), (k, K, jnp.diagonal(Quu), ok)

    damped = damp(model, damping)
    _, (k, K, curvature, ok) = jax.lax.scan(body, (model.vx, model.vxx), damped[:-2], reverse=True)
    linear, quadratic, _ = model_change(model, k, K)
    free = jnp.ones(k.shape, bool)
    curvature = curvature - jnp.broadcast_to(damping, curvature.shape)
    settled = jnp.array(True)
    return Sweep(k, K, free, curvature, linear, quadratic, ok.all(), last_failure(ok), settled)


def _closed_loop(Vxx: Array, F: Array, K: Array, lxx: Array, lux: Array, luu: Array) -> Array:
    """Return the V_xx before a step whose closed loop is dx -> F dx, in Joseph's form."""
    across = lux.T @ K
    return symmetrise(lxx + across + across.T + K.T @ luu @ K + F.T @ Vxx @ F)


def model_change(model: LocalModel, k: Array, K: Array) -> tuple[Array, Array, Array]:
    """Roll the law du = k + K dx out on the model.

    Returns: the linear and the quadratic part of the change of the model's cost, and du (T, nu).
    """
    dxs, dus = lqr_rollout(model, k, K, jnp.zeros_like(model.vx))
    dx = dxs[:-1]
    linear = jnp.sum(model.lx * dx) + jnp.sum(model.lu * dus) + model.vx @ dxs[-1]
    quadratic = 0.5 * dxs[-1] @ model.vxx @ dxs[-1] + (
        0.5 * jnp.einsum("ti,tij,tj", dx, model.lxx, dx)
        + jnp.einsum("ti,tij,tj", dus, model.lux, dx)
        + 0.5 * jnp.einsum("ti,tij,tj", dus, model.luu, dus)
    )
    return linear, quadratic, dus


class FreeLQR(NamedTuple):
    """A factorised linear-quadratic problem in the free controls; see `factorise`."""

    model: LocalModel
    free: Bool[Array, "T nu"]
    VB: Float[Array, "T nx nu"]
    Quu: Float[Array, "T nu nu"]
    factor: Float[Array, "T nu nu"]
    K: Float[Array, "T nu nx"]
    ok: Bool[Array, " T"]


def factorise(model: LocalModel, free: Bool[Array, "T nu"]) -> FreeLQR:
    """Do the part of a sweep that depends on neither linear terms nor held controls.

    Arguments:
        model: local expansion; its linear terms are not used.
        free: which controls may move, shape (T, nu).

    Returns: `FreeLQR`, for `solve_factorised`; `ok` (T,) tells at which steps the problem is
    strictly convex in the free controls; elsewhere the gains are zero.
    """

    def body(Vxx, stage):
        fx, fu, lxx, lux, luu, free = stage
        VB = Vxx @ fu
        Quu, Qux = symmetrise(luu + fu.T @ VB), lux + VB.T @ fx
        factor, ok = free_factor(Quu, free)
        K = -cholesky_solve(factor, jnp.where(free[:, None] & ok, Qux, 0.0))
        Vxx = _closed_loop(Vxx, fx + fu @ K, K, lxx, lux, luu)
        return Vxx, (VB, Quu, factor, K, ok)

    stages = (model.fx, model.fu, model.lxx, model.lux, model.luu, free)
    _, (VB, Quu, factor, K, ok) = jax.lax.scan(body, model.vxx, stages, reverse=True)
    return FreeLQR(model, free, VB, Quu, factor, K, ok)


def solve_factorised(
    problem: FreeLQR,
    linear: Float[Array, "T nu"],
    held: Float[Array, "T nu"],
    lx: Float[Array, "T nx"] | None = None,
    vx: Float[Array, " nx"] | None = None,
) -> Float[Array, "T nu"]:
    """Return the k (T, nu) of the law du = k + K dx that solves a factorised problem.

    Linear in every argument but the first, and transposable.

    Arguments:
        problem: a factorised problem.
        linear: linear terms of the controls, shape (T, nu).
        held: the values of the controls that are not free, shape (T, nu).
        lx, vx: linear terms of the states, (T, nx), and of the last state, (nx,); zero by default.
    """
    m, free = problem.model, problem.free
    lx = jnp.zeros_like(m.lx) if lx is None else lx
    vx = jnp.zeros_like(m.vx) if vx is None else vx
    held = jnp.where(free, 0.0, held)

    def back(Vx, stage):
        fx, fu, lx, b, lux, luu, VB, Quu, factor, K, free, held = stage
        rhs = jnp.where(free, b + fu.T @ Vx + Quu @ held, 0.0)
        k = held - cholesky_solve(factor, rhs[:, None])[:, 0]
        F = fx + fu @ K
        return lx + lux.T @ k + K.T @ (b + luu @ k) + F.T @ (Vx + VB @ k), k

    p = problem
    stages = (m.fx, m.fu, lx, linear, m.lux, m.luu, p.VB, p.Quu, p.factor, p.K, free, held)
    return jax.lax.scan(back, vx, stages, reverse=True)[1]


def lqr_rollout(
    model: LocalModel,
    k: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
    dx0: Float[Array, " nx"],
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Return dxs (T+1, nx) and dus (T, nu) of the law du = k + K dx on the linear model."""

    def body(dx, stage):
        fx, fu, k, K = stage
        du = k + K @ dx
        after = fx @ dx + fu @ du
        return after, (after, du)

    _, (dxs, dus) = jax.lax.scan(body, dx0, (model.fx, model.fu, k, K))
    return jnp.concatenate([dx0[None], dxs]), dus
