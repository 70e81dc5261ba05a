"""What solvers share whose end is judged by tolerances."""

import equinox as eqx

from .._solver import AbstractSolver
from ._judging import Tolerances


class AbstractMinimiser(AbstractSolver):
    """A solver whose end `Tolerances` judge; its states have `status`, `gradient` and `cost`."""

    gradient_tolerance: eqx.AbstractVar[float | None]
    cost_tolerance: eqx.AbstractVar[float | None]
    step_tolerance: eqx.AbstractVar[float | None]

    @property
    def tolerances(self) -> Tolerances:
        """The three tolerances together."""
        return Tolerances(self.gradient_tolerance, self.cost_tolerance, self.step_tolerance)

    def status(self, state):
        """Return why the iteration ends, or `RUNNING`; shape ()."""
        return state.status

    def near(self, state):
        """Tell whether the gradient is within 100 times its tolerance, shape ()."""
        return state.gradient <= 100 * self.tolerances.resolve(state.cost.dtype)[0]
