"""Nonlinear conjugate gradients, with bounds on the controls."""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._descent import AbstractDescent, DescentState, Point, as_before


class _Last(NamedTuple):
    """The last gradient and direction, each (T, nu)."""

    gradient: Float[Array, "T nu"]
    direction: Float[Array, "T nu"]


class ConjugateGradient(AbstractDescent):
    """Minimise the nominal cost by conjugate gradients, the thesis's "CGD".

    With g the gradient of the cost in all controls and D one number for each control, the geometric
    mean over time of its |Q_uu| in a Riccati sweep,

        d = -g/D + beta d_last,  beta = max(0, g'(g - g_last)/D / (g_last'g_last/D)),

    the preconditioned formula of Polak, Ribiere and Powell (Nocedal & Wright 2006, ch. 5.2), which
    starts anew wherever d is no direction of descent. Along d a step satisfies Wolfe's strong
    conditions, |d'g| falling to a tenth.
    With bounds the search follows the arc clip(u + a d), and what the gradient pushes against a
    bound is held there. Noise is ignored.

    A rival of `ILQR` to compare it with: an iteration needs only gradients, but there are many.

    Arguments:
        gradient_tolerance, cost_tolerance, step_tolerance: as in `ILQR`. A sweep at the end decides
            by the same measure, so that a success means the same.
    """

    _curvature: ClassVar[float] = 0.1
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    def _begin(self, us):
        return _Last(jnp.zeros_like(us), jnp.zeros_like(us))

    def _direction(self, point: Point, state: DescentState):
        g, last = jnp.where(point.free, point.gradient, 0.0), state.memory
        down = g / point.metric
        before = jnp.where(point.free, last.gradient, 0.0)
        square = jnp.sum(before * before / point.metric)
        change = jnp.sum(down * (g - before))
        beta = jnp.where(square > 0, change / jnp.where(square > 0, square, 1.0), 0.0)
        along = jnp.where(point.free, last.direction, 0.0)
        d = jnp.maximum(beta, 0.0) * along - down
        falls = (jnp.sum(g * d) < 0) & ~state.fresh
        d = jnp.where(falls, d, -down)
        slope = jnp.sum(g * d)
        return d, as_before(state, slope, jnp.ones_like(slope)), _Last(point.gradient, d)
