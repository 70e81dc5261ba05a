"""Riccati sweeps over a local model: one loop, `sweep`, and the rules that choose each step's law.

Damping d >= 0 adds sum_ki d_ki du_ki^2 / 2 to the model (Levenberg and Marquardt).
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._linalg import matmul, solve_positive
from .._types import LocalModel, Stages
from ._step import Action, Value, action, pack, pull, value


def symmetric(model: LocalModel) -> LocalModel:
    """Return the model with symmetric blocks, which costs the same: x'Ax = x'A'x."""
    lxx, luu, vxx = (0.5 * (A + A.mT) for A in (model.lxx, model.luu, model.vxx))
    return model._replace(lxx=lxx, luu=luu, vxx=vxx)


class Law(NamedTuple):
    """A step's law du = k + K dx, and whether it could be chosen as its rule wants."""

    k: Float[Array, " nu"]
    K: Float[Array, "nu nx"]
    ok: Bool[Array, ""]


class Rule(Protocol):
    """How each step's law is chosen: arrays that lead with time, and what to do with a slice."""

    @property
    def best(self) -> bool:
        """Whether the law minimises Q in the controls that it moves."""
        ...

    def price(self, stage: Stages) -> Stages:
        """Return the stage with what the rule adds to its cost."""
        ...

    def choose(self, Q: Action) -> Law:
        """Return the law for a step's Q."""
        ...


class Free(NamedTuple):
    """The minimiser of the model damped by d (T, nu): k = -Q_uu^-1 Q_u, K = -Q_uu^-1 Q_ux."""

    damping: Float[Array, "T nu"]

    @property
    def best(self) -> bool:
        """True."""
        return True

    def price(self, stage: Stages) -> Stages:
        """Return the stage with d added to the diagonal of l_uu."""
        return stage._replace(luu=add_diagonal(stage.luu, self.damping))

    def choose(self, Q: Action) -> Law:
        """Return the minimiser; zero where Q_uu is not positive definite."""
        solved, ok = solve_positive(Q.uu, jnp.concatenate([Q.u[:, None], Q.ux], axis=1))
        solved = jnp.where(ok, -solved, 0.0)
        return Law(solved[:, 0], solved[:, 1:], ok)


class Holding(NamedTuple):
    """The same, with `values` for the controls that are not `free`, whose gains are zero.

    `extra` is added to the linear terms of the controls; each array is (T, nu).
    """

    free: Bool[Array, "T nu"]
    values: Float[Array, "T nu"]
    damping: Float[Array, "T nu"]
    extra: Float[Array, "T nu"]

    @property
    def best(self) -> bool:
        """True."""
        return True

    def price(self, stage: Stages) -> Stages:
        """Return the stage with d on the diagonal of l_uu and the extra linear terms."""
        luu = add_diagonal(stage.luu, self.damping)
        return stage._replace(luu=luu, lu=stage.lu + self.extra)

    def choose(self, Q: Action) -> Law:
        """Return the minimiser in the free controls, which stay put where it is none."""
        free, identity = self.free, jnp.eye(Q.u.size, dtype=Q.u.dtype)
        held = jnp.where(free, 0.0, self.values)
        both = free[:, None] & free[None, :]
        rhs = jnp.concatenate([(Q.u + matmul(Q.uu, held))[:, None], Q.ux], axis=1)
        solved, ok = solve_positive(
            jnp.where(both, Q.uu, identity), jnp.where(free[:, None], rhs, 0.0)
        )
        solved = jnp.where(ok, -solved, 0.0)
        return Law(held + solved[:, 0], solved[:, 1:], ok)


class Given(NamedTuple):
    """A law k (T, nu), K (T, nu, nx) that is only to be evaluated."""

    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]

    @property
    def best(self) -> bool:
        """False."""
        return False

    def price(self, stage: Stages) -> Stages:
        """Return the stage itself."""
        return stage

    def choose(self, Q: Action) -> Law:
        """Return the law as it is."""
        return Law(self.k, self.K, jnp.array(True))


class Step(NamedTuple):
    """What a sweep knows at one step: the value ahead and before, Q, the law, and two gradients.

    `gradient` is that of the total cost in the controls with no law beyond, plus that of what the
    noise costs under the gains; `steady` the same with the mean, too, under the gains beyond;
    neither has the rule's own prices.
    """

    ahead: Value
    before: Value
    Q: Action
    law: Law
    gradient: Float[Array, " nu"]
    steady: Float[Array, " nu"]


def sweep(model: LocalModel, rule: Rule, keep: Callable[[Step], Any]) -> tuple[Value, Any]:
    """Go backwards through a local model, each step's law chosen by a rule.

    Arguments:
        model: local expansion, with or without noise.
        rule: `Free`, `Holding` or `Given`.
        keep: what to return of each step.

    Returns: the value at the first state, and what was kept, leading with time.
    """

    def body(carry, inputs):
        ahead, aside = carry
        plain, rule = inputs
        stage = rule.price(plain)
        Q, added = action(ahead, stage)
        law = rule.choose(Q)
        before = value(ahead, stage, Q, added, law.k, law.K, best=rule.best)
        # Columns: the costate, and the slope in the state under the gains alone.
        x, u = pull(plain, aside)
        if added is not None:
            x, u = x + added.x[:, None], u + added.u[:, None]
        steady_x, steady_u = x[:, 1], u[:, 1]
        aside = jnp.stack([x[:, 0], steady_x + matmul(law.K.T, steady_u)], axis=1)
        return (before, aside), keep(Step(ahead, before, Q, law, u[:, 0], steady_u))

    end = Value(jnp.zeros((), model.vx.dtype), model.vx, model.vxx)
    start = (end, jnp.stack([model.vx] * 2, axis=1))
    stages = model.stages
    if model.noise is not None:
        stages = stages._replace(noise=pack(model.noise, model.fu.shape[1:]))
    (first, _), kept = jax.lax.scan(body, start, (stages, rule), reverse=True)
    return first, kept


def _finite(step: Step) -> Bool[Array, ""]:
    return jnp.isfinite(jnp.sum(step.before.vx) + jnp.trace(step.before.vxx))


class Sweep(NamedTuple):
    """A law du = k + K dx, and what it promises.

    A step of length a along it changes the damped model's cost by a `linear` + a^2 `quadratic`.
    `gradient` is that of the total cost in the controls, under noise of the expected cost as the
    model has it, weighed by the damped law's value; `curvature` the diagonal of each Q_uu less the
    step's own damping. `ok` tells whether every Q_uu was positive definite; where it was not,
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
    """Sweep the Riccati recursion backwards through a local model.

    Arguments:
        model: local expansion; every array but the last two leads with time.
        damping: d >= 0, scalar or (T, nu) [cost per control unit squared].

    Returns: `Sweep`.
    """
    damping = jnp.broadcast_to(damping, model.lu.shape)
    return swept(model, Free(damping), damping)


def swept(model: LocalModel, rule: Rule, damping: Float[Array, "T nu"]) -> Sweep:
    """Return the sweep of a rule whose price is damping (T, nu)."""

    def keep(step: Step):
        linear = jnp.sum(step.law.k * step.steady)
        # What noise costs, whatever the controls.
        constant = 0.0 if model.noise is None else step.Q.q - step.ahead.v
        return *step.law, step.gradient, jnp.diagonal(step.Q.uu), linear, constant, _finite(step)

    first, kept = sweep(model, rule, keep)
    k, K, ok, gradient, curvature, linear, constant, finite = kept
    linear = jnp.sum(linear)
    change = first.v if model.noise is None else first.v - jnp.sum(constant)
    return Sweep(
        k, K, gradient, curvature - damping, linear, change - linear,
        ok.all(), last_true(~ok), nonfinite(model, finite), jnp.array(True),
    )  # fmt: skip


def evaluate(model: LocalModel, k: Float[Array, "T nu"], K: Float[Array, "T nu nx"]) -> Value:
    """Return the expected cost of a given law du = k + K dx on a model, whatever the law.

    E J(dx) = v + vx'dx + dx'vxx dx/2 for a start dx, noise included.

    Arguments: the model, and the law's k (T, nu) and K (T, nu, nx).

    Returns: `Value`: v (), vx (nx,), vxx (nx, nx).
    """
    return sweep(model, Given(k, K), lambda step: ())[0]


def nonfinite(model: LocalModel, finite: Bool[Array, " T"]) -> Int[Array, ""]:
    last = jnp.isfinite(model.vx).all() & jnp.isfinite(model.vxx).all()
    return last_true(~jnp.append(finite, last))


def add_diagonal(A: Array, d: Array) -> Array:
    index = jnp.arange(d.size)
    return A + jnp.where(index[:, None] == index, d, 0.0)


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
    rule = Holding(free, held, damping, jnp.broadcast_to(extra, held.shape))

    def keep(step: Step):
        return *step.law, step.Q.u, step.Q.ux, step.Q.uu, step.gradient, _finite(step)

    k, K, ok, Qu, Qux, Quu, gradient, finite = sweep(model, rule, keep)[1]
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
