"""A linear-quadratic problem with bounds on the controls, by a primal-dual active set."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._types import LocalModel
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

    Arguments:
        model: local expansion; every array but the last two leads with time.
        lower, upper: bounds on du, shape (T, nu), lower <= 0 <= upper.
        damping: as in `lqr`.
        side: first guess of the held set, shape (T, nu): -1 at the lower bound, 1 at the upper,
            0 free; by default what the gradient at du = 0 pushes against a bound.
        max_sweeps: limit of the iteration.

    Returns: `Sweep`, whose law keeps du in the box on the model and whose gains are zero for held
    controls, and the held set, as `side`. The sets may cycle, though they seldom do: then `settled`
    is False, and the law only clipped is inside the box.
    """
    damped = damp(model, damping)
    _, gradient = costates(model)
    if side is None:
        side = jnp.where(
            (lower >= 0) & (gradient > 0), -1.0, jnp.where((upper <= 0) & (gradient < 0), 1.0, 0.0)
        )

    def solve(side):
        problem = factorise(damped, side == 0)
        held = jnp.where(side < 0, lower, upper)
        k = solve_factorised(problem, model.lu, held, model.lx, model.vx)
        dxs, dus = lqr_rollout(model, k, problem.K, jnp.zeros_like(model.vx))
        slope = _slope(damped, dxs, dus)
        return problem, k, dus, slope

    def update(side, problem, dus, slope):
        """Return the next held set; what is in the box and pushed nowhere keeps its place."""
        eps = jnp.finfo(dus.dtype).eps
        scale = jnp.maximum(jnp.abs(lower), jnp.abs(upper))
        room = 10 * eps * jnp.where(jnp.isfinite(scale), scale, 0.0)
        noise = 100 * eps * _diagonal(problem.Quu) * jnp.maximum(jnp.abs(dus).max(), room)
        below, above = dus < lower - room, dus > upper + room
        stays = ((side < 0) & (slope > -noise)) | ((side > 0) & (slope < noise))
        return jnp.where(
            side == 0, jnp.where(below, -1.0, jnp.where(above, 1.0, 0.0)), side * stays
        )

    def body(carry):
        _, proposed, _, _, count = carry
        problem, k, dus, slope = solve(proposed)
        following = update(proposed, problem, dus, slope)
        settled = (following == proposed).all()
        outcome = (problem.K, k, _diagonal(problem.Quu), problem.ok)
        return proposed, following, outcome, settled, count + 1

    def unsettled(carry):
        _, _, outcome, settled, count = carry
        return ~settled & outcome[3].all() & (count < max_sweeps)

    nothing = (
        jnp.zeros((*model.lu.shape, model.vx.size), model.lu.dtype),
        jnp.zeros_like(model.lu),
        jnp.zeros_like(model.lu),
        jnp.ones(model.lu.shape[0], bool),
    )
    carry = (side, side, nothing, jnp.array(False), jnp.array(0))
    side, _, (K, k, curvature, ok), settled, _ = jax.lax.while_loop(unsettled, body, carry)
    linear, quadratic, _ = model_change(model, k, K)
    curvature = curvature - jnp.broadcast_to(damping, curvature.shape)
    sweep = Sweep(
        k, K, side == 0, curvature, linear, quadratic, ok.all(), last_failure(ok), settled
    )
    return sweep, side


def _slope(model: LocalModel, dxs: Array, dus: Array) -> Float[Array, "T nu"]:
    """Return the gradient (T, nu) of the model's cost in the controls, at dxs, dus."""
    dx = dxs[:-1]
    at = model._replace(
        lx=model.lx
        + jnp.einsum("tij,tj->ti", model.lxx, dx)
        + jnp.einsum("tji,tj->ti", model.lux, dus),
        lu=model.lu
        + jnp.einsum("tij,tj->ti", model.lux, dx)
        + jnp.einsum("tij,tj->ti", model.luu, dus),
        vx=model.vx + model.vxx @ dxs[-1],
    )
    return costates(at)[1]


def _diagonal(Quu: Float[Array, "T nu nu"]) -> Float[Array, "T nu"]:
    return jnp.diagonal(Quu, axis1=1, axis2=2)
