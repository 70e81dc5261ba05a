"""The Riccati sweep in parallel over time, in a depth of operations that grows as log T.

Sweeping a piece of the horizon, from x at its first step to the costate p at its last, gives

    J, A, C:    V(x, p) = x'J x/2 + p'A x - p'C p/2,    the cost of x when p'y is paid at the end y,

quadratic terms alone. Two pieces, the first with index 1, make one:

    A = A_2 E A_1,   C = A_2 E C_1 A_2' + C_2,   J = A_1'J_2 E A_1 + J_1,   E = (I + C_1 J_2)^-1,

which is associative (Sarkka & Garcia-Fernandez 2023), so that a scan over the steps from the last
state on, where A = C = 0 and J = v_xx, gives each V_xx as a J. A step by itself has, with
R = l_uu + damping,

    A = f_x - f_u R^-1 l_ux,   C = f_u R^-1 f_u',   J = l_xx - l_ux'R^-1 l_ux.

These subtract what may be large, R^-1 need not exist, and A and C of a long unstable piece exceed
every number. So each piece pays a small value x'S x/2 at its end and gets it back at its start,
which is exact for any S, and the gains of this scan are only a first guess. Their law is evaluated,
and improved, as by Newton and Kleinman (1968),

    F = f_x + f_u K,   V_xx <- l_xx + K'l_ux + l_ux'K + K'l_uu K + F'V_xx F,   K <- -Q_uu^-1 Q_ux,

the evaluation being a scan too, of maps of V_xx, without any solving. That squares the error of K
(one round suffices in float64), loses nothing to subtraction, and proves itself: when the law
changes no more and every Q_uu is positive definite, it is the one of the sequential sweep. What
is linear, V_x, the costates and the roll-out, follows from scans of affine maps.

Where the proof fails the sequential sweep takes over: where the problem is not strictly convex or
not finite, and where float32 is too coarse. The results, and what failed at which step, are
therefore the same.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._linalg import matmul, solve_positive, symmetrise
from .._types import LocalModel
from . import _riccati
from ._riccati import Held, Sweep, add_diagonal

MAX_ROUNDS = 4
BLOCK = 8
"""Steps that a scan takes one after another; in parallel over the blocks of this length."""
SMALL = 6
"""Up to this size products of a batch are written out; above it the library's are faster."""


class _Stages(NamedTuple):
    """A model's quadratic terms in the free controls, with the damping in l_uu."""

    fx: Float[Array, "T nx nx"]
    fu: Float[Array, "T nx nu"]
    lxx: Float[Array, "T nx nx"]
    lux: Float[Array, "T nu nx"]
    luu: Float[Array, "T nu nu"]


class _Round(NamedTuple):
    """Gains, the V_xx that led to them, and whether they are the optimum's; the rounds so far."""

    K: Float[Array, "T nu nx"]
    Vxx: Float[Array, "T+1 nx nx"]
    certain: Bool[Array, ""]
    count: Int[Array, ""]


class _Law(NamedTuple):
    """A law du = k + K dx, its closed loop F, and Q_u, Q_ux and Q_uu, held controls' too."""

    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    F: Float[Array, "T nx nx"]
    Qu: Float[Array, "T nu"]
    Qux: Float[Array, "T nu nx"]
    Quu: Float[Array, "T nu nu"]
    certain: Bool[Array, ""]


def costates(model: LocalModel) -> tuple[Float[Array, "T nx"], Float[Array, "T nu"]]:
    """Return the costates p_1 ... p_T (T, nx) and the gradient (T, nu), as `_riccati.costates`."""
    p = _affine_back(model.fx, model.lx, model.vx)[1:]
    return p, model.lu + jax.vmap(lambda fu, p: _product(fu.T, p))(model.fu, p)


def lqr(model: LocalModel, damping: ArrayLike = 0.0) -> Sweep:
    """Sweep a local model in parallel over time; arguments and result as of `_riccati.lqr`.

    Not differentiable in reverse mode.
    """
    if model.noise is not None:
        return _riccati.lqr(model, damping)  # noise couples the pieces: no scan of theirs holds it
    damping = jnp.broadcast_to(damping, model.lu.shape)
    every, none = jnp.ones(model.lu.shape, bool), jnp.zeros_like(model.lu)
    law = _law(model, every, none, damping, none)
    linear = jnp.sum(law.k * law.Qu)
    square = 0.5 * jnp.sum(law.k * jax.vmap(_product)(law.Quu, law.k))
    curvature = jnp.diagonal(law.Quu, axis1=1, axis2=2) - damping
    nowhere = jnp.array(-1, jnp.int32)
    sweep = Sweep(
        law.k, law.K, costates(model)[1], curvature, linear, square,
        law.certain, nowhere, nowhere, jnp.array(True),
    )  # fmt: skip
    return _unless(law.certain, sweep, lambda: _riccati.lqr(model, damping))


def held_lqr(
    model: LocalModel,
    free: Bool[Array, "T nu"],
    held: Float[Array, "T nu"],
    damping: Float[Array, "T nu"],
    extra: ArrayLike = 0.0,
) -> Held:
    """Minimise a damped model in its free controls, in parallel over time.

    Arguments and result as of `_riccati.held_lqr`. Not differentiable in reverse mode.
    """
    if model.noise is not None:
        return _riccati.held_lqr(model, free, held, damping, extra)
    extra = jnp.broadcast_to(extra, held.shape)
    law = _law(model, free, jnp.where(free, 0.0, held), damping, extra)
    dxs = _affine_forth(law.F, jax.vmap(_product)(model.fu, law.k))
    dus = law.k + jax.vmap(_product)(law.K, dxs[:-1])
    slope = law.Qu + jax.vmap(_product)(law.Qux, dxs[:-1]) + jax.vmap(_product)(law.Quu, dus)
    curvature = jnp.diagonal(law.Quu, axis1=1, axis2=2)
    every = jnp.ones(len(held), bool)
    step = Held(
        dxs, dus, jnp.where(free, 0.0, slope), law.K, costates(model)[1], curvature, every, every
    )
    certain = law.certain & jnp.isfinite(dxs).all()
    return _unless(certain, step, lambda: _riccati.held_lqr(model, free, held, damping, extra))


def _unless(certain: Bool[Array, ""], found, sequential):
    """Return what was found, or what the sequential sweep finds if that is not certain.

    A loop of at most one round, because in a batch a condition would run both sides always.
    """
    start = (certain, found)
    return jax.lax.while_loop(lambda c: ~c[0], lambda _: (jnp.array(True), sequential()), start)[1]


def _stages(model: LocalModel, free: Array, damping: Array) -> _Stages:
    """Take held controls out: their rows and columns are zero, of l_uu the identity's."""

    def masked(fu, lux, luu, free, d):
        identity = jnp.eye(d.size, dtype=d.dtype)
        both = free[:, None] & free[None, :]
        luu = jnp.where(both, add_diagonal(luu, d), identity)
        return jnp.where(free, fu, 0.0), jnp.where(free[:, None], lux, 0.0), luu

    fu, lux, luu = jax.vmap(masked)(model.fu, model.lux, model.luu, free, damping)
    return _Stages(model.fx, fu, model.lxx, lux, luu)


def _solve(stages: _Stages, vxx: Array) -> _Round:
    """Find the gains, and V_xx at all times, by the scan of pieces and rounds of Newton's."""
    first = _first(stages, vxx)
    K, positive, _ = _improve(stages, first)
    K = jnp.where(positive[:, None, None], K, 0.0)
    start = _Round(K, first, jnp.array(False), jnp.array(0))

    def uncertain(last: _Round):
        return ~last.certain & (last.count < MAX_ROUNDS)

    def body(last: _Round):
        Vxx = _evaluate(stages, last.K, vxx)
        K, positive, gain = _improve(stages, Vxx)
        # The cost that this round saves at one step, of each state by itself, so that units do
        # not matter: its size is the square of the change of K, which is the error before it.
        change = K - last.K
        saved = jnp.sum(change * jax.vmap(_product)(gain, change), axis=1)
        scale = jnp.sum(K * jax.vmap(_product)(gain, K), axis=1)
        scale += jnp.abs(jnp.diagonal(Vxx[:-1], axis1=1, axis2=2))
        small = (saved <= jnp.finfo(K.dtype).eps ** 0.75 * scale).all()
        finite = jnp.isfinite(Vxx).all() & jnp.isfinite(K).all()
        return _Round(K, Vxx, small & positive.all() & finite, last.count + 1)

    return jax.lax.while_loop(uncertain, body, start)


def _first(stages: _Stages, vxx: Array) -> Float[Array, "T+1 nx nx"]:
    """Return V_xx at all times by the scan of pieces, as well as these allow."""
    nx = len(vxx)
    identity = jnp.eye(nx, dtype=vxx.dtype)
    # Small, so that V_xx - S is V_xx to half the digits even where V_xx is tiny.
    price = jnp.diagonal(jnp.abs(vxx)) + jnp.max(jnp.diagonal(stages.lxx, axis1=1, axis2=2), axis=0)
    S = jnp.sqrt(jnp.finfo(vxx.dtype).eps) * jnp.maximum(price, 0.0) * identity

    def piece(fx, fu, lxx, lux, luu):
        Sx = _product(S, fx)
        lux, luu = lux + _product(fu.T, Sx), luu + _product(fu.T, _product(S, fu))
        lxx = lxx + _product(fx.T, Sx) - S
        # R may be indefinite: pieces need not be convex for the whole to be.
        solved = jnp.linalg.solve(luu, jnp.concatenate([lux, fu.T], axis=1))
        of_x, of_p = solved[:, :nx], solved[:, nx:]
        C, J = symmetrise(_product(fu, of_p)), symmetrise(lxx - _product(lux.T, of_x))
        return fx - _product(fu, of_x), C, J

    def combine(later, earlier):
        (A2, C2, J2), (A1, C1, J1) = later, earlier
        both = jnp.concatenate([A1, C1], axis=1)
        both = jnp.linalg.solve(identity + _product(C1, J2), both)
        EA, EC = both[:, :nx], both[:, nx:]
        C = C2 + symmetrise(_product(A2, _product(EC, A2.T)))
        return _product(A2, EA), C, J1 + symmetrise(_product(A1.T, _product(J2, EA)))

    zero = jnp.zeros_like(vxx)
    pieces = _appended(jax.vmap(piece)(*stages), (zero, zero, vxx - S))
    return S + _scan(combine, pieces, reverse=True)[2]


def _evaluate(stages: _Stages, K: Array, vxx: Array) -> Float[Array, "T+1 nx nx"]:
    """Return the V_xx of a law at all times: a scan of maps V -> Q + F'V F."""

    def closed(fx, fu, lxx, lux, luu, K):
        across = symmetrise(_product(K.T, lux + 0.5 * _product(luu, K)))
        return fx + _product(fu, K), lxx + 2 * across

    def combine(later, earlier):
        (F2, Q2), (F1, Q1) = later, earlier
        return _product(F2, F1), Q1 + symmetrise(_product(F1.T, _product(Q2, F1)))

    maps = _appended(jax.vmap(closed)(*stages, K), (jnp.zeros_like(vxx), vxx))
    return _scan(combine, maps, reverse=True)[1]


def _improve(stages: _Stages, Vxx: Array) -> tuple[Array, Array, Array]:
    """Return each step's best gains for the V_xx after it, whether they are, and Q_uu."""

    def improve(Vxx, fx, fu, lxx, lux, luu):
        Qux, Quu = _control_terms(Vxx, fx, fu, lux, luu)
        solved, positive = solve_positive(Quu, Qux)
        return -solved, positive, Quu

    return jax.vmap(improve)(Vxx[1:], *stages)


def _control_terms(Vxx, fx, fu, lux, luu) -> tuple[Array, Array]:
    """Return Q_ux and Q_uu."""
    VB = _product(Vxx, fu)
    return lux + _product(VB.T, fx), luu + _product(fu.T, VB)


def _law(model: LocalModel, free: Array, kept: Array, damping: Array, extra: Array) -> _Law:
    """Return the law of the least cost, with the values `kept` of what is not free, zero elsewhere.

    Where the free rows of Q_ux + Q_uu K vanish, V_x is that of the law kept + K dx.
    """
    riccati = _solve(_stages(model, free, damping), model.vxx)
    identity = jnp.eye(model.lu.shape[1], dtype=model.lu.dtype)

    def before(Vxx, K, fx, fu, lx, lu, lxx, lux, luu, d, kept):
        luu = add_diagonal(luu, d)
        Qux, Quu = _control_terms(Vxx, fx, fu, lux, luu)
        F = fx + _product(fu, K)
        slope = lx + _product(lux.T, kept) + _product(K.T, lu + _product(luu, kept))
        return F, slope + _product(F.T, _product(Vxx, _product(fu, kept))), Qux, Quu

    def after(Vx, fu, lu, Quu, free, kept):
        Qu = lu + _product(fu.T, Vx)
        both = free[:, None] & free[None, :]
        rest = jnp.where(free, Qu + _product(Quu, kept), 0.0)
        solved, _ = solve_positive(jnp.where(both, Quu, identity), rest[:, None])
        return kept - solved[:, 0], Qu

    model = model._replace(lu=model.lu + extra)
    stages = (riccati.Vxx[1:], riccati.K, *model.stages[:-1], damping, kept)
    F, slope, Qux, Quu = jax.vmap(before)(*stages)
    Vx = _affine_back(F, slope, model.vx)
    k, Qu = jax.vmap(after)(Vx[1:], model.fu, model.lu, Quu, free, kept)
    certain = riccati.certain & jnp.isfinite(Vx).all()
    return _Law(k, riccati.K, F, Qu, Qux, Quu, certain)


def _scan(combine: Callable, elements, *, reverse: bool):
    """Combine each element with all those before it, or, in reverse, with all after it.

    `combine(done, next)` is associative. Each block is scanned by itself, then the blocks' ends
    are, in log2 of their number of rounds, then both are combined: 3 combinations for each element,
    about as many in depth as `jax.lax.associative_scan` takes, which has each of its levels
    compiled by itself: for 1000 steps 20 bodies instead of 3, and 10 times the time.
    """
    n = jax.tree.leaves(elements)[0].shape[0]
    count = -(-n // BLOCK)
    index = jnp.arange(count)
    combine = jax.vmap(combine)

    def split(a):
        a = jnp.flip(a, 0) if reverse else a
        a = jnp.pad(a, [(0, count * BLOCK - n)] + [(0, 0)] * (a.ndim - 1))
        return jnp.swapaxes(a.reshape(count, BLOCK, *a.shape[1:]), 0, 1)

    def join(a):
        a = jnp.swapaxes(a, 0, 1).reshape(count * BLOCK, *a.shape[2:])[:n]
        return jnp.flip(a, 0) if reverse else a

    def after(distance, earlier, here):
        """Combine each block with the one so far before it, where there is one."""
        earlier = jax.tree.map(lambda a: jnp.roll(a, distance, axis=0), earlier)
        there = index >= distance
        return jax.tree.map(
            lambda new, old: jnp.where(there.reshape(-1, *[1] * (old.ndim - 1)), new, old),
            combine(earlier, here),
            here,
        )

    def within(done, following):
        done = combine(done, following)
        return done, done

    blocks = jax.tree.map(split, elements)
    first = jax.tree.map(lambda a: a[0], blocks)
    ends, rest = jax.lax.scan(within, first, jax.tree.map(lambda a: a[1:], blocks))
    inside = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)
    rounds = (count - 1).bit_length()
    ends = jax.lax.fori_loop(
        0, rounds, lambda i, ends: after(jnp.left_shift(1, i), ends, ends), ends
    )
    return jax.tree.map(join, jax.vmap(lambda here: after(1, ends, here))(inside))


def _product(A: Array, B: Array) -> Array:
    """Return A @ B within a batch, as exactly as the dtype can."""
    small = max(*A.shape, *B.shape) <= SMALL
    return matmul(A, B) if small else jnp.matmul(A, B, precision="highest")


def _appended(steps, last):
    """Append the last state's element to those of the steps."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), steps, last)


def _affine_back(F: Array, c: Array, last: Array) -> Float[Array, "T+1 nx"]:
    """Return p_0 ... p_T of p_k = c_k + F_k'p_{k+1}, p_T = last."""

    def combine(later, earlier):
        (F2, c2), (F1, c1) = later, earlier
        return _product(F2, F1), c1 + _product(F1.T, c2)

    zero = jnp.zeros((last.size, last.size), last.dtype)
    maps = _appended((F, c), (zero, last))
    return _scan(combine, maps, reverse=True)[1]


def _affine_forth(F: Array, c: Array) -> Float[Array, "T+1 nx"]:
    """Return x_0 ... x_T of x_{k+1} = F_k x_k + c_k, x_0 = 0."""

    def combine(earlier, later):
        (F1, c1), (F2, c2) = earlier, later
        return _product(F2, F1), c2 + _product(F2, c1)

    xs = _scan(combine, (F, c), reverse=False)[1]
    return jnp.concatenate([jnp.zeros_like(xs[:1]), xs])
