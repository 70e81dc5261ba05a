"""A linear-quadratic problem in free controls: factorised once, solved for any linear terms."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._linalg import matmul, solve_positive
from .._types import LocalModel
from ._riccati import Holding, Step, sweep


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
    none = jnp.zeros_like(model.lu)
    rule = Holding(free, none, jnp.broadcast_to(damping, model.lu.shape), none)

    def keep(step: Step):
        _, K, ok = step.law
        Q, finite = step.Q, jnp.isfinite(jnp.trace(step.before.vxx))
        return step.ahead.vxx, Q.ux, Q.uu, K, ok, finite

    Vxx, Qux, Quu, K, ok, finite = sweep(model, rule, keep)[1]
    identity = jnp.eye(model.lu.shape[1], dtype=model.lu.dtype)

    def invert(Quu, free, ok):
        both = free[:, None] & free[None, :]
        rhs = jnp.where(free[:, None], identity, 0.0)
        return jnp.where(ok, solve_positive(jnp.where(both, Quu, identity), rhs)[0], 0.0)

    inverse = jax.vmap(invert)(Quu, free, ok)
    return FreeLQR(model, free, Vxx, Qux, Quu, inverse, K, ok, finite)


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
