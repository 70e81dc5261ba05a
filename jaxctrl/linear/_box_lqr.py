"""A linear-quadratic problem with bounds on the controls, solved exactly by whole sweeps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import LocalModel
from ._engine import Engine, find_engine
from ._interior_point import Box, InteriorPoint, advance, barrier, begin, held, select
from ._riccati import Held, Sweep, last_true, nonfinite
from ._stagewise import stagewise_lqr


class _Iterate(NamedTuple):
    """The last sweep, the sides that it held and those to be held next, and an interior point.

    `inner` are the sides that the interior point is at, NaN where it has not ended.
    """

    last: Held
    side: Float[Array, "T nu"]
    following: Float[Array, "T nu"]
    inner: Float[Array, "T nu"]
    settled: Bool[Array, ""]
    count: Int[Array, ""]
    interior: InteriorPoint


def box_lqr(
    model: LocalModel,
    lower: Float[Array, "T nu"],
    upper: Float[Array, "T nu"],
    damping: ArrayLike = 0.0,
    *,
    side: Float[Array, "T nu"] | None = None,
    max_sweeps: int = 12,
    engine: str = "sequential",
) -> tuple[Sweep, Float[Array, "T nu"]]:
    """Minimise a local model's cost with all controls du in a box.

    Hold a set of controls at their bounds, solve for the others by a Riccati sweep, then hold what
    left the box and release what the multipliers push inwards, until nothing changes (the
    primal-dual active set; Hintermueller, Ito & Kunisch 2002). The result is the exact minimiser.
    Choosing each step's k in the box by itself (Tassa, Mansard & Todorov 2014) is not: there the
    feedback K dx leaves the box, which costs iterations when bounds bind hard.

    Under noise it is the mean of du that is kept in the box. What is held has no gains, on which
    the value's curvature and so the price of noise depend: a set that reproduces itself need not
    exist. Where none is found each step's k is chosen in the box by itself after all: a law whose
    mean may leave the box, and no exact minimiser.

    The sets may cycle. After `max_sweeps`, an interior-point method, whose steps are sweeps too,
    gives them a new start, or, without noise, should they cycle again, the result.

    Arguments:
        model: local expansion; every array but the last two leads with time.
        lower, upper: bounds on du, shape (T, nu), lower <= 0 <= upper.
        damping: as in `lqr`.
        side: first guess of the held set, shape (T, nu): -1 at the lower bound, 1 at the upper,
            0 free, NaN where what the gradient pushes against a bound is to be the guess, which is
            the default everywhere.
        max_sweeps: limit of the iteration over sets.
        engine: how to sweep, as in `lqr`.

    Returns: `Sweep`, whose law keeps du in the box on the model and whose gains are zero for held
    controls, and the held set, as `side`. Where the sets cycled, the controls are the interior
    point's, and the gains and the set are those of the bounds that it is at; where neither method
    ended, `settled` is False and `side` NaN.
    """
    sweeps = find_engine(engine)
    lower, upper = jnp.asarray(lower), jnp.asarray(upper)
    box = Box(model, jnp.broadcast_to(damping, lower.shape), lower, upper)
    given = jnp.full_like(lower, jnp.nan) if side is None else side
    unknown = jnp.isnan(given)
    first = jax.lax.cond(
        unknown.any(), lambda: jnp.where(unknown, _pushed(box, sweeps), given), lambda: given
    )
    first = jnp.where(box.movable | (first != 0), first, -1.0)
    sweep, side = _law(box, _search(box, sweeps, first, max_sweeps))
    if model.noise is None:
        return sweep, side
    return jax.lax.cond(
        sweep.settled | ~sweep.ok,
        lambda: (sweep, side),
        lambda: stagewise_lqr(model, box.lower, box.upper, box.damping),
    )


def _law(box: Box, end: _Iterate) -> tuple[Sweep, Array]:
    """Return the law that leads to the controls where a search has ended, and their held set."""
    last, point = end.last, end.interior
    # Under noise the barrier changes the gains, and with them what is minimised.
    inner = point.settled & (box.model.noise is None)
    dxs, dus, slope = select(end.settled | ~inner, last[:3], point[:3])
    k = dus - jnp.sum(last.K * dxs[:-1, None, :], axis=2)
    linear = jnp.sum(last.gradient * dus)
    change = 0.5 * jnp.sum((last.gradient + slope) * dus)
    settled = end.settled | inner
    sweep = Sweep(
        k, last.K, last.gradient, last.curvature - box.damping, linear, change - linear,
        last.ok.all(), last_true(~last.ok), nonfinite(box.model, last.finite), settled,
    )  # fmt: skip
    return sweep, jnp.where(settled, end.side, jnp.nan)


def _search(box: Box, sweeps: Engine, first: Array, max_sweeps: int) -> _Iterate:
    """Search for the held set from a first one; where the sets cycle, by an interior point."""

    # One more than twice the limit: if the sets cycle again, the gains are those of the last one.
    def unsettled(iterate: _Iterate):
        return ~iterate.settled & iterate.last.ok.all() & (iterate.count <= 2 * max_sweeps)

    def body(iterate: _Iterate):
        inside = (iterate.count == max_sweeps) & ~iterate.interior.done
        last = (iterate.count == 2 * max_sweeps) & iterate.interior.settled
        following = jnp.where(last, iterate.inner, iterate.following)
        return _sweep(box, sweeps, iterate._replace(following=following), inside)

    return jax.lax.while_loop(unsettled, body, _start(box, first))


def _start(box: Box, side: Array) -> _Iterate:
    none, every = jnp.zeros_like(side), jnp.ones(len(side), bool)
    dxs = jnp.zeros((len(side) + 1, box.model.vx.size), side.dtype)
    K = jnp.zeros((*side.shape, box.model.vx.size), side.dtype)
    last = Held(dxs, none, none, K, none, none, every, every)
    interior = begin(box, none, jnp.zeros((), side.dtype))
    unknown = jnp.full_like(side, jnp.nan)
    return _Iterate(last, side, side, unknown, jnp.array(False), jnp.array(0), interior)


def _pushed(box: Box, sweeps: Engine) -> Array:
    """Return what the gradient at du = 0 pushes against a bound: -1 lower, 1 upper, 0 neither."""
    gradient = sweeps.costates(box.model)[1]
    at_upper = jnp.where((box.upper <= 0) & (gradient < 0), 1.0, 0.0)
    return jnp.where((box.lower >= 0) & (gradient > 0), -1.0, at_upper).astype(gradient.dtype)


def _sweep(box: Box, sweeps: Engine, iterate: _Iterate, inside: Bool[Array, ""]) -> _Iterate:
    """Sweep once: with the proposed set held, or, `inside`, to the interior point's next step."""
    side, none = iterate.following, jnp.zeros_like(iterate.following)

    def prepare():
        first = begin(box, iterate.last.gradient, jnp.max(jnp.abs(iterate.last.dus)))
        point = select(iterate.interior.count == 0, first, iterate.interior)
        return point, *barrier(box, point), box.movable, box.lower

    def propose():
        value = jnp.where(side < 0, box.lower, box.upper)
        return iterate.interior, none, none, side == 0, value

    point, weight, extra, free, value = jax.lax.cond(inside, prepare, propose)
    step = sweeps.held_lqr(box.model, free, value, box.damping + weight, extra)

    def approach():
        further = advance(box, point, step, weight, extra)
        inner = jnp.where(box.movable, held(further, step.curvature - weight), -1.0)
        ended = jnp.where(further.settled, inner, side)
        return further, iterate.side, ended, inner, jnp.array(False)

    def judge():
        following = _following(box, step, side)
        settled = ((following == side) | ~box.movable).all()
        return point, jnp.where(box.movable, side, following), following, iterate.inner, settled

    point, side, following, inner, settled = jax.lax.cond(inside, approach, judge)
    # A step inside that fails does not end the search over sets.
    step = step._replace(ok=step.ok | inside)
    return _Iterate(step, side, following, inner, settled, iterate.count + ~inside, point)


def _following(box: Box, step: Held, side: Array) -> Array:
    """Hold what left the box, and release what its multiplier pushes inwards."""
    lower, upper, dus = box.lower, box.upper, step.dus
    eps = jnp.finfo(dus.dtype).eps
    scale = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
    room = 10 * eps * jnp.where(jnp.isfinite(scale), scale, 0.0)
    left = jnp.where(dus < lower - room, -1.0, jnp.where(dus > upper + room, 1.0, 0.0))
    stays = ((side < 0) & (step.slope > 0)) | ((side > 0) & (step.slope < 0))
    # What has no room is never released, whatever side its multiplier pushes to.
    fixed = jnp.where(step.slope < 0, 1.0, -1.0)
    return jnp.where(box.movable, jnp.where(side == 0, left, side * stays), fixed)
