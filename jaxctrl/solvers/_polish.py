"""How a stochastic solver gets on where no step lowers the expected cost any more.

The model leaves out parts of the expected cost's gradient, so that near its own fixed point the two
disagree. There whole steps are taken as long as each lowers the gradient of the model.
"""

from typing import NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._types import LocalModel
from ..linear import Sweep

NEAR = 1.0
"""The projected gradient above which no polishing begins."""
FALLING = 0.99
"""The largest ratio of two gradients in a row that counts as a fall."""


class Pair(NamedTuple):
    """A trajectory with gains, which controls these hold at bounds, its cost and its gradient."""

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    side: Float[Array, "T nu"]
    cost: Float[Array, ""]
    gradient: Float[Array, ""]


class Polish(NamedTuple):
    """How a stochastic solver gets on.

    Attributes:
        going: whether the next step is taken whatever it costs.
        spent: whether that was tried in vain since a step last lowered the cost.
        best: the best pair met so far.
        nominal: what the start costs without noise; NaN before it was measured.
    """

    going: Bool[Array, ""]
    spent: Bool[Array, ""]
    best: Pair
    nominal: Float[Array, ""]


def begin(xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"]) -> Polish:
    """Return the state before any step: no pair is worse than that of xs (T+1, nx), us (T, nu)."""
    K = jnp.zeros((*us.shape, xs.shape[1]), us.dtype)
    worst = jnp.full((), jnp.inf, us.dtype)
    none = jnp.array(False)
    pair = Pair(xs, us, K, jnp.full_like(us, jnp.nan), worst, worst)
    return Polish(none, none, pair, jnp.full((), jnp.nan, us.dtype))


def proceeds(
    polish: Polish | None, vain: Bool[Array, ""], gradient: Float[Array, ""]
) -> Bool[Array, ""]:
    """Tell whether to go on polishing, or to begin with it after a search in vain; shape ()."""
    if polish is None:
        return jnp.array(False)
    return polish.going | (vain & ~polish.spent & (gradient <= NEAR))


def failed(polish: Polish, before: Float[Array, ""], after: Float[Array, ""]) -> Bool[Array, ""]:
    """Tell whether a step of polishing did not lower the gradient, shape ()."""
    return polish.going & ~(after < FALLING * before)


def advance(
    polish: Polish,
    proceeding: Bool[Array, ""],
    vain: Bool[Array, ""],
    lowered: Bool[Array, ""],
    pair: Pair,
    usable: Bool[Array, ""],
) -> Polish:
    """Return the state after a step.

    Arguments:
        proceeding, vain: whether polishing proceeds, and whether its last step failed.
        lowered: whether a search lowered the cost.
        pair, usable: where the step has led, and whether that pair counts.
    """
    better = usable & (pair.cost < polish.best.cost)
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), pair, polish.best)
    spent = (polish.spent | vain) & ~lowered
    return Polish(proceeding & ~vain, spent, best, polish.nominal)


def swamped(polish: Polish, model: LocalModel, sweep: Sweep, cost: Array) -> Bool[Array, ""]:
    """Tell whether noise adds 1/eps times what the start costs without it, or overflows.

    Arguments: the last model and its sweep, and the expected cost ().
    """
    without = model._replace(noise=None)
    sound = jnp.isfinite(jax.flatten_util.ravel_pytree(without)[0]).all()
    tame = cost * jnp.finfo(cost.dtype).eps <= jnp.abs(polish.nominal)
    return sound & jnp.where(sweep.ok, ~tame & (polish.nominal != 0), sweep.nonfinite >= 0)
