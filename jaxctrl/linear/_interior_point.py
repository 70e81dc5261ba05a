"""A linear-quadratic problem with bounds on the controls, by a primal-dual interior-point method.

    minimise q(d), lower <= d <= upper, with slacks sL = d - lower, sU = upper - d and multipliers
    zL, zU:        q'(d) - zL + zU = 0,     sL zL = sU zU = mu -> 0

Eliminating the multipliers of a Newton step adds zL/sL + zU/sU to the diagonal of each l_uu: one
Riccati sweep per step, and a second, cheap one for Mehrotra's (1992) corrector.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import LocalModel
from ._riccati import costates, damp, factorise, lqr_rollout, solve_factorised

TO_BOUNDARY = 0.995
"""The fraction of the way to the nearest bound that a step may go."""


class InteriorPoint(NamedTuple):
    """Controls strictly inside the box, their multipliers, each (T, nu), and how good they are."""

    dus: Float[Array, "T nu"]
    lower_multiplier: Float[Array, "T nu"]
    upper_multiplier: Float[Array, "T nu"]
    settled: Bool[Array, ""]
    ok: Bool[Array, ""]
    count: Int[Array, ""]


class _Box(NamedTuple):
    """Bounds (T, nu), which of them exist, and which controls can move at all."""

    lower: Array
    upper: Array
    has_lower: Array
    has_upper: Array
    movable: Array


def moved(model: LocalModel, dxs: Float[Array, "T+1 nx"], dus: Float[Array, "T nu"]) -> LocalModel:
    """Return the model with its linear terms taken at dxs (T+1, nx), dus (T, nu)."""
    dx = dxs[:-1]
    return model._replace(
        lx=model.lx
        + jnp.einsum("tij,tj->ti", model.lxx, dx)
        + jnp.einsum("tji,tj->ti", model.lux, dus),
        lu=model.lu
        + jnp.einsum("tij,tj->ti", model.lux, dx)
        + jnp.einsum("tij,tj->ti", model.luu, dus),
        vx=model.vx + model.vxx @ dxs[-1],
    )


def open_loop(model: LocalModel, dus: Float[Array, "T nu"]) -> Float[Array, "T+1 nx"]:
    """Return the states (T+1, nx) of the linear model under controls dus (T, nu)."""
    K = jnp.zeros((*dus.shape, model.vx.size), dus.dtype)
    return lqr_rollout(model, dus, K, jnp.zeros_like(model.vx))[0]


def interior_point(
    model: LocalModel,
    lower: Float[Array, "T nu"],
    upper: Float[Array, "T nu"],
    scale: Float[Array, ""],
    wanted: Bool[Array, ""],
    max_sweeps: int = 30,
) -> InteriorPoint:
    """Minimise a local model's cost with all controls du in a box.

    Arguments:
        model: local expansion, damped as wanted, convex in du.
        lower, upper: bounds on du, shape (T, nu), lower <= 0 <= upper, perhaps infinite or equal.
        scale: the size of a typical du, where a control has but one bound.
        wanted: False returns at once.
        max_sweeps: limit of the iteration.

    Returns: `InteriorPoint`; `settled` when the duality gap is below eps^0.4 of the reduction of
    the model's cost, `ok` unless a sweep met a Hessian that is not positive definite.
    """
    finite_lower, finite_upper = jnp.isfinite(lower), jnp.isfinite(upper)
    movable = upper > lower
    box = _Box(
        jnp.where(finite_lower, lower, 0.0),
        jnp.where(finite_upper, upper, 0.0),
        finite_lower & movable,
        finite_upper & movable,
        movable,
    )
    width = jnp.where(finite_lower & finite_upper, box.upper - box.lower, scale)
    inside = jnp.clip(0.0, lower + 0.1 * width, upper - 0.1 * width)
    dus = jnp.where(movable, inside, box.lower)
    slope = costates(moved(model, open_loop(model, dus), dus))[1]
    typical = jnp.mean(jnp.abs(slope), axis=0) + jnp.finfo(slope.dtype).tiny
    start = InteriorPoint(
        dus,
        jnp.where(box.has_lower, jnp.maximum(slope, 0.0) + typical, 0.0),
        jnp.where(box.has_upper, jnp.maximum(-slope, 0.0) + typical, 0.0),
        ~wanted,
        jnp.array(True),
        jnp.array(0),
    )

    def unfinished(point: InteriorPoint):
        return ~point.settled & point.ok & (point.count < max_sweeps)

    return jax.lax.while_loop(unfinished, lambda point: _step(model, box, point), start)


def _step(model: LocalModel, box: _Box, point: InteriorPoint) -> InteriorPoint:
    """Take one step of Mehrotra's predictor and corrector."""
    dus, zL, zU = point[:3]
    sL = jnp.where(box.has_lower, dus - box.lower, 1.0)
    sU = jnp.where(box.has_upper, box.upper - dus, 1.0)
    here = moved(model, open_loop(model, dus), dus)
    problem = factorise(damp(here, zL / sL + zU / sU), box.movable)

    def solve(centre, across_lower, across_upper):
        """Solve for the step with products sL zL = centre - across_lower, and likewise above."""
        to_lower = jnp.where(box.has_lower, (centre - across_lower) / sL, 0.0)
        to_upper = jnp.where(box.has_upper, (centre - across_upper) / sU, 0.0)
        k = solve_factorised(
            problem, here.lu - to_lower + to_upper, jnp.zeros_like(dus), here.lx, here.vx
        )
        _, d = lqr_rollout(here, k, problem.K, jnp.zeros_like(here.vx))
        return d, to_lower - zL - zL / sL * d, to_upper - zU + zU / sU * d

    def longest(d, dzL, dzU, fraction):
        """Return the longest step that keeps slacks and multipliers positive, at most 1."""
        rates = jnp.stack([-d / sL, d / sU, -dzL / zL, -dzU / zU])
        there = jnp.stack([box.has_lower, box.has_upper] * 2)
        return 1.0 / jnp.maximum(1.0, jnp.max(jnp.where(there, rates, 0.0)) / fraction)

    def mean(d, dzL, dzU, fraction):
        """Return the mean product of slack and multiplier after a fraction of a step."""
        low = (sL + fraction * d) * (zL + fraction * dzL) * box.has_lower
        high = (sU - fraction * d) * (zU + fraction * dzU) * box.has_upper
        return jnp.sum(low + high) / jnp.maximum(jnp.sum(box.has_lower) + jnp.sum(box.has_upper), 1)

    affine = solve(0.0, 0.0, 0.0)
    mu = mean(*affine, 0.0)
    centring = (mean(*affine, longest(*affine, 1.0)) / jnp.where(mu > 0, mu, 1.0)) ** 3
    d, dzL, dzU = step = solve(centring * mu, affine[0] * affine[1], -affine[0] * affine[2])
    fraction = longest(*step, TO_BOUNDARY)
    good = problem.ok.all() & jnp.isfinite(d).all()
    fraction = jnp.where(good, fraction, 0.0)
    d, dzL, dzU = (jnp.where(good, part, 0.0) for part in step)
    new = InteriorPoint(
        dus + fraction * d, zL + fraction * dzL, zU + fraction * dzU, good, good, point.count + 1
    )
    return new._replace(settled=_settled(model, box, new))


def _settled(model: LocalModel, box: _Box, point: InteriorPoint) -> Bool[Array, ""]:
    """Tell whether the duality gap and the residual are small beside the reduction of the cost."""
    dus, zL, zU = point[:3]
    dxs = open_loop(model, dus)
    slope = costates(moved(model, dxs, dus))[1]
    half = moved(model, 0.5 * dxs, 0.5 * dus)
    change = jnp.sum(half.lx * dxs[:-1]) + jnp.sum(half.lu * dus) + half.vx @ dxs[-1]
    gap = jnp.sum(jnp.where(box.has_lower, (dus - box.lower) * zL, 0.0))
    gap += jnp.sum(jnp.where(box.has_upper, (box.upper - dus) * zU, 0.0))
    residual = jnp.sum(jnp.abs(jnp.where(box.movable, (slope - zL + zU) * dus, 0.0)))
    return gap + residual <= jnp.finfo(dus.dtype).eps ** 0.4 * jnp.abs(change)
