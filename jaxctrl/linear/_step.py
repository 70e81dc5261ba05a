"""One step of every sweep backwards through a local model.

With V(dx) = v + v_x'dx + dx'V_xx dx/2 ahead of a step, and the noise's columns
c_i + cx_i dx + cu_i du, the cost of the step and of what follows it is, with V_xx + W for V_xx in
the sums over i where noise costs something within its step,

  Q    = v + sum_i c_i'V_xx c_i/2
  Q_x  = l_x + f_x'v_x + sum_i cx_i'V_xx c_i    Q_xx = l_xx + f_x'V_xx f_x + sum_i cx_i'V_xx cx_i
  Q_u  = l_u + f_u'v_x + sum_i cu_i'V_xx c_i    Q_ux = l_ux + f_u'V_xx f_x + sum_i cu_i'V_xx cx_i
                                                  Q_uu = l_uu + f_u'V_xx f_u + sum_i cu_i'V_xx cu_i

and under a law du = k + K dx, whichever,

    v    <- Q + k'(Q_u + Q_uu k/2)
    v_x  <- Q_x + Q_ux'k + K'(Q_u + Q_uu k)
    V_xx <- l_xx + l_ux'K + K'l_ux + K'l_uu K + F'V_xx F + sum_i C_i'V_xx C_i

with F = f_x + f_u K, C_i = cx_i + cu_i K (Joseph's form, which subtracts no large numbers). Under
the best law, where Q_ux + Q_uu K = 0 in what is moved, V_xx <- Q_xx + K'Q_ux is the same; it takes
a third less time, and is as exact in float64; in float32 it would lose V_xx to round-off. (Q_xx +
K'Q_ux + Q_ux'K + K'Q_uu K, which holds for any law too, lost 15 times as much of a chain's gains.)

Li (2006), eq. 4.12-4.18 (Theorem 1) is the special case l_xx = Q, l_uu = R, l_x = Q x, l_u = R u
under the best law, k = -Q_uu^-1 Q_u, K = -Q_uu^-1 Q_ux.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import matmul, symmetrise
from .._types import Noise, Rows, Stages


class Value(NamedTuple):
    """The cost from a state on, V(dx) = v + vx'dx + dx'vxx dx/2."""

    v: Float[Array, ""]
    vx: Float[Array, " nx"]
    vxx: Float[Array, "nx nx"]


class Action(NamedTuple):
    """The cost of a step and of what follows it, Q(dx, du), by its derivatives at zero."""

    q: Float[Array, ""]
    x: Float[Array, " nx"]
    u: Float[Array, " nu"]
    xx: Float[Array, "nx nx"]
    ux: Float[Array, "nu nx"]
    uu: Float[Array, "nu nu"]


def action(ahead: Value, stage: Stages) -> tuple[Action, Action | None]:
    """Return Q of one step (the module's equations), for the value after it, and the noise's part.

    Arguments: the value ahead, and the step's slice of the model's stages, its noise packed.
    """
    x, u = pull(stage, ahead.vx)
    VA, VB = matmul(ahead.vxx, stage.fx), matmul(ahead.vxx, stage.fu)
    Q = Action(
        ahead.v,
        x,
        u,
        stage.lxx + matmul(stage.fx.T, VA),
        stage.lux + matmul(stage.fu.T, VA),
        stage.luu + matmul(stage.fu.T, VB),
    )
    if stage.noise is None:
        return Q, None
    added = disturbed(stage.noise, ahead.vxx, stage.fu.shape)
    return Action(*(a + b for a, b in zip(Q, added, strict=True))), added


def pull(stage: Stages, vx: Float[Array, " nx *m"]) -> tuple[Array, Array]:
    """Return l_x + f_x'v_x (nx, *m) and l_u + f_u'v_x (nu, *m), of one v_x or of m columns."""
    lx, lu = (stage.lx, stage.lu) if vx.ndim == 1 else (stage.lx[:, None], stage.lu[:, None])
    return lx + matmul(stage.fx.T, vx), lu + matmul(stage.fu.T, vx)


def value(
    ahead: Value,
    stage: Stages,
    Q: Action,
    added: Action | None,
    k: Array,
    K: Array,
    *,
    best: bool = False,
) -> Value:
    """Return the value before a step under the law du = k + K dx (the module's equations).

    Arguments:
        ahead, stage, Q, added: the value ahead, the step's stage and its `action`.
        k, K: any law, (nu,) and (nu, nx).
        best: whether the law minimises Q in what it moves.
    """
    after = matmul(Q.uu, k)
    v = Q.q + jnp.sum(k * (Q.u + 0.5 * after))
    vx = Q.x + matmul(Q.ux.T, k) + matmul(K.T, Q.u + after)
    if best and ahead.vxx.dtype == jnp.float64:
        return Value(v, vx, symmetrise(Q.xx + matmul(K.T, Q.ux)))
    F = stage.fx + matmul(stage.fu, K)
    across = matmul(K.T, stage.lux + 0.5 * matmul(stage.luu, K))
    vxx = stage.lxx + 2 * across + matmul(F.T, matmul(ahead.vxx, F))
    if added is not None:
        vxx = vxx + added.xx + 2 * matmul(K.T, added.ux + 0.5 * matmul(added.uu, K))
    return Value(v, vx, symmetrise(vxx))


def columns(noise: Noise, nx: int, nu: int) -> tuple[Array, Array, Array]:
    """Return c (nw, nx), cx (nw, nx, nx) and cu (nw, nx, nu) of one step, zero where None."""
    c, cx, cu, rows, _ = noise
    if rows is not None:
        S = rows.onehot(nx, c.dtype)
        cx, cu = (None if a is None else jnp.matmul(S.mT, a) for a in (cx, cu))
    cx = jnp.zeros((*c.shape, nx), c.dtype) if cx is None else cx
    return c, cx, jnp.zeros((*c.shape, nu), c.dtype) if cu is None else cu


class Packed(NamedTuple):
    """A noise as a sweep weighs it; of one step, or of all, leading with time.

    Attributes:
        square: sum_i c_i c_i' / 2, (nx, nx).
        c: the columns, (nw, nx); None where none has a slope.
        slopes: those of each column in z = (x, u), in r of its rows, (nw, r, nx + nu); or None.
        rows: which rows these are; None for all.
        weight: what the noise costs within its step, (nx, nx), beside V_xx; or None.
    """

    square: Float[Array, "*T nx nx"]
    c: Float[Array, "*T nw nx"] | None
    slopes: Float[Array, "*T nw r nz"] | None
    rows: Rows | None
    weight: Float[Array, "*T nx nx"] | None


def pack(noise: Noise, shape: tuple[int, ...]) -> Packed:
    """Return a noise of one step, or of all, for `disturbed`.

    Arguments: the noise, and the numbers of states and controls, (nx, nu).
    """
    c, cx, cu, rows, weight = noise
    # Column by column: XLA hands one sum over all steps to a library, and a loop with a call to
    # one does not become one function.
    columns = [c[..., i, :, None] * c[..., i, None, :] for i in range(c.shape[-2])]
    square = 0.5 * sum(columns, jnp.zeros((*c.shape[:-2], c.shape[-1], c.shape[-1]), c.dtype))
    if cx is None and cu is None:
        return Packed(square, None, None, None, weight)
    lead = (cx if cu is None else cu).shape[:-1]  # pyright: ignore[reportOptionalMemberAccess]
    both = [
        jnp.zeros((*lead, n), c.dtype) if own is None else own
        for own, n in zip((cx, cu), shape, strict=True)
    ]
    return Packed(square, c, jnp.concatenate(both, axis=-1), rows, weight)


def disturbed(noise: Packed, vxx: Float[Array, "nx nx"], shape: tuple[int, ...]) -> Action:
    """Return what the noise of one step adds to Q: all its second moments, weighed by V_xx.

    Arguments: the step's packed noise, V_xx (nx, nx), and the numbers of states and controls.
    """
    nx, nu = shape
    vxx = vxx if noise.weight is None else vxx + noise.weight
    q, J = jnp.sum(noise.square * vxx), noise.slopes
    if J is None or noise.c is None:
        sizes = ((nx,), (nu,), (nx, nx), (nu, nx), (nu, nu))
        return Action(q, *(jnp.zeros(size, vxx.dtype) for size in sizes))
    if noise.rows is None:
        V, Vc = vxx, matmul(noise.c, vxx)
    else:
        # Products with ones and zeros: XLA would make loops of gathers.
        S = noise.rows.onehot(vxx.shape[0], vxx.dtype)
        rows = jnp.sum(S[..., None] * vxx, axis=2)
        V = jnp.sum(rows[:, :, None, :] * S[:, None], axis=3)
        Vc = jnp.sum(rows * noise.c[:, None], axis=2)
    VJ = jnp.sum(V[..., None] * J[:, None], axis=2)
    zz = matmul(J.reshape(-1, J.shape[2]).T, VJ.reshape(-1, J.shape[2]))
    z = jnp.sum(J * Vc[..., None], axis=(0, 1))
    return Action(q, z[:nx], z[nx:], zz[:nx, :nx], zz[nx:, :nx], zz[nx:, nx:])
