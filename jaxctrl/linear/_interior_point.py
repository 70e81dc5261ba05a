"""Steps of a primal-dual interior-point method for a model with its controls in a box.

    minimise q(d), lower <= d <= upper, with slacks sL = d - lower, sU = upper - d and multipliers
    zL, zU:        q'(d) - zL + zU = 0,     sL zL = sU zU = mu -> 0

The slacks are unknowns of their own, so that any d may start (Wright 1997, ch. 10). Without slacks
and multipliers, a Newton step minimises q(d) + extra'd + d'W d/2 with W = zL/sL + zU/sU: one
Riccati sweep, with a larger damping.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._types import LocalModel
from ._riccati import Held

TO_BOUNDARY = 0.995
"""The fraction of the way to the nearest bound that a step may go."""
MAX_STEPS = 40


class Box(NamedTuple):
    """A model with its damping and the bounds of its controls, each (T, nu)."""

    model: LocalModel
    damping: Float[Array, "T nu"]
    lower: Float[Array, "T nu"]
    upper: Float[Array, "T nu"]

    @property
    def movable(self) -> Bool[Array, "T nu"]:
        """Which controls have any room, (T, nu)."""
        return self.upper > self.lower

    @property
    def sides(self) -> tuple[Array, Array, Array, Array]:
        """The bounds, 0 where there is none to keep, and where there is one, each (T, nu)."""
        has_lower = jnp.isfinite(self.lower) & self.movable
        has_upper = jnp.isfinite(self.upper) & self.movable
        lower = jnp.where(has_lower, self.lower, 0.0)
        return lower, jnp.where(has_upper, self.upper, 0.0), has_lower, has_upper


class InteriorPoint(NamedTuple):
    """A point with its slacks and multipliers, and how far the method has got.

    States dxs (T+1, nx), controls dus and the model's gradient there, (T, nu); slacks, 1 where
    there is no bound, and multipliers, 0 there, (T, nu). `length` is that of the last step, `error`
    the duality gap and the residuals, `done` tells whether there is to be no other step, `settled`
    whether this is the minimiser.
    """

    dxs: Float[Array, "T+1 nx"]
    dus: Float[Array, "T nu"]
    slope: Float[Array, "T nu"]
    lower_slack: Float[Array, "T nu"]
    upper_slack: Float[Array, "T nu"]
    lower_multiplier: Float[Array, "T nu"]
    upper_multiplier: Float[Array, "T nu"]
    length: Float[Array, ""]
    error: Float[Array, ""]
    done: Bool[Array, ""]
    settled: Bool[Array, ""]
    count: Int[Array, ""]


def begin(box: Box, gradient: Float[Array, "T nu"], scale: Float[Array, ""]) -> InteriorPoint:
    """Return the first point, du = 0.

    Arguments:
        box: the model and the bounds on du, lower <= 0 <= upper, perhaps infinite or equal.
        gradient: of the model at 0, (T, nu).
        scale: the size of a typical du, where a control has but one bound.
    """
    lower, upper, has_lower, has_upper = box.sides
    width = jnp.where(has_lower & has_upper, upper - lower, scale)
    typical = jnp.mean(jnp.abs(gradient), axis=0) + jnp.finfo(gradient.dtype).tiny
    zero = jnp.zeros_like(gradient)
    return InteriorPoint(
        dxs=jnp.zeros((len(gradient) + 1, box.model.vx.size), gradient.dtype),
        dus=zero,
        slope=gradient,
        lower_slack=jnp.where(has_lower, jnp.maximum(-lower, 0.1 * width), 1.0),
        upper_slack=jnp.where(has_upper, jnp.maximum(upper, 0.1 * width), 1.0),
        lower_multiplier=jnp.where(has_lower, jnp.maximum(gradient, 0.0) + typical, 0.0),
        upper_multiplier=jnp.where(has_upper, jnp.maximum(-gradient, 0.0) + typical, 0.0),
        length=jnp.full((), 0.5, gradient.dtype),
        error=jnp.full((), jnp.inf, gradient.dtype),
        done=jnp.array(False),
        settled=jnp.array(False),
        count=jnp.array(0),
    )


def _targets(box: Box, point: InteriorPoint) -> tuple[Array, Array, Array]:
    """Return the product of slack and multiplier to aim at, and both slacks' errors."""
    lower, upper, has_lower, has_upper = box.sides
    products = point.lower_slack * point.lower_multiplier
    products += point.upper_slack * point.upper_multiplier
    mean = jnp.sum(products) / jnp.maximum(jnp.sum(has_lower) + jnp.sum(has_upper), 1)
    # The last step's length tells how central the point is.
    centre = jnp.clip((1 - 0.9 * point.length) ** 2, 0.01, 0.8) * mean
    off_lower = jnp.where(has_lower, point.dus - lower - point.lower_slack, 0.0)
    return centre, off_lower, jnp.where(has_upper, upper - point.dus - point.upper_slack, 0.0)


def barrier(box: Box, point: InteriorPoint) -> tuple[Float[Array, "T nu"], Float[Array, "T nu"]]:
    """Return what a Newton step adds to the damping and to the linear terms, each (T, nu)."""
    centre, off_lower, off_upper = _targets(box, point)
    _, _, has_lower, has_upper = box.sides
    stiff_lower = point.lower_multiplier / point.lower_slack
    stiff_upper = point.upper_multiplier / point.upper_slack
    extra = jnp.where(has_lower, stiff_lower * off_lower - centre / point.lower_slack, 0.0)
    extra -= jnp.where(has_upper, stiff_upper * off_upper - centre / point.upper_slack, 0.0)
    return stiff_lower + stiff_upper, extra - (stiff_lower + stiff_upper) * point.dus


def advance(
    box: Box, point: InteriorPoint, step: Held, weight: Array, extra: Array
) -> InteriorPoint:
    """Go towards a Newton step's end, as far as slacks and multipliers stay positive.

    Arguments: where it starts, its end, and what `barrier` added there, each (T, nu).

    Settled when the duality gap and the residuals are below eps^0.4 of the reduction of the model's
    cost. Goes on until they fall no more, which tells surer which controls are at bounds; ends also
    when a step failed, and after `MAX_STEPS`.
    """
    sL, sU, zL, zU = point[3:7]
    centre, off_lower, off_upper = _targets(box, point)
    _, _, has_lower, has_upper = box.sides
    d = step.dus - point.dus
    dsL, dsU = (d + off_lower) * has_lower, (off_upper - d) * has_upper
    dzL = jnp.where(has_lower, (centre - zL * dsL) / sL - zL, 0.0)
    dzU = jnp.where(has_upper, (centre - zU * dsU) / sU - zU, 0.0)
    tiny = jnp.finfo(d.dtype).tiny
    rates = jnp.stack([-dsL / sL, -dsU / sU, -dzL / (zL + tiny), -dzU / (zU + tiny)])
    length = 1.0 / jnp.maximum(1.0, jnp.max(rates) / TO_BOUNDARY)
    good = step.ok.all() & jnp.isfinite(step.dus).all()
    length = jnp.where(good, length, 0.0)
    slope = step.slope - extra - weight * step.dus
    ends = (step.dxs, step.dus, slope, sL + dsL, sU + dsU, zL + dzL, zU + dzU)
    dxs, dus, slope, sL, sU, zL, zU = (
        jnp.where(good, old + length * (new - old), old)
        for old, new in zip(point[:7], ends, strict=True)
    )
    _, off_lower, off_upper = _targets(box, point._replace(dus=dus, lower_slack=sL, upper_slack=sU))
    gap = jnp.sum(zL * (sL + jnp.abs(off_lower)) + zU * (sU + jnp.abs(off_upper)))
    residual = jnp.sum(jnp.abs((slope - zL + zU) * dus) * box.movable)
    change = 0.5 * jnp.sum((step.gradient + slope) * dus)
    error, count = gap + residual, point.count + 1
    settled = good & (error <= jnp.finfo(d.dtype).eps ** 0.4 * jnp.abs(change))
    ends = point.settled & ~(good & settled & (error < point.error))
    done = ends | ~good | (count >= MAX_STEPS)
    new = InteriorPoint(dxs, dus, slope, sL, sU, zL, zU, length, error, done, settled, count)
    return select(ends, point._replace(done=jnp.array(True), count=count), new)


def held(point: InteriorPoint, curvature: Float[Array, "T nu"]) -> Float[Array, "T nu"]:
    """Return the side of each control whose multiplier outweighs its distance from the bound.

    Arguments: a point, and the diagonal of each Q_uu of the model, (T, nu).

    Returns: -1, 0 or 1, (T, nu).
    """
    D = jnp.maximum(curvature, 0.0)
    at_lower = point.lower_multiplier > D * point.lower_slack
    at_upper = point.upper_multiplier > D * point.upper_slack
    return jnp.where(at_lower, -1.0, jnp.where(at_upper, 1.0, 0.0)).astype(D.dtype)


def select(condition: Bool[Array, ""], a, b):
    """Return the first of two pytrees where a condition holds, else the second."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)
