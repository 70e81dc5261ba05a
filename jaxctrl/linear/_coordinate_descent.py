"""The best law and the best filter in turn, until neither changes the expected cost.

Each half of a sweep has an exact minimiser: the filter for the law, and the law for the filter.
What comes back is differentiated as the fixed point of a sweep.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import Bounds, LocalModel, Sensing
from ._fixed_point import attach
from ._moments import AffineLaw, carry, expected, starting
from ._observed import Pair, best_gains, best_law, evaluate_observed
from ._observed_step import ObservedValue

ROUND_OFF = 100.0
"""Changes of the cost within so many eps of it count as none."""


class ObservedLQG(NamedTuple):
    """The best law and filter that were visited, and how the expected cost came down.

    `history` holds the expected cost after each half of each sweep, the filter's and the law's, NaN
    for sweeps that were not needed; the model's constant is left out. `converged` tells whether the
    last sweep changed the cost by no more than the tolerance, or round-off, which of a flat valley
    tells little of law and gains; `ok` whether a law could be found at every step.
    """

    law: AffineLaw
    gains: Float[Array, "T nx ny"]
    cost: Float[Array, ""]
    history: Float[Array, "max_steps 2"]
    num_steps: Int[Array, ""]
    converged: Bool[Array, ""]
    ok: Bool[Array, ""]


class Observed(NamedTuple):
    """What coordinate descent minimises the cost of; arrays alone.

    `mean` (nx,) and `cov` (nx, nx) are those of the start, whose estimate is the mean.
    """

    model: LocalModel
    sensing: Sensing
    mean: Float[Array, " nx"]
    cov: Float[Array, "nx nx"]
    damping: Float[Array, "T nu"]
    bounds: Bounds | None

    def cost(self, value: ObservedValue) -> Float[Array, ""]:
        """Return the expected cost over the starts of a value."""
        return value.at(self.mean, self.mean) + 0.5 * jnp.sum(value.vxx * self.cov)


def _new_gains(problem: Observed, pair: Pair, exact: bool):
    """Return the filter's gains for the law of `pair`, and the expected cost."""
    model, sensing, mean, cov, *_ = problem
    start = starting(mean, cov, mean)
    if not exact:
        joints, gains = carry(model, sensing, pair.law, start)
        return gains, expected(model, pair.law, joints)
    joints, _ = carry(model, sensing, pair.law, start, pair.gains)
    value, chosen = best_gains(model, sensing, pair, joints)
    return chosen.gain, problem.cost(value)


def _new_law(problem: Observed, pair: Pair, exact: bool):
    """Return the law for the filter of `pair`, the expected cost, and whether it could be found."""
    model, sensing, mean, cov, damping, bounds = problem
    start = starting(mean, cov, mean)
    joints = carry(model, sensing, pair.law, start, pair.gains)[0] if exact else None
    value, chosen = best_law(model, sensing, pair.gains, damping, bounds, joints)
    return chosen.law, problem.cost(value), chosen.ok.all()


class _Iterate(NamedTuple):
    pair: Pair
    best: Pair
    cost: Float[Array, ""]
    lowest: Float[Array, ""]
    history: Float[Array, "max_steps 2"]
    count: Int[Array, ""]
    change: Float[Array, ""]
    ok: Bool[Array, ""]


def coordinate_descent(
    problem: Observed, law: AffineLaw, tolerance: float, max_steps: int, exact: bool
) -> ObservedLQG:
    """Find filter and law in turn from a first law on, until the cost's relative change is small.

    Arguments:
        problem: what to minimise.
        law: the first one.
        tolerance: relative change of the expected cost in one sweep that is small enough; a
            negative one is never met.
        max_steps: limit of the number of sweeps.
        exact: whether to go on, once that is done, choosing by the moments of state and estimate;
            until then the estimate is taken for the mean of the state given the estimate, which it
            is without noise of the estimator's own.
    """
    fixed = jax.lax.stop_gradient(problem)
    law = jax.lax.stop_gradient(law)
    start = starting(fixed.mean, fixed.cov, fixed.mean)
    joints, gains = carry(fixed.model, fixed.sensing, law, start)
    cost = expected(fixed.model, law, joints)
    end = _descend(fixed, Pair(law, gains), cost, tolerance, max_steps, False)
    if exact:
        end = _descend(fixed, end.best, end.lowest, tolerance, max_steps, True)
    small = ROUND_OFF * float(jnp.finfo(problem.mean.dtype).eps)
    converged = end.change <= max(tolerance, small)
    # As published, the sweeps with noise of the estimator's own have a limit, not a minimum.
    limit = problem.sensing.internal is not None and not exact
    pair = end.pair if limit else end.best
    last = [(a == b).all() for a, b in zip(*map(jax.tree.leaves, (pair, end.pair)), strict=True)]
    law, gains = attach(
        functools.partial(_sweep, exact), problem, pair, converged & jnp.stack(last).all()
    )
    cost = problem.cost(evaluate_observed(problem.model, problem.sensing, law, gains))
    return ObservedLQG(law, gains, cost, end.history, end.count, converged, end.ok)


def _descend(problem: Observed, pair: Pair, cost, tolerance, max_steps, exact: bool) -> _Iterate:
    """Sweep from a pair and its cost on, until the cost's relative change is small."""

    def body(at: _Iterate) -> _Iterate:
        gains, half = _new_gains(problem, at.pair, exact)
        middle = Pair(at.pair.law, gains)
        law, cost, ok = _new_law(problem, middle, exact)
        pair = Pair(law, gains)
        best, lowest = _lower((middle, half), (at.best, at.lowest))
        best, lowest = _lower((pair, cost), (best, lowest))
        history = at.history.at[at.count].set(jnp.stack([half, cost]))
        size = jnp.maximum(jnp.abs(at.cost), jnp.abs(cost))
        change = jnp.abs(at.cost - cost) / jnp.where(size > 0, size, 1.0)
        return _Iterate(pair, best, cost, lowest, history, at.count + 1, change, ok)

    def unfinished(at: _Iterate):
        # A change that is not a number ends it.
        return (at.count < max_steps) & (at.change > tolerance)

    history = jnp.full((max_steps, 2), jnp.nan, cost.dtype)
    far = jnp.full((), jnp.inf, cost.dtype)
    first = _Iterate(pair, pair, cost, cost, history, jnp.array(0), far, jnp.array(True))
    return jax.lax.while_loop(unfinished, body, first)


def _lower(later: tuple[Pair, Array], earlier: tuple[Pair, Array]) -> tuple[Pair, Array]:
    """Return the pair that costs less, the later where it is a matter of round-off, and the less.

    Where the cost is flat to its last digit the law still comes closer to its limit.
    """
    slack = ROUND_OFF * jnp.finfo(later[1].dtype).eps * jnp.abs(earlier[1])
    better = later[1] <= earlier[1] + slack
    pair = jax.tree.map(lambda a, b: jnp.where(better, a, b), later[0], earlier[0])
    return pair, jnp.where(better, jnp.fmin(later[1], earlier[1]), earlier[1])


def _sweep(exact: bool, problem: Observed, pair: Pair) -> Pair:
    gains, _ = _new_gains(problem, pair, exact)
    law, _, _ = _new_law(problem, Pair(pair.law, gains), exact)
    return Pair(law, gains)
