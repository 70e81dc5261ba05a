"""Backtracking along a law: roll it out on the true dynamics and halve until the cost falls."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._controller import clip
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
    sweep: Sweep,
    fraction: ArrayLike,
    bounds: Bounds | None,
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Roll out u = clip(u_nominal + fraction k + K (x - x_nominal)) on the true dynamics.

    Returns: states (T+1, nx) and controls (T, nu).
    """

    def body(x, inputs):
        x_nominal, u_nominal, k, K, t, bound = inputs
        u = clip(u_nominal + fraction * k + K @ (x - x_nominal), bound)
        after = problem.step(x, u, t)
        return after, (after, u)

    inputs = (xs[:-1], us, sweep.k, sweep.K, problem.ts[:-1], bounds)
    _, (new_xs, new_us) = jax.lax.scan(body, xs[0], inputs)
    return jnp.concatenate([xs[:1], new_xs]), new_us


def backtrack(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    cost: Float[Array, ""],
    sweep: Sweep,
    bounds: Bounds | None,
    round_off: Float[Array, ""],
    wanted: Bool[Array, ""],
) -> Trial:
    """Try the fractions 1, 1/2, ..., 2^-10 until one lowers the cost enough.

    A fraction is accepted when the rolled-out cost is finite, does not rise, and falls by at
    least 1e-4 of what the sweep expects; that ratio is not asked for when the expectation itself
    is lost in rounding. A roll-out that is not finite is rejected like any other bad one.

    Arguments:
        problem, xs (T+1, nx), us (T, nu), cost: the nominal trajectory.
        sweep: the law and its expected change of the cost.
        bounds: (lower, upper), each (T, nu), or None.
        round_off: what of a change of the cost is lost in rounding.
        wanted: False skips the search.

    Returns: `Trial`, the nominal trajectory itself when nothing was accepted.
    """

    def body(carry):
        halvings, _ = carry
        fraction = 0.5**halvings
        new_xs, new_us = rollout_law(problem, xs, us, sweep, fraction, bounds)
        new_cost = problem.total_cost(new_xs, new_us)
        expected = -(fraction * sweep.linear + fraction**2 * sweep.quadratic)
        fall = cost - new_cost
        enough = (fall >= SUFFICIENT * expected) | (expected <= round_off)
        finite = jnp.isfinite(new_cost) & jnp.isfinite(new_xs).all()
        accepted = finite & (fall >= 0) & (expected > 0) & enough
        return halvings + 1, Trial(new_xs, new_us, new_cost, fraction, accepted)

    def searching(carry):
        halvings, trial = carry
        return wanted & ~trial.accepted & (halvings <= HALVINGS)

    zero = jnp.zeros((), cost.dtype)
    nominal = Trial(xs, us, cost, zero, jnp.array(False))
    _, trial = jax.lax.while_loop(searching, body, (zero, nominal))
    return jax.tree.map(lambda new, old: jnp.where(trial.accepted, new, old), trial, nominal)
