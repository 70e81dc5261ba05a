"""Law and filter of a model whose state is sensed: in each step sense, then act, then move.

With e = dx - xhat the error, F dx what is sensed and s, n the noise of sensor and plant, sums of
columns that depend on dx and du,

    sense   xhat <- xhat + G (F e + s)      e <- (I - G F) e - G s
    act     du = k + K xhat
    move    xhat <- f_x xhat + f_u du       e <- f_x e + n

The filter's gain that makes E[ee'] the least leaves e and xhat uncorrelated, so that two
covariances tell all (Todorov 2005, Neural Comput. 17:1084). With that, the best law for any gains
leaves the cost from a step on in two parts, V(dx) + e'E e/2 (Li 2006, section 5.4): before it
moves the step costs

    Q = l + V(f_x dx + f_u du) + sum_i n_i'(V_xx + E) n_i/2,        E <- f_x'E f_x + K'Q_uu K,

and before it senses, s_j'G'E G s_j/2 more for each column, E <- (I - G F)'E (I - G F). So the law
is that of a model whose state is known, in which noise costs V_xx + E for V_xx, and what is sensed
costs something, too: `price` makes it.

Law and filter are found in turn; each is the best for the other, so that the expected cost falls.
Li's filter predicts: its reading corrects the next estimate, as if it came one step late; with a
sensor that is one step late the two are the same.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._linalg import matmul, solve_semidefinite, symmetrise
from .._types import LocalModel, Sensing
from ._covariance import spread
from ._fixed_point import attach
from ._moments import AffineLaw
from ._riccati import Holding, Rule
from ._step import Packed, Value, action, disturbed, pack, value

MOST = 3
"""Limit of the sweeps of law and filter in turn; a solver goes on in its next iteration."""
WHOLE = 200
"""The same where derivatives need them to have settled."""


class Errors(NamedTuple):
    """What errors of the estimate cost: E after the reading of each step, and before the next."""

    after: Float[Array, "T nx nx"]
    ahead: Float[Array, "T nx nx"]


class Forecast(NamedTuple):
    """What the best filter for a law makes of a model, from the start on.

    Attributes:
        gains: the filter's, (T, nx, ny).
        error: covariances of the errors before each reading, (T+1, nx, nx).
        x_cov, u_cov: those of states and controls, (T+1, nx, nx) and (T, nu, nu).
        innovation: those of what is sensed less what was expected, (T, ny, ny).
        cost: the expected cost, the model's constant left out, ().
    """

    gains: Float[Array, "T nx ny"]
    error: Float[Array, "T+1 nx nx"]
    x_cov: Float[Array, "T+1 nx nx"]
    u_cov: Float[Array, "T nu nu"]
    innovation: Float[Array, "T ny ny"]
    cost: Float[Array, ""]


class SensedLQG(NamedTuple):
    """Law and filter that are the best for each other, and how the expected cost came down.

    Attributes:
        law: du = k + K xhat.
        gains: the filter's, (T, nx, ny).
        errors: what errors of the estimate cost under both.
        history: the expected cost after each half of each sweep, the filter's and the law's, NaN
            for sweeps that were not needed; the model's constant is left out.
    """

    law: AffineLaw
    gains: Float[Array, "T nx ny"]
    errors: Errors
    history: Float[Array, "max_steps 2"]


class _Given(NamedTuple):
    """What coordinate descent works on; arrays alone. `side` is 0 for what is free."""

    model: LocalModel
    damping: Float[Array, "T nu"]
    side: Float[Array, "T nu"]
    values: Float[Array, "T nu"]

    @property
    def rule(self) -> Holding:
        return Holding(self.side == 0, self.values, self.damping, jnp.zeros_like(self.values))


def _packed(model: LocalModel) -> tuple[Any, Sensing]:
    """Return stages and sensing, their noise packed."""
    sensing, nx = model.sensing, model.vx.size
    assert sensing is not None
    stages = model.stages
    if model.noise is not None:
        stages = stages._replace(noise=pack(model.noise, model.fu.shape[1:]))
    if sensing.noise is None:
        return stages, sensing
    return stages, sensing._replace(noise=pack(sensing.noise, (nx, 0)))


def _second_moments(noise: Packed | None, mean, error, estimate, K, size: int) -> Array:
    """Return sum_i E[(c_i + cx_i dx + cu_i du)(...)'] of a step, for independent e and xhat.

    `mean` is that of (dx, du), and du - E du = K (xhat - E xhat); K None where no control counts.
    """
    if noise is None:
        return jnp.zeros((size, size), mean.dtype)
    slopes, nx = noise.slopes, error.shape[0]
    if slopes is None or noise.c is None:
        return 2 * noise.square
    moved = jnp.sum(slopes * mean, axis=2)
    if noise.rows is None:
        level = noise.c + moved
    else:
        S = noise.rows.onehot(noise.c.shape[1], mean.dtype)
        level = noise.c + jnp.sum(moved[:, :, None] * S, axis=1)
    Ce = slopes[..., :nx]
    if K is None:
        return matmul(level.T, level) + spread(noise.rows, Ce, error + estimate, size)
    Ch = Ce + slopes[..., nx:] @ K
    square = matmul(level.T, level)
    return square + spread(noise.rows, Ce, error, size) + spread(noise.rows, Ch, estimate, size)


def forecast(model: LocalModel, law: AffineLaw) -> Forecast:
    """Return the filter that makes errors the least under a law, and the moments under both.

    Arguments:
        model: with what is sensed, and the covariance of the first state.
        law: du = k + K xhat, k (T, nu) and K (T, nu, nx).
    """
    cov = model.x0_cov
    assert cov is not None

    def forth(carry, inputs):
        error, estimate, mean = carry
        stage, sense, (k, K) = inputs
        told = _second_moments(sense.noise, mean, error, estimate, None, sense.F.shape[0])
        FE = matmul(sense.F, error)
        innovation = symmetrise(matmul(FE, sense.F.T) + told)
        gain = solve_semidefinite(innovation, FE).T
        learnt = symmetrise(matmul(gain, matmul(innovation, gain.T)))
        known, hat = error - learnt, estimate + learnt
        u, F = k + matmul(K, mean), stage.fx + matmul(stage.fu, K)
        z = jnp.concatenate([mean, u])
        noise = _second_moments(stage.noise, z, known, hat, K, mean.size)
        ux = matmul(K, hat)
        uu, xx = symmetrise(matmul(ux, K.T)), symmetrise(error + estimate)
        cost = _expected(stage, mean, u, xx, ux, uu, noise)
        after = (
            symmetrise(matmul(matmul(stage.fx, known), stage.fx.T) + noise),
            symmetrise(matmul(matmul(F, hat), F.T)),
            matmul(F, mean) + matmul(stage.fu, k),
        )
        return after, (gain, error, xx, uu, innovation, cost)

    start = (cov, jnp.zeros_like(cov), jnp.zeros_like(model.vx))
    stages, sensing = _packed(model)
    end, kept = jax.lax.scan(forth, start, (stages, sensing, law))
    gains, error, x_cov, u_cov, innovation, costs = kept
    last, x = end[0], end[0] + end[1]
    cost = jnp.sum(costs) + _expected_end(model, end[2], x)
    error, x_cov = (jnp.concatenate([a, b[None]]) for a, b in ((error, last), (x_cov, x)))
    return Forecast(gains, error, x_cov, u_cov, innovation, cost)


def _expected(stage, x, u, xx, ux, uu, noise) -> Array:
    """Return a step's expected cost, from means and covariances of state and control."""
    linear = jnp.sum(stage.lx * x) + jnp.sum(stage.lu * u)
    xx, ux, uu = xx + x[:, None] * x, ux + u[:, None] * x, uu + u[:, None] * u
    square = jnp.sum(stage.lxx * xx) + 2 * jnp.sum(stage.lux * ux) + jnp.sum(stage.luu * uu)
    if stage.noise is not None and stage.noise.weight is not None:
        square = square + jnp.sum(stage.noise.weight * noise)
    return linear + 0.5 * square


def _expected_end(model: LocalModel, x, xx) -> Array:
    return jnp.sum(model.vx * x) + 0.5 * jnp.sum(model.vxx * (xx + x[:, None] * x))


def respond(
    model: LocalModel, gains: Float[Array, "T nx ny"], rule: Rule
) -> tuple[AffineLaw, Errors, Float[Array, ""]]:
    """Return the best law for a filter's gains, what errors cost, and the expected cost.

    Arguments: the model with what is sensed, the gains (T, nx, ny), and the rule of the law.
    """
    cov = model.x0_cov
    assert cov is not None

    def back(carry, inputs):
        ahead, E = carry
        stage, sense, gain, rule = inputs
        stage = _weighed(rule.price(stage), E)
        Q, added = action(ahead, stage)
        k, K, _ = rule.choose(Q)
        before = value(ahead, stage, Q, added, k, K, best=rule.best)
        known = matmul(stage.fx.T, matmul(E, stage.fx)) + matmul(K.T, matmul(Q.uu, K))
        known = symmetrise(known)
        if sense.noise is not None:
            told = _told(sense.noise, gain, known)
            before = Value(before.v + told.q, before.vx + told.x, before.vxx + told.xx)
        EG = matmul(known, gain)
        across = matmul(sense.F.T, EG.T - 0.5 * matmul(matmul(gain.T, EG), sense.F))
        unknown = known - across - across.T
        return (before, unknown), (k, K, known, E)

    end = Value(jnp.zeros((), model.vx.dtype), model.vx, model.vxx)
    stages, sensing = _packed(model)
    start = (end, jnp.zeros_like(model.vxx))
    (first, E), kept = jax.lax.scan(back, start, (stages, sensing, gains, rule), reverse=True)
    k, K, after, ahead = kept
    cost = first.v + 0.5 * jnp.sum((first.vxx + E) * cov)
    return AffineLaw(k, K), Errors(after, ahead), cost


def _weighed(stage, E):
    """Return the stage, its noise costing E more, beside what V_xx after it makes of it."""
    noise = stage.noise
    if noise is None:
        return stage
    weight = E if noise.weight is None else noise.weight + E
    return stage._replace(noise=noise._replace(weight=weight))


def _told(noise: Any, gain, E):
    """Return what the noise of a reading costs, in the state, where errors cost E after it."""
    return disturbed(noise, matmul(gain.T, matmul(E, gain)), (E.shape[0], 0))


def price(model: LocalModel, gains: Float[Array, "T nx ny"], errors: Errors) -> LocalModel:
    """Return a model whose state is known with the best law for a filter's gains, and its value.

    Arguments: the model with what is sensed, the gains, and what errors cost under that law.
    """
    _, sensing = _packed(model)
    priced = _weighed(model, errors.ahead)._replace(sensing=None, x0_cov=None)
    if sensing.noise is None:
        return priced
    told = jax.vmap(_told)(sensing.noise, gains, errors.after)
    return priced._replace(lx=model.lx + told.x, lxx=model.lxx + told.xx)


def _turn(given: _Given, K: Array) -> Array:
    """Return the best gains (T, nu, nx) for the best filter for gains K that move no mean."""
    law = AffineLaw(jnp.zeros_like(given.damping), K)
    return respond(given.model, forecast(given.model, law).gains, given.rule)[0].K


def settle(model: LocalModel, side: Float[Array, "T nu"]) -> LocalModel:
    """Return the `price`d model at an optimum, where the mean does not move.

    Differentiable, as the fixed point of a sweep; NaN where the sweeps do not come to one.

    Arguments: the model with what is sensed; and what is held, where not 0, (T, nu).
    """
    none = jnp.zeros_like(side)
    given = _Given(model, none, side, none)
    fixed = jax.lax.stop_gradient(given)
    eps = float(jnp.finfo(model.vx.dtype).eps)

    def body(carry):
        K, _, count = carry
        after = _turn(fixed, K)
        return after, _change(K, after), count + 1

    def unfinished(carry):
        _, change, count = carry
        return (change > eps**0.7) & (count < WHOLE)

    start = (jnp.zeros_like(fixed.model.lux), jnp.full((), jnp.inf, side.dtype), jnp.array(0))
    K, change, _ = jax.lax.while_loop(unfinished, body, start)
    K = attach(_turn, given, K, change <= eps**0.6)
    gains = forecast(model, AffineLaw(none, K)).gains
    return price(model, gains, respond(model, gains, given.rule)[1])


def descend(
    model: LocalModel,
    law: AffineLaw,
    damping: Float[Array, "T nu"],
    side: Float[Array, "T nu"],
    values: Float[Array, "T nu"],
    max_steps: int = MOST,
    tolerance: float | None = None,
) -> SensedLQG:
    """Find law and filter in turn, from a first law on.

    What is held (`side` not 0) has the given `values` and no gains.

    Arguments:
        model: with what is sensed, and the covariance of the first state.
        law: the first one.
        damping, side, values: each (T, nu).
        max_steps: limit of the sweeps.
        tolerance: relative change of the law in one sweep that is small enough; by default near
            what rounding leaves.
    """
    rule = _Given(model, damping, side, values).rule
    eps = float(jnp.finfo(model.vx.dtype).eps)
    tolerance = eps**0.7 if tolerance is None else tolerance

    def body(carry):
        law, history, count, _ = carry
        seen = forecast(model, law)
        after, _, cost = respond(model, seen.gains, rule)
        history = history.at[count].set(jnp.stack([seen.cost, cost]))
        change = jnp.maximum(_change(law.k, after.k), _change(law.K, after.K))
        return after, history, count + 1, change

    def unfinished(carry):
        _, _, count, change = carry
        return (count < max_steps) & (change > tolerance)  # one that is not a number ends it

    history = jnp.full((max_steps, 2), jnp.nan, model.vx.dtype)
    far = jnp.full((), jnp.inf, model.vx.dtype)
    law, history, *_ = jax.lax.while_loop(unfinished, body, (law, history, jnp.array(0), far))
    gains = forecast(model, law).gains
    return SensedLQG(law, gains, respond(model, gains, rule)[1], history)


def _change(before: Array, after: Array) -> Array:
    """Return how much an array has changed, relative to the larger."""
    size = jnp.maximum(jnp.sum(before**2), jnp.sum(after**2))
    return jnp.sqrt(jnp.sum((after - before) ** 2) / jnp.where(size > 0, size, 1.0))
