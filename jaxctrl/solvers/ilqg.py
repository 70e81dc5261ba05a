"""The iterative linear-quadratic-Gaussian method: feedback that knows about the noise."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._local_model import expand
from .._prediction import noise_cost
from .shooting import AbstractShooting, box_or_free_law


class ILQG(AbstractShooting):
    """Minimise the expected cost under the problem's noise, by linear-quadratic-Gaussian steps.

    Around the present trajectory dynamics and noise are expanded to first order, the cost to second
    (Li 2006, eq. 5.4-5.13; Todorov & Li 2005):

        dx' = f_x dx + f_u du + sum_i (c_i + cx_i dx + cu_i du) xi_i,    xi_i ~ N(0, 1).

    A sweep gives the law du = k + K dx that is optimal for that model. Noise that grows with the
    controls prices them, sum_i cu_i'V_xx cu_i, so that gains are lower where the noise is larger;
    additive noise changes the expected cost alone. The law's nominal part is rolled out on the true
    dynamics without noise, with k halved until the expected cost falls: the nominal cost plus what
    the noise adds along each candidate under the gains. Without noise its steps are `ILQR`'s. The
    state is known to the controller. Bounds hold the mean controls: that feedback is clipped there
    is not in the model.

    At its end k is zero: the law is optimal for the model around its own trajectory. The model
    leaves out how noise acts through the curvature of the dynamics (E f_xx dx dx/2) and through the
    change of the model along other trajectories. So the end need not be where the expected cost
    itself is stationary, and near it the two may disagree; then steps are taken that lower the
    gradient instead. If that ends in vain, the status says so, and the best pair of trajectory and
    gains that was met is returned.

    Arguments:
        gradient_tolerance, cost_tolerance, step_tolerance: as in `ILQR`.
    """

    second_order: ClassVar[bool] = False
    stochastic: ClassVar[bool] = True
    gradient_tolerance: float | None = eqx.field(static=True, default=None)
    cost_tolerance: float | None = eqx.field(static=True, default=None)
    step_tolerance: float | None = eqx.field(static=True, default=None)

    def expand(self, problem, xs, us, near):
        """Return the first-order model with the noise; `near` changes nothing."""
        return expand(problem, xs, us, noise=True)

    def law(self, model, damping, box, guess):
        """Return the law of the least expected cost on the model, its mean controls in the box."""
        return box_or_free_law(model, damping, box, guess, "sequential")

    def merit(self, problem, xs, us, law, model=None):
        """Return the expected cost under the law's gains, shape ().

        Where the model is not convex, far from a goal, noise would seem to earn something; there it
        counts as free.
        """
        cost = problem.total_cost(xs, us)
        if problem.noise is None:  # the law is ILQR's, however uncertain the start
            return cost
        model = self.expand(problem, xs, us, False) if model is None else model
        return cost + jnp.maximum(noise_cost(problem, model, law.K), 0.0)
