"""The limited-memory quasi-Newton method L-BFGS, with bounds on the controls."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import optax

from .._checks import check_integer
from ._descent import AbstractDescent, DescentState, Point, as_before


class LBFGS(AbstractDescent):
    """Minimise the nominal cost by L-BFGS steps: an inverse Hessian from the last gradients.

    The direction is that of Nocedal & Wright (2006, alg. 7.4), by optax, in controls each scaled by
    the square root of the geometric mean over time of its |Q_uu| in a Riccati sweep; along it a
    step satisfies Wolfe's strong conditions. With bounds the search follows the arc clip(u + a d),
    and what the gradient pushes against a bound is held there and left out of the Hessian. Noise is
    ignored.

    A rival of `ILQR` to compare it with: an iteration needs only gradients, but there are many.

    Arguments:
        memory: how many steps to remember, at least 1.
        gradient_tolerance, cost_tolerance, step_tolerance: as in `ILQR`. A sweep at the end decides
            by the same measure, so that a success means the same.

    Raises ValueError for a memory that is not an integer of at least 1.
    """

    _curvature: ClassVar[float] = 0.9
    memory: int = eqx.field(
        static=True, default=10, converter=lambda value: check_integer("memory", value, 1)
    )
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    def _begin(self, us):
        return optax.scale_by_lbfgs(self.memory).init(us)

    def _direction(self, point: Point, state: DescentState):
        lbfgs: Any = optax.scale_by_lbfgs(self.memory)
        memory = state.memory
        # In scaled controls v, of cost 1, and without those that are held.
        to_v = jnp.where(point.free, jnp.sqrt(point.metric / point.scale), 0.0)
        to_g = jnp.where(point.free, 1 / jnp.sqrt(point.metric * point.scale), 0.0)
        v, g = to_v * point.us, to_g * point.gradient
        s, y = to_v * memory.diff_params_memory, to_g * memory.diff_updates_memory
        last_v, last_g = to_v * memory.params, to_g * memory.updates
        # A pair of negative curvature is left out.
        convex = _convex(v - last_v, g - last_g)[1]
        scaled = memory._replace(
            params=jnp.where(convex, last_v, v),
            updates=jnp.where(convex, last_g, g),
            diff_params_memory=s,
            diff_updates_memory=y,
            weights_memory=_convex(s, y)[0],
        )
        direction, _ = lbfgs.update(g, scaled, v)
        _, memory = lbfgs.update(point.gradient, memory, point.us)
        down = jnp.where(point.free, direction * jnp.sqrt(point.scale / point.metric), 0.0)
        slope = -jnp.sum(jnp.where(point.free, point.gradient * down, 0.0))
        one = jnp.ones_like(point.scale)
        return -down, jnp.where(state.fresh, as_before(state, slope, one), one), memory


def _convex(s, y):
    """Return 1/(s'y) of each pair (..., T, nu), 0 where that is not clearly positive; and where."""
    product, square = jnp.sum(s * y, axis=(-2, -1)), jnp.sum(y * y, axis=(-2, -1))
    convex = product > jnp.finfo(y.dtype).eps * square
    return jnp.where(convex, 1 / jnp.where(convex, product, 1.0), 0.0), convex
