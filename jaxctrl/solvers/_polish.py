"""How a stochastic solver gets on where no step lowers the expected cost any more.

The model leaves out parts of the expected cost's gradient, so that near its own fixed point the two
disagree. There steps are taken as long as each lowers the gradient of the model: whole ones, and
where these lead from one side of the fixed point to the other, parts of them.
"""

from typing import NamedTuple

import jax
import jax.flatten_util
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .. import _status
from .._status import Reason, Status, first_nonfinite
from .._types import LocalModel
from ..linear import Sweep

NEAR = 1.0
"""The projected gradient above which no polishing begins."""
FALLING = 0.99
"""The largest ratio of two gradients in a row that counts as a fall."""
LEAST = 0.125
"""The smallest part of a step that is tried."""
GAIN = 1e-6
"""By how much of itself the least cost must fall for another attempt: less, and steps that lower
the cost and steps that lower the gradient may follow one another for ever, around a kink."""
IDLE = 12
"""How many steps may follow an attempt in vain without the least cost falling so."""


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
        spent: whether that was tried in vain since a step last lowered the least cost.
        best: the best pair met so far.
        nominal: what the start costs without noise; NaN before it was measured.
        part: which part of the next step is taken.
        idle: how many steps have followed an attempt in vain without a lower cost.
    """

    going: Bool[Array, ""]
    spent: Bool[Array, ""]
    best: Pair
    nominal: Float[Array, ""]
    part: Float[Array, ""]
    idle: Int[Array, ""]


def begin(xs: Float[Array, "T+1 nx"], us: Float[Array, "T nu"]) -> Polish:
    """Return the state before any step: no pair is worse than that of xs (T+1, nx), us (T, nu)."""
    K = jnp.zeros((*us.shape, xs.shape[1]), us.dtype)
    worst = jnp.full((), jnp.inf, us.dtype)
    none = jnp.array(False)
    pair = Pair(xs, us, K, jnp.full_like(us, jnp.nan), worst, worst)
    unknown = jnp.full((), jnp.nan, us.dtype)
    return Polish(none, none, pair, unknown, jnp.ones((), us.dtype), jnp.array(0))


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
    ended = vain & (polish.part <= LEAST)
    least = polish.best.cost
    fell = lowered & (pair.cost < least - GAIN * jnp.abs(least))
    spent = (polish.spent | ended) & ~fell
    going = proceeding & ~ended
    part = jnp.where(going, jnp.where(vain, 0.5 * polish.part, polish.part), 1.0)
    idle = jnp.where(spent, polish.idle + 1, 0)
    return Polish(going, spent, best, polish.nominal, part, idle)


def noise_status(
    polish: Polish, model: LocalModel, sweep: Sweep, cost: Array, status: Status
) -> Status:
    """Return a status that blames the noise, where that is at fault, or else the one given.

    It is too large where it adds 1/eps times what the start costs without it, or overflows.

    Arguments: the last model and its sweep, the expected cost (), and the status.
    """
    without = model._replace(noise=None, sensing=None, x0_cov=None)
    sound = jnp.isfinite(jax.flatten_util.ravel_pytree(without)[0]).all()
    tame = cost * jnp.finfo(cost.dtype).eps <= jnp.abs(polish.nominal)
    swamped = sound & jnp.where(sweep.ok, ~tame & (polish.nominal != 0), sweep.nonfinite >= 0)
    status = _status.where(swamped, Status.of(Reason.NOISE_TOO_LARGE), status)
    for at in map(first_nonfinite, jax.tree.leaves((model.noise, model.sensing))):
        status = _status.where(sound & (at >= 0), Status.of(Reason.NONFINITE_NOISE, at), status)
    return status
