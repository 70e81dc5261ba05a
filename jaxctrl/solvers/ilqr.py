"""The iterative linear-quadratic regulator, with bounds on the controls."""

from typing import ClassVar

import equinox as eqx

from .._local_model import expand
from ..linear._engine import find_engine
from .shooting import AbstractShooting, box_or_free_law


class ILQR(AbstractShooting):
    """Minimise the nominal cost by Gauss-Newton steps, each a linear-quadratic problem.

    Around the present trajectory the dynamics are expanded to first order and the cost to second;
    the Riccati sweep gives the law du = k + K dx that is optimal for that model (Li 2006, eq.
    4.12-4.18); it is rolled out on the true dynamics, with k halved until the cost falls. Control
    bounds enter each step's quadratic as a box (Tassa, Mansard & Todorov 2014). Regularisation is
    relative to the curvature, so that neither the unit of the cost nor those of the controls
    matter; noise is ignored.

    Near the optimum the gradient falls by a constant factor each iteration; `DDP` squares it.

    Arguments:
        gradient_tolerance, cost_tolerance, step_tolerance: see `jaxctrl.Tolerances`; the defaults
            scale with the dtype's eps. An iterate has converged when its projected gradient is
            within the first tolerance and the expected reduction of the cost, or the step, is
            within its own.
        sweep: "sequential", or "parallel" in time: the same steps to round-off, from
            linear-quadratic problems solved in a depth of operations that grows as log T (Sarkka &
            Garcia-Fernandez 2023). It is meant for accelerators and long horizons; on a CPU it is
            slower. Roll-outs on the true dynamics stay sequential.

    Raises: ValueError for an unknown `sweep`.
    """

    second_order: ClassVar[bool] = False
    stochastic: ClassVar[bool] = False
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)
    sweep: str = eqx.field(static=True, default="sequential")

    def __check_init__(self):
        find_engine(self.sweep)

    def expand(self, problem, xs, us, near):
        """Return the first-order model; `near` changes nothing."""
        return expand(problem, xs, us)

    def law(self, model, damping, box, guess, last):
        """Return the model's exact minimiser, in the box if there is one, and what it holds."""
        return box_or_free_law(model, damping, box, guess, self.sweep)

    def merit(self, problem, xs, us, law, model=None):
        """Return the nominal cost, shape ()."""
        return problem.total_cost(xs, us)
