"""Differential dynamic programming: the exact second order, with bounds on the controls."""

from typing import ClassVar, Literal, get_args

import equinox as eqx

from .._local_model import expand
from ..linear._engine import find_engine
from .shooting import AbstractShooting, box_or_free_law

Start = Literal["gauss-newton", "exact"]


class DDP(AbstractShooting):
    """Minimise the nominal cost by Newton steps, each a linear-quadratic problem.

    As `ILQR`, but the model's Hessians l_zz of each step have the second derivatives of the
    dynamics added, contracted with the costates p: l_zz + sum_i p_i (f_i)_zz, z = (x, u). Near the
    optimum the gradient is squared each iteration. Far from it the exact Hessian is often
    indefinite and says little: steps are ILQR's until the projected gradient is below 1, and
    wherever the exact one gives no step that lowers the cost. Such an attempt is an iteration with
    `step` 0; the gradient, measured in the other model's curvature, may change with it.

    The costates are those of the present trajectory, which makes the step Newton's in all the
    controls at once (Pantoja 1988; De O. Pantoja & Mayne 1991), rolled out with feedback; Jacobson
    & Mayne (1970) take V_x of the sweep instead, which agrees at the optimum. Control bounds are
    those of `ILQR`, and noise is ignored.

    Arguments:
        gradient_tolerance, cost_tolerance, step_tolerance, sweep: as in `ILQR`.
        start: "gauss-newton", or "exact", the textbook's form: the model is the exact one from the
            first iteration on, and where it is not convex, or its step does not lower the cost, it
            is damped until it is (Levenberg-Marquardt, each attempt an iteration with `step` 0).
            It is there for comparison: far from the optimum it takes more and dearer iterations.

    Raises: ValueError for an unknown `sweep` or `start`.
    """

    stochastic: ClassVar[bool] = False
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)
    sweep: str = eqx.field(static=True, default="sequential")
    start: Start = eqx.field(static=True, default="gauss-newton")

    def __check_init__(self):
        find_engine(self.sweep)
        if self.start not in get_args(Start):
            known = " or ".join(f'"{word}"' for word in get_args(Start))
            raise ValueError(f"start: {known} is wanted, got {self.start!r}")

    @property
    def second_order(self) -> bool:
        """Whether there is a model to begin with that is not the exact one."""
        return self.start == "gauss-newton"

    def expand(self, problem, xs, us, near):
        """Return the model, of exact second order if `near`, or always."""
        return expand(problem, xs, us, second_order=near if self.second_order else True)

    def law(self, model, damping, box, guess, last):
        """Return the model's exact minimiser, in the box if there is one, and what it holds."""
        return box_or_free_law(model, damping, box, guess, self.sweep)

    def merit(self, problem, xs, us, law, model=None):
        """Return the nominal cost, shape ()."""
        return problem.total_cost(xs, us)
