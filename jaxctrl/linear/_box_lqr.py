"""A linear-quadratic problem with bounds on the controls, solved exactly by whole sweeps."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._types import LocalModel
from ._interior_point import InteriorPoint, interior_point, moved, open_loop
from ._riccati import (
    Sweep,
    costates,
    damp,
    factorise,
    last_failure,
    lqr_rollout,
    model_change,
    solve_factorised,
)


class _Iterate(NamedTuple):
    """Controls du (T, nu), the sides that led to them, gains, and what comes next."""

    dus: Float[Array, "T nu"]
    side: Float[Array, "T nu"]
    following: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    curvature: Float[Array, "T nu"]
    ok: Bool[Array, " T"]
    settled: Bool[Array, ""]
    count: Int[Array, ""]


def box_lqr(
    model: LocalModel,
    lower: Float[Array, "T nu"],
    upper: Float[Array, "T nu"],
    damping: ArrayLike = 0.0,
    *,
    side: Float[Array, "T nu"] | None = None,
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
            0 free; such as the last one; by default `pushed`.
        max_sweeps: limit of the iteration over sets.

    Returns: `Sweep`, whose law keeps du in the box on the model and whose gains are zero for held
    controls, and the held set, as `side`. Its `settled` is False where neither method ended.
    """
    damped = damp(model, damping)
    if side is None:
        side = pushed(costates(model)[1], lower, upper)
    start = _Iterate(
        dus=jnp.zeros_like(model.lu),
        side=side,
        following=side,
        K=jnp.zeros((*model.lu.shape, model.vx.size), model.lu.dtype),
        curvature=jnp.zeros_like(model.lu),
        ok=jnp.ones(model.lu.shape[0], bool),
        settled=jnp.array(False),
        count=jnp.array(0),
    )

    def unsettled(iterate: _Iterate):
        return ~iterate.settled & iterate.ok.all() & (iterate.count < max_sweeps)

    guessed = jax.lax.while_loop(
        unsettled, lambda iterate: _active_set(damped, lower, upper, iterate), start
    )
    cycling = ~guessed.settled & guessed.ok.all()
    point = interior_point(damped, lower, upper, jnp.max(jnp.abs(guessed.dus)), cycling)
    restart = guessed._replace(
        following=jnp.where(guessed.settled, guessed.side, _held(guessed, point, lower, upper)),
        count=jnp.array(0),
    )
    last = jax.lax.while_loop(
        unsettled, lambda iterate: _active_set(damped, lower, upper, iterate), restart
    )
    dus = jnp.where(last.settled, last.dus, point.dus)
    # The law that leads to these controls on the model.
    k = dus - jnp.einsum("tij,tj->ti", last.K, open_loop(damped, dus)[:-1])
    linear, quadratic, _ = model_change(model, k, last.K)
    sweep = Sweep(
        k=k,
        K=last.K,
        free=last.side == 0,
        curvature=last.curvature - jnp.broadcast_to(damping, last.curvature.shape),
        linear=linear,
        quadratic=quadratic,
        ok=last.ok.all(),
        failed=last_failure(last.ok),
        settled=last.settled | (cycling & point.settled),
    )
    return sweep, last.side


def pushed(
    gradient: Float[Array, "T nu"], lower: Float[Array, "T nu"], upper: Float[Array, "T nu"]
) -> Float[Array, "T nu"]:
    """Return what the gradient at du = 0 pushes against a bound: -1 lower, 1 upper, 0 neither.

    Arguments: gradient, and the bounds on du, each of shape (T, nu).
    """
    at_upper = jnp.where((upper <= 0) & (gradient < 0), 1.0, 0.0)
    return jnp.where((lower >= 0) & (gradient > 0), -1.0, at_upper).astype(gradient.dtype)


def _held(iterate: _Iterate, point: InteriorPoint, lower: Array, upper: Array) -> Array:
    """Return the side of each control whose multiplier outweighs its distance from the bound."""
    D = jnp.maximum(iterate.curvature, 0.0)
    at_lower = point.lower_multiplier > D * (point.dus - lower)
    at_upper = point.upper_multiplier > D * (upper - point.dus)
    return jnp.where(at_lower, -1.0, jnp.where(at_upper, 1.0, 0.0)).astype(D.dtype)


def _active_set(model: LocalModel, lower, upper, iterate: _Iterate) -> _Iterate:
    """Solve with the proposed set held, then propose the next one."""
    side = iterate.following
    problem = factorise(model, side == 0)
    held = jnp.where(side < 0, lower, upper)
    k = solve_factorised(problem, model.lu, held, model.lx, model.vx)
    still = jnp.zeros_like(model.vx)
    dxs, dus = lqr_rollout(model, k, problem.K, still)
    # In float32 a badly scaled law is too coarse to tell which multipliers push inwards.
    for _ in range(0 if dus.dtype == jnp.float64 else 2):
        at = moved(model, dxs, dus)
        k += solve_factorised(problem, at.lu, jnp.zeros_like(held), at.lx, at.vx)
        dxs, dus = lqr_rollout(model, k, problem.K, still)
    slope = costates(moved(model, dxs, dus))[1]

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
        dus, side, following, problem.K, curvature, problem.ok, settled, iterate.count + 1
    )
