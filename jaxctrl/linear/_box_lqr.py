"""A linear-quadratic problem with bounds on the controls, solved exactly by whole sweeps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import LocalModel
from ._interior_point import Box, InteriorPoint, interior_point
from ._riccati import Sweep, costates, factorise, last_true, nonfinite, solve_factorised


class _Iterate(NamedTuple):
    """A point, the sides that led to it, gains, what comes next, and an interior point.

    `interior` is the point and slope that the interior-point method found, and whether it did.
    """

    dxs: Float[Array, "T+1 nx"]
    dus: Float[Array, "T nu"]
    slope: Float[Array, "T nu"]
    side: Float[Array, "T nu"]
    following: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    curvature: Float[Array, "T nu"]
    ok: Bool[Array, " T"]
    finite: Bool[Array, " T"]
    settled: Bool[Array, ""]
    count: Int[Array, ""]
    interior: tuple[Array, Array, Array, Array]


def box_lqr(
    model: LocalModel,
    lower: Float[Array, "T nu"],
    upper: Float[Array, "T nu"],
    damping: ArrayLike = 0.0,
    *,
    side: Float[Array, "T nu"] | None = None,
    hasty: ArrayLike = False,
    max_sweeps: int = 12,
) -> tuple[Sweep, Float[Array, "T nu"]]:
    """Minimise a local model's cost with all controls du in a box.

    Hold a set of controls at their bounds, solve for the others by a Riccati sweep, then hold what
    left the box and release what the multipliers push inwards, until nothing changes (the
    primal-dual active set; Hintermueller, Ito & Kunisch 2002). The result is the exact minimiser.
    Choosing each step's k in the box by itself (Tassa, Mansard & Todorov 2014) is not: there the
    feedback K dx leaves the box, which costs iterations when bounds bind hard.

    The sets may cycle. After `max_sweeps`, an interior-point method gives them a new start, or,
    should they cycle again, the result.

    Arguments:
        model: local expansion; every array but the last two leads with time.
        lower, upper: bounds on du, shape (T, nu), lower <= 0 <= upper.
        damping: as in `lqr`.
        side: first guess of the held set, shape (T, nu): -1 at the lower bound, 1 at the upper,
            0 free, NaN where what the gradient pushes against a bound is to be the guess, which is
            the default everywhere.
        hasty: True asks for a single sweep with the guess, whose controls may leave the box.
        max_sweeps: limit of the iteration over sets.

    Returns: `Sweep`, whose law keeps du in the box on the model and whose gains are zero for held
    controls, and the `side` to begin with the next time: the held set, or what a single sweep
    proposes; NaN where the sets cycled. `settled` is False where the sweep is not the minimiser.
    """
    gradient = costates(model)[1]
    box = Box(model, gradient, jnp.broadcast_to(damping, gradient.shape), lower, upper)
    side = jnp.full_like(gradient, jnp.nan) if side is None else side
    side = jnp.where(jnp.isnan(side), _pushed(gradient, lower, upper), side)
    none, every = jnp.zeros_like(gradient), jnp.ones(len(gradient), bool)
    dxs = jnp.zeros((len(gradient) + 1, model.vx.size), none.dtype)
    start = _Iterate(
        dxs=dxs,
        dus=none,
        slope=none,
        side=side,
        following=side,
        K=jnp.zeros((*none.shape, model.vx.size), none.dtype),
        curvature=none,
        ok=every,
        finite=every,
        settled=jnp.array(False),
        count=jnp.array(0),
        interior=(dxs, none, none, jnp.array(False)),
    )

    def unsettled(iterate: _Iterate):
        limit = jnp.where(hasty, 1, 2 * max_sweeps)
        return ~iterate.settled & iterate.ok.all() & (iterate.count < limit)

    def body(iterate: _Iterate):
        cycling = iterate.count == max_sweeps
        # Under vmap both branches are computed: a lane that does not cycle must not iterate there.
        restart = jax.lax.cond(
            cycling, lambda it: _restart(box, it, cycling), lambda it: it, iterate
        )
        return _active_set(box, restart)

    last = jax.lax.while_loop(unsettled, body, start)
    found = last.interior[3]
    dxs, dus, slope = (
        jnp.where(last.settled | ~found, own, interior)
        for own, interior in zip(last[:3], last.interior[:3], strict=True)
    )
    # The law that leads to these controls on the model.
    k = dus - jnp.einsum("tij,tj->ti", last.K, dxs[:-1])
    linear = jnp.sum(gradient * dus)
    quadratic = box.change(dus, slope) - linear
    sweep = Sweep(
        k, last.K, gradient, last.curvature - box.damping, linear, quadratic,
        last.ok.all(), last_true(~last.ok), nonfinite(model, last.finite), last.settled | found,
    )  # fmt: skip
    return sweep, jnp.where(last.settled | hasty, last.following, jnp.nan)


def _pushed(gradient: Array, lower: Array, upper: Array) -> Array:
    """Return what the gradient at du = 0 pushes against a bound: -1 lower, 1 upper, 0 neither."""
    at_upper = jnp.where((upper <= 0) & (gradient < 0), 1.0, 0.0)
    return jnp.where((lower >= 0) & (gradient > 0), -1.0, at_upper).astype(gradient.dtype)


def _restart(box: Box, iterate: _Iterate, wanted: Bool[Array, ""]) -> _Iterate:
    """Propose the set that holds at the interior-point method's solution."""
    point = interior_point(box, jnp.max(jnp.abs(iterate.dus)), wanted)
    return iterate._replace(
        following=_held(iterate, point, box),
        interior=(point.dxs, point.dus, point.slope, point.settled),
    )


def _held(iterate: _Iterate, point: InteriorPoint, box: Box) -> Array:
    """Return the side of each control whose multiplier outweighs its distance from the bound."""
    D = jnp.maximum(iterate.curvature, 0.0)
    at_lower = point.lower_multiplier > D * (point.dus - box.lower)
    at_upper = point.upper_multiplier > D * (box.upper - point.dus)
    return jnp.where(at_lower, -1.0, jnp.where(at_upper, 1.0, 0.0)).astype(D.dtype)


def _active_set(box: Box, iterate: _Iterate) -> _Iterate:
    """Solve with the proposed set held, then propose the next one."""
    lower, upper, side = box.lower, box.upper, iterate.following
    problem = factorise(box.model, side == 0, box.damping)
    held = jnp.where(side < 0, lower, upper)
    dxs, dus = solve_factorised(problem, box.gradient, held)
    slope = box.slope(dxs, dus)
    # In float32 a badly scaled law is too coarse to tell which multipliers push inwards.
    for _ in range(0 if dus.dtype == jnp.float64 else 2):
        more = solve_factorised(problem, slope, jnp.zeros_like(held))
        dxs, dus = dxs + more[0], dus + more[1]
        slope = box.slope(dxs, dus)

    # What is in the box and pushed nowhere keeps its place.
    eps = jnp.finfo(dus.dtype).eps
    scale = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
    room = 10 * eps * jnp.where(jnp.isfinite(scale), scale, 0.0)
    curvature = jnp.diagonal(problem.Quu, axis1=1, axis2=2)
    noise = 100 * eps * curvature * jnp.maximum(jnp.abs(dus).max(), room)
    left = jnp.where(dus < lower - room, -1.0, jnp.where(dus > upper + room, 1.0, 0.0))
    stays = ((side < 0) & (slope > -noise)) | ((side > 0) & (slope < noise))
    following = jnp.where(side == 0, left, side * stays)
    settled = (following == side).all()
    return _Iterate(
        dxs, dus, slope, side, following, problem.K, curvature, problem.ok, problem.finite,
        settled, iterate.count + 1, iterate.interior,
    )  # fmt: skip
