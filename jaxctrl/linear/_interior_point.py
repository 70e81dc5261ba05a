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
from ._riccati import factorise, hessian_product, lqr_rollout, solve_factorised

TO_BOUNDARY = 0.995
"""The fraction of the way to the nearest bound that a step may go."""


class InteriorPoint(NamedTuple):
    """A point strictly inside the box, and how good it is.

    States dxs (T+1, nx), controls dus, the gradient of the model there and the multipliers of both
    bounds, each (T, nu).
    """

    dxs: Float[Array, "T+1 nx"]
    dus: Float[Array, "T nu"]
    slope: Float[Array, "T nu"]
    lower_multiplier: Float[Array, "T nu"]
    upper_multiplier: Float[Array, "T nu"]
    settled: Bool[Array, ""]
    ok: Bool[Array, ""]
    count: Int[Array, ""]


class Box(NamedTuple):
    """A model with its gradient at zero and its damping, and the bounds, each (T, nu)."""

    model: LocalModel
    gradient: Float[Array, "T nu"]
    damping: Float[Array, "T nu"]
    lower: Float[Array, "T nu"]
    upper: Float[Array, "T nu"]

    def slope(self, dxs: Array, dus: Array) -> Array:
        """Return the gradient of the damped model (T, nu) at dus (T, nu), which lead to dxs."""
        return self.gradient + hessian_product(self.model, dxs, dus) + self.damping * dus

    def change(self, dus: Array, slope: Array) -> Array:
        """Return the change of the damped model's cost at dus, where it has that slope."""
        return 0.5 * jnp.sum((self.gradient + slope) * dus)


def interior_point(
    box: Box, scale: Float[Array, ""], wanted: Bool[Array, ""], max_sweeps: int = 30
) -> InteriorPoint:
    """Minimise a convex local model's cost with all controls du in a box.

    Arguments:
        box: the model and the bounds on du, lower <= 0 <= upper, perhaps infinite or equal.
        scale: the size of a typical du, where a control has but one bound.
        wanted: False returns at once.
        max_sweeps: limit of the iteration.

    Returns: `InteriorPoint`; `settled` when the duality gap is below eps^0.4 of the reduction of
    the model's cost, `ok` unless a sweep met a Hessian that is not positive definite.
    """
    lower, upper, has_lower, has_upper, movable = _sides(box)
    width = jnp.where(jnp.isfinite(box.lower) & jnp.isfinite(box.upper), upper - lower, scale)
    inside = jnp.clip(0.0, box.lower + 0.1 * width, box.upper - 0.1 * width)
    dus = jnp.where(movable, inside, lower)
    K = jnp.zeros((*dus.shape, box.model.vx.size), dus.dtype)
    dxs, _ = lqr_rollout(box.model, dus, K, jnp.zeros_like(box.model.vx))
    slope = box.slope(dxs, dus)
    typical = jnp.mean(jnp.abs(slope), axis=0) + jnp.finfo(slope.dtype).tiny
    start = InteriorPoint(
        dxs,
        dus,
        slope,
        jnp.where(has_lower, jnp.maximum(slope, 0.0) + typical, 0.0),
        jnp.where(has_upper, jnp.maximum(-slope, 0.0) + typical, 0.0),
        jnp.array(False),
        jnp.array(True),
        jnp.array(0),
    )

    def unfinished(point: InteriorPoint):
        return wanted & ~point.settled & point.ok & (point.count < max_sweeps)

    return jax.lax.while_loop(unfinished, lambda point: _step(box, point), start)


def _sides(box: Box) -> tuple[Array, ...]:
    """Return the bounds, 0 where infinite, where they exist, and which controls can move."""
    movable = box.upper > box.lower
    finite_lower, finite_upper = jnp.isfinite(box.lower), jnp.isfinite(box.upper)
    lower = jnp.where(finite_lower, box.lower, 0.0)
    upper = jnp.where(finite_upper, box.upper, 0.0)
    return lower, upper, finite_lower & movable, finite_upper & movable, movable


def _step(box: Box, point: InteriorPoint) -> InteriorPoint:
    """Take one step of Mehrotra's predictor and corrector."""
    dxs, dus, slope, zL, zU = point[:5]
    lower, upper, has_lower, has_upper, movable = _sides(box)
    sL = jnp.where(has_lower, dus - lower, 1.0)
    sU = jnp.where(has_upper, upper - dus, 1.0)
    problem = factorise(box.model, movable, box.damping + zL / sL + zU / sU)

    def solve(centre, across_lower, across_upper):
        """Solve for the step with products sL zL = centre - across_lower, and likewise above."""
        to_lower = jnp.where(has_lower, (centre - across_lower) / sL, 0.0)
        to_upper = jnp.where(has_upper, (centre - across_upper) / sU, 0.0)
        dx, d = solve_factorised(problem, slope - to_lower + to_upper, jnp.zeros_like(dus))
        return dx, d, to_lower - zL - zL / sL * d, to_upper - zU + zU / sU * d

    def longest(d, dzL, dzU, fraction):
        """Return the longest step that keeps slacks and multipliers positive, at most 1."""
        rates = jnp.stack([-d / sL, d / sU, -dzL / zL, -dzU / zU])
        there = jnp.stack([has_lower, has_upper] * 2)
        return 1.0 / jnp.maximum(1.0, jnp.max(jnp.where(there, rates, 0.0)) / fraction)

    def mean(d, dzL, dzU, fraction):
        """Return the mean product of slack and multiplier after a fraction of a step."""
        low = (sL + fraction * d) * (zL + fraction * dzL) * has_lower
        high = (sU - fraction * d) * (zU + fraction * dzU) * has_upper
        return jnp.sum(low + high) / jnp.maximum(jnp.sum(has_lower) + jnp.sum(has_upper), 1)

    affine = solve(0.0, 0.0, 0.0)[1:]
    mu = mean(*affine, 0.0)
    centring = (mean(*affine, longest(*affine, 1.0)) / jnp.where(mu > 0, mu, 1.0)) ** 3
    step = solve(centring * mu, affine[0] * affine[1], -affine[0] * affine[2])
    fraction = longest(*step[1:], TO_BOUNDARY)
    good = problem.ok.all() & jnp.isfinite(step[1]).all()
    old = (dxs, dus, zL, zU)
    dxs, dus, zL, zU = (
        jnp.where(good, a + fraction * b, a) for a, b in zip(old, step, strict=True)
    )
    slope = box.slope(dxs, dus)
    gap = jnp.sum(jnp.where(has_lower, (dus - lower) * zL, 0.0))
    gap += jnp.sum(jnp.where(has_upper, (upper - dus) * zU, 0.0))
    residual = jnp.sum(jnp.abs(jnp.where(movable, (slope - zL + zU) * dus, 0.0)))
    small = jnp.finfo(dus.dtype).eps ** 0.4 * jnp.abs(box.change(dus, slope))
    return InteriorPoint(
        dxs, dus, slope, zL, zU, good & (gap + residual <= small), good, point.count + 1
    )
