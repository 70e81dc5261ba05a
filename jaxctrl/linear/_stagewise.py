"""A sweep whose every step chooses its own control in a box (Tassa, Mansard & Todorov 2014)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import LocalModel, Stages
from ._boxqp import box_qp, solve_free
from ._riccati import Law, Sweep, add_diagonal, swept
from ._step import Action


class Boxed(NamedTuple):
    """The minimiser of each step's Q in a box at dx = 0, of the model damped by d, each (T, nu).

    Gains of controls at a bound are zero, those of the others -Q_uu,FF^-1 Q_ux,F.
    """

    lower: Float[Array, "T nu"]
    upper: Float[Array, "T nu"]
    damping: Float[Array, "T nu"]

    @property
    def best(self) -> bool:
        """True."""
        return True

    def price(self, stage: Stages) -> Stages:
        """Return the stage with d added to the diagonal of l_uu."""
        return stage._replace(luu=add_diagonal(stage.luu, self.damping))

    def choose(self, Q: Action) -> Law:
        """Return the minimiser; gains are zero where Q_uu is not positive definite."""
        found = box_qp(Q.uu, Q.u, self.lower, self.upper)
        solved, ok = solve_free(Q.uu, found.free, Q.ux)
        return Law(found.x, jnp.where(ok, -solved, 0.0), ok & found.finished)


def stagewise_lqr(
    model: LocalModel,
    lower: Float[Array, "T nu"],
    upper: Float[Array, "T nu"],
    damping: Float[Array, "T nu"],
) -> tuple[Sweep, Float[Array, "T nu"]]:
    """Sweep with each step's k in the box by itself: one sweep, and no search for a held set.

    K dx may leave the box. Where k = 0 in all that is free, the law is that of `box_lqr`.

    Arguments and result as of `box_lqr`.
    """
    sweep = swept(model, Boxed(lower, upper, damping), damping)
    held = (sweep.K == 0).all(axis=-1)
    at_lower, at_upper = held & (sweep.k <= lower), held & (sweep.k >= upper)
    side = jnp.where(at_lower, -1.0, jnp.where(at_upper, 1.0, 0.0))
    return sweep, side.astype(lower.dtype)
