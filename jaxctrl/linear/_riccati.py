"""The Riccati sweep over a local model, with or without bounds on the controls.

    Q_x  = l_x + f_x' V_x          Q_xx = l_xx + f_x' V_xx f_x
    Q_u  = l_u + f_u' V_x          Q_ux = l_ux + f_u' V_xx f_x
                                   Q_uu = l_uu + f_u' V_xx f_u

    k = -Q_uu^-1 Q_u,  K = -Q_uu^-1 Q_ux

    V_x  <- Q_x + Q_ux'k + K'(Q_u + Q_uu k)
    V_xx <- Q_xx + K'Q_ux

Damping d >= 0 adds sum_ki d_ki du_ki^2 / 2 to the model (Levenberg and Marquardt).

In float32 the last line is Joseph's form, l_xx + l_ux'K + K'l_ux + K'l_uu K + F'V_xx F with
F = f_x + f_u K: it subtracts no large numbers, where the form above would lose V_xx to round-off,
and takes a third longer.

Li (2006), eq. 4.12-4.18 (Theorem 1) is its special case l_xx = Q, l_uu = R, l_x = Q x, l_u = R u.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._linalg import matmul, solve_positive, symmetrise
from .._types import LocalModel


class Sweep(NamedTuple):
    """A law du = k + K dx, and what it promises.

    A step of length a along it changes the damped model's cost by a `linear` + a^2 `quadratic`.
    `gradient` is that of the total cost in the controls, `curvature` the diagonal of each Q_uu less
    the step's own damping. `ok` tells whether every Q_uu was positive definite; where it was not,
    `failed` is the last such step of time. `nonfinite` is the last step of time at which something
    was not finite, T for the last state; -1 where all was. `settled` tells whether the set of
    controls at bounds was found.
    """

    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    gradient: Float[Array, "T nu"]
    curvature: Float[Array, "T nu"]
    linear: Float[Array, ""]
    quadratic: Float[Array, ""]
    ok: Bool[Array, ""]
    failed: Int[Array, ""]
    nonfinite: Int[Array, ""]
    settled: Bool[Array, ""]


def costates(model: LocalModel) -> tuple[Float[Array, "T nx"], Float[Array, "T nu"]]:
    """Return the costates and the gradient of the total cost in the controls.

    p_T = v_x, p_k = l_x + f_x' p_{k+1}, and dJ/du_k = l_u + f_u' p_{k+1} (Pontryagin's
    principle on the grid).

    Returns: p_1 ... p_T, shape (T, nx), and the gradient, shape (T, nu).
    """

    def body(p, stage):
        fx, fu, lx, lu = stage
        return lx + matmul(fx.T, p), (p, lu + matmul(fu.T, p))

    stages = (model.fx, model.fu, model.lx, model.lu)
    _, (p, gradient) = jax.lax.scan(body, model.vx, stages, reverse=True)
    return p, gradient


def last_true(flags: Bool[Array, " n"]) -> Int[Array, ""]:
    """Return the last index at which a flag is set, or -1."""
    last = flags.size - 1 - jnp.argmax(flags[::-1])
    return jnp.where(flags.any(), last, -1).astype(jnp.int32)


def lqr(model: LocalModel, damping: ArrayLike = 0.0) -> Sweep:
    """Sweep the Riccati recursion backwards through a local model (the module's equations).

    Arguments:
        model: local expansion; every array but the last two leads with time.
        damping: d >= 0, scalar or (T, nu) [cost per control unit squared].

    Returns: `Sweep`.
    """
    damping = jnp.broadcast_to(damping, model.lu.shape)

    def body(carry, stage):
        # Columns: V_x; the gradient in the state under the law without k; that without any law.
        ahead, Vxx, linear, change = carry
        fx, fu, lx, lu, lxx, lux, luu, d = stage
        luu = add_diagonal(luu, d)
        Qxx, Qux, Quu = _quadratic(Vxx, fx, fu, lxx, lux, luu)
        Qv = lu[:, None] + matmul(fu.T, ahead)
        solved, ok = solve_positive(Quu, jnp.concatenate([Qv[:, :1], Qux], axis=1))
        solved = jnp.where(ok, -solved, 0.0)
        k, K = solved[:, 0], solved[:, 1:]
        after = matmul(Quu, k)
        law = jnp.stack([Qv[:, 0] + after, Qv[:, 1], jnp.zeros_like(k)], axis=1)
        step = jnp.stack([k, jnp.zeros_like(k), jnp.zeros_like(k)], axis=1)
        before = lx[:, None] + matmul(fx.T, ahead) + matmul(Qux.T, step) + matmul(K.T, law)
        Vxx = _value(Vxx, Qxx, Qux, K, (fx, fu, lxx, lux, luu))
        linear = linear + jnp.sum(k * Qv[:, 1])
        change = change + jnp.sum(k * (Qv[:, 0] + 0.5 * after))
        finite = jnp.isfinite(jnp.sum(before[:, 0]) + jnp.trace(Vxx))
        out = (k, K, Qv[:, 2], jnp.diagonal(Quu) - d, ok, finite)
        return (before, Vxx, linear, change), out

    zero = jnp.zeros((), model.vx.dtype)
    start = (jnp.stack([model.vx] * 3, axis=1), model.vxx, zero, zero)
    end, out = jax.lax.scan(body, start, (*model[:-2], damping), reverse=True)
    k, K, gradient, curvature, ok, finite = out
    linear, change = end[-2:]
    return Sweep(
        k, K, gradient, curvature, linear, change - linear,
        ok.all(), last_true(~ok), nonfinite(model, finite), jnp.array(True),
    )  # fmt: skip


def nonfinite(model: LocalModel, finite: Bool[Array, " T"]) -> Int[Array, ""]:
    last = jnp.isfinite(model.vx).all() & jnp.isfinite(model.vxx).all()
    return last_true(~jnp.append(finite, last))


def add_diagonal(A: Array, d: Array) -> Array:
    index = jnp.arange(d.size)
    return A + jnp.where(index[:, None] == index, d, 0.0)


def _quadratic(Vxx, fx, fu, lxx, lux, luu) -> tuple[Array, Array, Array]:
    """Return Q_xx, Q_ux and Q_uu."""
    VA, VB = matmul(Vxx, fx), matmul(Vxx, fu)
    return lxx + matmul(fx.T, VA), lux + matmul(fu.T, VA), luu + matmul(fu.T, VB)


def _value(Vxx, Qxx, Qux, K, stage) -> Array:
    """Return the V_xx before a step with gains K."""
    if Vxx.dtype == jnp.float64:
        return symmetrise(Qxx + matmul(K.T, Qux))
    fx, fu, lxx, lux, luu = stage
    F = fx + matmul(fu, K)
    across = matmul(K.T, lux + 0.5 * matmul(luu, K))
    return symmetrise(lxx + 2 * across + matmul(F.T, matmul(Vxx, F)))


class Held(NamedTuple):
    """The minimiser of a damped model with some controls held, and what it took.

    Gains K, zero for held controls; states dxs (T+1, nx) and controls dus; `slope`, the gradient
    there, zero for free controls, and `gradient`, that of the model at zero; `curvature`, the
    diagonal of each Q_uu with its damping. `ok` and `finite` are those of each step.
    """

    dxs: Float[Array, "T+1 nx"]
    dus: Float[Array, "T nu"]
    slope: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    gradient: Float[Array, "T nu"]
    curvature: Float[Array, "T nu"]
    ok: Bool[Array, " T"]
    finite: Bool[Array, " T"]


def held_lqr(
    model: LocalModel,
    free: Bool[Array, "T nu"],
    held: Float[Array, "T nu"],
    damping: Float[Array, "T nu"],
    extra: ArrayLike = 0.0,
) -> Held:
    """Minimise a damped model in its free controls, from dx_0 = 0, by one sweep and a roll-out.

    Arguments:
        model: local expansion.
        free, held: which controls may move, and the values of the others, (T, nu).
        damping: as in `lqr`, (T, nu).
        extra: added to the linear terms of the controls, (T, nu).

    Returns: `Held`. Where a step is not strictly convex in its free controls these stay put.
    """
    extra = jnp.broadcast_to(extra, held.shape)
    identity = jnp.eye(held.shape[1], dtype=held.dtype)

    def back(carry, stage):
        # Columns: V_x, and the costate.
        ahead, Vxx = carry
        fx, fu, lx, lu, lxx, lux, luu, d, free, held, extra = stage
        luu = add_diagonal(luu, d)
        Qxx, Qux, Quu = _quadratic(Vxx, fx, fu, lxx, lux, luu)
        Qv = lu[:, None] + matmul(fu.T, ahead)
        Qu, gradient = Qv[:, 0] + extra, Qv[:, 1]
        kept = jnp.where(free, 0.0, held)
        both = free[:, None] & free[None, :]
        rhs = jnp.concatenate([(Qu + matmul(Quu, kept))[:, None], Qux], axis=1)
        solved, ok = solve_positive(
            jnp.where(both, Quu, identity), jnp.where(free[:, None], rhs, 0.0)
        )
        solved = jnp.where(ok, -solved, 0.0)
        k, K = kept + solved[:, 0], solved[:, 1:]
        before = lx[:, None] + matmul(fx.T, ahead)
        Vx = before[:, 0] + matmul(Qux.T, k) + matmul(K.T, Qu + matmul(Quu, k))
        Vxx = _value(Vxx, Qxx, Qux, K, (fx, fu, lxx, lux, luu))
        finite = jnp.isfinite(jnp.sum(Vx) + jnp.trace(Vxx))
        out = (k, Qu, Qux, Quu, K, gradient, ok, finite)
        return (jnp.stack([Vx, before[:, 1]], axis=1), Vxx), out

    start = (jnp.stack([model.vx] * 2, axis=1), model.vxx)
    stages = (*model[:-2], damping, free, held, extra)
    swept = jax.lax.scan(back, start, stages, reverse=True)[1]
    k, Qu, Qux, Quu, K, gradient, ok, finite = swept

    dxs, dus, slope = _held_forth(model, free, k, K, (Qu, Qux, Quu))
    curvature = jnp.diagonal(Quu, axis1=1, axis2=2)
    return Held(dxs, dus, slope, K, gradient, curvature, ok, finite)


def _held_forth(model: LocalModel, free, k, K, action):
    """Roll the linear model out from 0 under k and K; return states, controls and the slopes of the
    action's model, (Qu, Qux, Quu), in what is held."""

    def forth(dx, stage):
        fx, fu, k, K, Qu, Qux, Quu, free = stage
        du = k + matmul(K, dx)
        slope = jnp.where(free, 0.0, Qu + matmul(Qux, dx) + matmul(Quu, du))
        after = matmul(fx, dx) + matmul(fu, du)
        return after, (after, du, slope)

    origin = jnp.zeros_like(model.vx)
    stages = (model.fx, model.fu, k, K, *action, free)
    _, (dxs, dus, slope) = jax.lax.scan(forth, origin, stages)
    return jnp.concatenate([origin[None], dxs]), dus, slope


class FreeLQR(NamedTuple):
    """A factorised linear-quadratic problem in the free controls; see `factorise`."""

    model: LocalModel
    free: Bool[Array, "T nu"]
    Vxx: Float[Array, "T nx nx"]
    Qux: Float[Array, "T nu nx"]
    Quu: Float[Array, "T nu nu"]
    inverse: Float[Array, "T nu nu"]
    K: Float[Array, "T nu nx"]
    ok: Bool[Array, " T"]
    finite: Bool[Array, " T"]


def factorise(model: LocalModel, free: Bool[Array, "T nu"], damping: ArrayLike = 0.0) -> FreeLQR:
    """Do the part of a sweep that depends on neither linear terms nor held controls.

    Arguments:
        model: local expansion; its linear terms are not used.
        free: which controls may move, shape (T, nu).
        damping: as in `lqr`.

    Returns: `FreeLQR`, for `solve_factorised`; `ok` (T,) tells at which steps the problem is
    strictly convex in the free controls; elsewhere the gains are zero.
    """
    damping = jnp.broadcast_to(damping, model.lu.shape)
    nu = model.lu.shape[1]
    identity = jnp.eye(nu, dtype=model.lu.dtype)

    def body(Vxx, stage):
        fx, fu, lxx, lux, luu, d, free = stage
        luu = add_diagonal(luu, d)
        Qxx, Qux, Quu = _quadratic(Vxx, fx, fu, lxx, lux, luu)
        both = free[:, None] & free[None, :]
        rhs = jnp.where(free[:, None], jnp.concatenate([identity, -Qux], axis=1), 0.0)
        solved, ok = solve_positive(jnp.where(both, Quu, identity), rhs)
        solved = jnp.where(ok, solved, 0.0)
        inverse, K = solved[:, :nu], solved[:, nu:]
        before = _value(Vxx, Qxx, Qux, K, (fx, fu, lxx, lux, luu))
        finite = jnp.isfinite(jnp.trace(before))
        return before, (Vxx, Qux, Quu, inverse, K, ok, finite)

    stages = (model.fx, model.fu, model.lxx, model.lux, model.luu, damping, free)
    return FreeLQR(model, free, *jax.lax.scan(body, model.vxx, stages, reverse=True)[1])


def solve_factorised(
    problem: FreeLQR,
    linear: Float[Array, "T nu"],
    held: Float[Array, "T nu"],
    *,
    lx: Float[Array, "T nx"] | None = None,
    vx: Float[Array, " nx"] | None = None,
    offset: Float[Array, "T nx"] | None = None,
    dx0: Float[Array, " nx"] | None = None,
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Solve a factorised problem for the states dxs (T+1, nx) and the controls dus (T, nu).

    Linear in every argument but the first, and transposable.

    Arguments:
        problem: a factorised problem.
        linear: linear terms of the controls, shape (T, nu).
        held: the values of the controls that are not free, shape (T, nu).
        lx, vx: linear terms of the states, (T, nx), and of the last state, (nx,); zero by default.
        offset, dx0: what is added to the dynamics, (T, nx), and the first state, (nx,); zero by
            default.
    """
    m, p = problem.model, problem
    nx = m.vx.size
    zero = jnp.zeros((), m.vx.dtype)
    held = jnp.where(p.free, 0.0, held)
    given = [zero if a is None else a for a in (lx, vx, offset, dx0)]
    shapes = (m.lx.shape, (nx,), m.lx.shape, (nx,))
    lx, vx, offset, dx0 = (jnp.broadcast_to(a, s) for a, s in zip(given, shapes, strict=True))

    def back(Vx, stage):
        fx, fu, lx, b, c, Vxx, Qux, Quu, inverse, K, free, held = stage
        ahead = Vx + matmul(Vxx, c)
        rhs = b + matmul(fu.T, ahead)
        k = held - matmul(inverse, jnp.where(free, rhs + matmul(Quu, held), 0.0))
        # Refined once: of a stiff chain, what the inverse rounds off is what the transpose misses.
        k = k - matmul(inverse, jnp.where(free, rhs + matmul(Quu, k), 0.0))
        before = lx + matmul(fx.T, ahead) + matmul(Qux.T, k)
        return before + matmul(K.T, rhs + matmul(Quu, k)), k

    stages = (
        m.fx, m.fu, lx, linear, offset, p.Vxx, p.Qux, p.Quu, p.inverse, p.K, p.free, held
    )  # fmt: skip
    k = jax.lax.scan(back, vx, stages, reverse=True)[1]
    return lqr_rollout(m, k, p.K, dx0, offset)


def lqr_rollout(
    model: LocalModel,
    k: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
    dx0: Float[Array, " nx"],
    offset: Float[Array, "T nx"] | None = None,
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Return dxs (T+1, nx) and dus (T, nu) of the law du = k + K dx on the linear model.

    `offset` (T, nx), zero by default, is added to its dynamics.
    """
    offset = jnp.zeros_like(model.lx) if offset is None else offset

    def body(dx, stage):
        fx, fu, k, K, c = stage
        du = k + matmul(K, dx)
        after = matmul(fx, dx) + matmul(fu, du) + c
        return after, (after, du)

    _, (dxs, dus) = jax.lax.scan(body, dx0, (model.fx, model.fu, k, K, offset))
    return jnp.concatenate([dx0[None], dxs]), dus
