"""Backtracking along a law: roll it out on the true dynamics and halve until the cost falls."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._controller import clip
from .._linalg import matmul
from .._problem import Problem
from .._types import Bounds
from ..linear import Sweep

HALVINGS = 10
"""The smallest fraction tried is 2^-10."""

SUFFICIENT = 1e-4
"""The least ratio of actual to expected reduction (Armijo's constant)."""


class Trial(NamedTuple):
    """A trajectory xs (T+1, nx), us (T, nu) with its cost and the fraction that led to it."""

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    cost: Float[Array, ""]
    fraction: Float[Array, ""]
    accepted: Bool[Array, ""]


def rollout_law(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    k: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
    bounds: Bounds | None,
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Roll out u = clip(u_nominal + k + K (x - x_nominal)) on the true dynamics.

    Returns: states (T+1, nx) and controls (T, nu).
    """

    def body(x, inputs):
        x_nominal, u_nominal, k, K, t, bound = inputs
        u = clip(u_nominal + k + matmul(K, x - x_nominal), bound)
        after = problem.step(x, u, t)
        return after, (after, u)

    inputs = (xs[:-1], us, k, K, problem.ts[:-1], bounds)
    _, (new_xs, new_us) = jax.lax.scan(body, xs[0], inputs)
    return jnp.concatenate([xs[:1], new_xs]), new_us


def search(
    problem: Problem,
    nominal: Trial,
    sweep: Sweep,
    bounds: Bounds | None,
    round_off: Float[Array, ""],
    *,
    wanted: ArrayLike,
    forced: ArrayLike,
) -> Trial:
    """Try the fractions 1, 1/2, ..., 2^-10 until one lowers the cost enough.

    A fraction is accepted when the rolled-out cost is finite, does not rise, and falls by at
    least 1e-4 of what the sweep expects. Where the expectation itself is lost in rounding the
    first fraction is accepted whose cost does not change by more than that: the gradient goes on
    falling where costs can no longer tell. A roll-out that is not finite is rejected like any
    other bad one.

    On a CPU the fractions are tried one after another, elsewhere all at once: there a roll-out
    takes as long as eleven.

    Arguments:
        problem: what is solved.
        nominal: the nominal trajectory, with its cost.
        sweep: the law and its expected change of the cost.
        bounds: (lower, upper), each (T, nu), or None.
        round_off: what of a change of the cost is lost in rounding.
        wanted: False skips the search.
        forced: True accepts the first trial, whatever comes out.

    Returns: `Trial`, the nominal trajectory itself when nothing was accepted.
    """

    def attempt(fraction):
        k = fraction * sweep.k
        xs, us = rollout_law(problem, nominal.xs, nominal.us, k, sweep.K, bounds)
        cost = problem.total_cost(xs, us)
        expected = -(fraction * sweep.linear + fraction**2 * sweep.quadratic)
        fall = nominal.cost - cost
        enough = (fall >= 0) & (fall >= SUFFICIENT * expected)
        enough |= (expected <= round_off) & (fall >= -round_off)
        finite = jnp.isfinite(cost) & jnp.isfinite(xs).all()
        accepted = forced | (finite & enough & (expected > 0))
        return Trial(xs, us, cost, fraction, accepted)

    def one_by_one():
        def searching(carry):
            halvings, trial = carry
            return wanted & ~trial.accepted & (halvings <= HALVINGS)

        def body(carry):
            halvings, _ = carry
            return halvings + 1, attempt(0.5**halvings)

        start = (jnp.zeros((), nominal.cost.dtype), nominal)
        return jax.lax.while_loop(searching, body, start)[1]

    def all_at_once():
        fractions = 0.5 ** jnp.arange(HALVINGS + 1, dtype=nominal.cost.dtype)
        trials = jax.vmap(attempt)(fractions)
        first = jnp.argmax(trials.accepted)
        trial = jax.tree.map(lambda leaf: leaf[first], trials)
        return trial._replace(accepted=trial.accepted & wanted)

    trial = jax.lax.platform_dependent(cpu=one_by_one, default=all_at_once)
    return jax.tree.map(lambda new, old: jnp.where(trial.accepted, new, old), trial, nominal)
