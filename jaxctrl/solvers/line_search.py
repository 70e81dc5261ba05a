"""Backtracking along a law: halve the step until the cost falls. It knows trials, no problem."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

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


def search(
    nominal: Trial,
    trial_of: Callable[[Array], tuple[Array, Array, Array]],
    expected_of: Callable[[Array], Array],
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
        nominal: the nominal trajectory, with its cost.
        trial_of: returns the states (T+1, nx), the controls (T, nu) and the cost () at a fraction.
        expected_of: returns by how much the cost should fall there, ().
        round_off: what of a change of the cost is lost in rounding.
        wanted: False skips the search.
        forced: True accepts the first trial, whatever comes out.

    Returns: `Trial`, the nominal trajectory itself when nothing was accepted.
    """

    def attempt(fraction):
        xs, us, cost = trial_of(fraction)
        expected = expected_of(fraction)
        fall = nominal.cost - cost
        enough = (fall >= 0) & (fall >= SUFFICIENT * expected)
        enough |= (expected <= round_off) & (fall >= -round_off)
        finite = jnp.isfinite(cost) & jnp.isfinite(xs).all()
        accepted = jnp.asarray(forced) | (finite & enough & (expected > 0))
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
