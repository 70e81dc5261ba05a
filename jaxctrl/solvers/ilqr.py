"""The iterative linear-quadratic regulator, with bounds on the controls."""

import equinox as eqx
import jax.numpy as jnp

from .._controller import AffinePolicy
from .._local_model import expand
from . import shooting
from ._abstract import AbstractSolver, Record


class ILQR(AbstractSolver):
    """Minimise the nominal cost by Gauss-Newton steps, each a linear-quadratic problem.

    Around the present trajectory the dynamics are expanded to first order and the cost to second;
    the Riccati sweep gives the law du = k + K dx that is optimal for that model (Li 2006, eq.
    4.12-4.18); it is rolled out on the true dynamics, with k halved until the cost falls. Control
    bounds enter each step's quadratic as a box (Tassa, Mansard & Todorov 2014). Regularisation is
    relative to the curvature, so that neither the unit of the cost nor those of the controls
    matter; noise is ignored.

    Arguments:
        gradient_tolerance, cost_tolerance, step_tolerance: see `jaxctrl.Tolerances`; the defaults
            scale with the dtype's eps. An iterate has converged when its projected gradient is
            within the first tolerance and the expected reduction of the cost, or the step, is
            within its own.
    """

    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    @property
    def tolerances(self) -> shooting.Tolerances:
        """The three tolerances together."""
        return shooting.Tolerances(
            self.gradient_tolerance, self.cost_tolerance, self.step_tolerance
        )

    def init(self, problem, x0, us):
        """Roll out us (T, nu) from x0 (nx,)."""
        return shooting.init(problem, x0, us)

    def step(self, problem, state):
        """Search along the law, then expand and sweep anew; arrays keep their shapes."""
        return shooting.step(problem, state, expand, self.tolerances)

    def status(self, state):
        """Return why the iteration ends, or `RUNNING`; shape ()."""
        return state.status

    def record(self, state):
        """Return cost, projected gradient, accepted fraction and lambda, each of shape ()."""
        return Record(state.cost, state.gradient, state.fraction, state.lam)

    def near(self, state):
        """Tell whether the gradient is within 100 times its tolerance, shape ()."""
        return state.gradient <= 100 * self.tolerances.resolve(state.cost.dtype)[0]

    def policy(self, problem, state):
        """Return the last gains around the last trajectory, xs (T+1, nx) and us (T, nu).

        Without noise the policy reproduces that trajectory: the step that the sweep would take
        next is not part of it.
        """
        k = jnp.zeros_like(state.us)
        return AffinePolicy(state.xs, state.us, k, state.sweep.K, problem.bounds)
