"""Sweeps backwards through a model that is only sensed: one loop, and what it chooses at each step.

The sweep that evaluates a law, the one that finds the best law for a filter, and the one that finds
the best filter for a law, are the same loop; they differ in what is chosen before the value of
`_observed_step` goes one step back.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._linalg import matmul, positive_part, solve_positive, symmetrise
from .._types import Bounds, LocalModel, Sensing, Stages
from ._boxqp import box_qp
from ._moments import AffineLaw, Joint, second, sensed_noise
from ._observed_step import ObservedAction, ObservedValue, observed_action, observed_value
from ._riccati import add_diagonal


class Pair(NamedTuple):
    """A law and the filter's gains."""

    law: AffineLaw
    gains: Float[Array, "T nx ny"]


class Chosen(NamedTuple):
    """A step's law and gain, and whether the law could be chosen as wanted."""

    law: AffineLaw
    gain: Float[Array, "nx ny"]
    ok: Bool[Array, ""]


Choice = Callable[[ObservedValue, Stages, Sensing, Pair, tuple], Chosen]


def sweep_observed(
    model: LocalModel, sensing: Sensing, pair: Pair, choose: Choice, extra: tuple = ()
) -> tuple[ObservedValue, Chosen]:
    """Go backwards through a sensed model.

    Arguments:
        model, sensing: local expansions of the plant with its cost, and of the sensor.
        pair: law and gains.
        choose: what becomes of the law and the gain of each step, given what is ahead.
        extra: handed to `choose`, sliced; every array leads with time.

    Returns: the value at the start, and what was chosen, leading with time.
    """

    def back(ahead, inputs):
        stage, sense, pair, extra = inputs
        chosen = choose(ahead, stage, sense, pair, extra)
        Q = observed_action(ahead, stage, sense, chosen.gain)
        return observed_value(Q, *chosen.law), chosen

    zero, none = jnp.zeros_like(model.vx), jnp.zeros_like(model.vxx)
    end = ObservedValue(jnp.zeros((), zero.dtype), model.vx, zero, model.vxx, none, none)
    return jax.lax.scan(back, end, (model.stages, sensing, pair, extra), reverse=True)


def evaluate_observed(
    model: LocalModel, sensing: Sensing, law: AffineLaw, gains: Float[Array, "T nx ny"]
) -> ObservedValue:
    """Return the expected cost of any affine law and any filter, by the state and the estimate.

        v(dx, xhat) = v + vx'dx + vh'xhat + dx'vxx dx/2 + xhat'vhh xhat/2 + dx'vxh xhat

    Li (2006), eq. 5.16-5.26, corrected: where the text has 2 vxh, vxh + vxh' stands.

    Arguments:
        model: local expansion of plant and cost.
        sensing: local expansion of the sensor, and the estimator's own noise.
        law: du = k + K xhat, k (T, nu) and K (T, nu, nx).
        gains: those of the filter, (T, nx, ny).

    Returns: `ObservedValue` at the start; `.at(dx, xhat)` is the expected cost from there.

    Raises: ValueError for shapes that do not fit together, naming the argument.
    """

    def keep(ahead, stage, sense, pair, extra):
        return Chosen(pair.law, pair.gains, jnp.array(True))

    return sweep_observed(model, sensing, Pair(law, gains), keep)[0]


def best_law(
    model: LocalModel,
    sensing: Sensing,
    gains: Float[Array, "T nx ny"],
    damping: Float[Array, "T nu"],
    bounds: Bounds | None = None,
    joints: Joint | None = None,
) -> tuple[ObservedValue, Chosen]:
    """Find the best law for a filter's gains, by a sweep backwards.

    Arguments:
        damping: (T, nu), added to the diagonal of H to choose the law, not to evaluate it.
        bounds: of k, each (T, nu).
        joints: moments at T+1 times that say what an estimate tells of the state; None where the
            mean of the state given the estimate is the estimate.

    Returns: the value at the start, and what was chosen.
    """
    past = None if joints is None else jax.tree.map(lambda a: a[:-1], joints)

    def choose(ahead, stage, sense, pair, extra):
        damping, bounds, joint = extra
        Q = observed_action(ahead, stage, sense, pair.gains)
        law, ok = _minimise(Q, damping, bounds, joint)
        return Chosen(law, pair.gains, ok)

    still = AffineLaw(jnp.zeros_like(model.lu), jnp.zeros_like(model.lux))
    return sweep_observed(model, sensing, Pair(still, gains), choose, (damping, bounds, past))


def _minimise(Q: ObservedAction, damping: Array, bounds: Bounds | None, joint: Joint | None):
    """Return the law (k, K) that minimises a step's cost, and whether it could be found.

    With dx = W xhat + w the best linear guess, k = -H^-1 (g + Gx w) and K = -H^-1 (Gx W + Gh) in
    what is free, the bounds being those of k; controls at bounds have no gains (Todorov & Li 2005,
    but for the choice of the free set, which there is what is left by clipping).
    """
    g, G = Q.g, Q.Gx + Q.Gh
    if joint is not None:
        W, w = _predictor(joint)
        g, G = g + Q.Gx @ w, Q.Gx @ W + Q.Gh
    _, convex = solve_positive(Q.H, Q.H)
    H = jax.lax.cond(convex, lambda H: H, positive_part, Q.H)
    H = add_diagonal(H, damping)
    if bounds is None:
        solved, ok = solve_positive(H, jnp.concatenate([g[:, None], G], axis=1))
        solved = jnp.where(ok, -solved, 0.0)
        return AffineLaw(solved[:, 0], solved[:, 1:]), ok
    found = box_qp(H, g, *bounds)
    free = found.free
    within = jnp.where(free[:, None] & free, H, jnp.eye(g.size, dtype=g.dtype))
    K, ok = solve_positive(within, jnp.where(free[:, None], -G, 0.0))
    ok = ok & found.positive & found.finished
    still = jnp.clip(jnp.zeros_like(g), *bounds)
    return AffineLaw(jnp.where(ok, found.x, still), jnp.where(ok, K, 0.0)), ok


def _predictor(joint: Joint) -> tuple[Array, Array]:
    """Return W (nx, nx) and w (nx,) of the best linear guess of a state, W xhat + w."""
    nx = joint.mean.shape[0] // 2
    error, estimate = joint.cov[:nx, :nx], joint.cov[nx:, nx:]
    slope = _shrunk(estimate, joint.cov[nx:, :nx], error).T
    w = joint.mean[:nx] - matmul(slope, joint.mean[nx:])
    return jnp.eye(nx, dtype=slope.dtype) + slope, w


def best_gains(
    model: LocalModel, sensing: Sensing, pair: Pair, joints: Joint
) -> tuple[ObservedValue, Chosen]:
    """Find the gains that make a law's expected cost the least, by a sweep backwards.

    Of each step, given those before it, whose moments `joints` are, and those after it. For a law
    that is the best for its filter, and without noise of the estimator's own, the gains that make
    the error the least do so too. What does not change the cost stays as it is in `pair`.
    """
    past = jax.tree.map(lambda a: a[:-1], joints)

    def choose(ahead, stage, sense, pair, extra):
        return Chosen(pair.law, _cost_gain(ahead, stage, sense, pair, extra[0]), jnp.array(True))

    return sweep_observed(model, sensing, pair, choose, (past,))


def _cost_gain(
    ahead: ObservedValue, stage: Stages, sense: Sensing, pair: Pair, joint: Joint
) -> Float[Array, "nx ny"]:
    """Return the gain for which E v(dx', xhat') is least: with the innovation n = F e + s,

    0 = V_hh (E[a n'] + G E[nn']) + V_xh' E[dx' n'] + v_h E[n]',  a = f_x xhat + f_u du.
    """
    (k, K), gain = pair
    A, B, F = stage.fx, stage.fu, sense.F
    nx = A.shape[0]
    e, xhat = joint.mean[:nx], joint.mean[nx:]
    error = second(joint.cov[:nx, :nx], e)
    across = joint.cov[nx:, :nx] + xhat[:, None] * e
    told = (A + B @ K) @ across + (B @ k)[:, None] * e
    innovation = symmetrise(F @ error @ F.T + sensed_noise(joint, sense, pair.law))
    slope = (ahead.vhh @ told + ahead.vxh.T @ (told + A @ error) + ahead.vh[:, None] * e) @ F.T
    slope = slope + ahead.vhh @ gain @ innovation
    change = _shrunk(ahead.vhh, slope, ahead.vxx)
    return gain - _shrunk(innovation, change.T, innovation).T


def _shrunk(A: Array, B: Array, size: Array) -> Array:
    """Return (A + eps^0.6 D)^-1 B, D the diagonal of A + size, of symmetric A >= 0 and size >= 0.

    Too small a step, if anything, where A says little, so that a cost that falls without it still
    falls. Zero in rows where both have nothing.
    """
    diagonal = jnp.diagonal(A) + jnp.diagonal(size)
    some = diagonal > 0
    unit = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, diagonal, 1.0)), 0.0)
    ridge = jnp.where(some, jnp.finfo(A.dtype).eps ** 0.6, 1.0)
    X, _ = solve_positive(add_diagonal(unit[:, None] * A * unit, ridge), unit[:, None] * B)
    return unit[:, None] * X
