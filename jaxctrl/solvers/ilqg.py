"""The iterative linear-quadratic-Gaussian method: feedback that knows about the noise."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._local_model import expand
from .._prediction import noise_cost
from .._types import LocalModel
from ..linear import AffineLaw, Sweep
from ..linear._sensed import descend, price
from ..linear._stagewise import stagewise_lqr
from .shooting import AbstractShooting, box_or_free_law

MOST_SETS = 3
"""How often what is sensed is priced anew because other controls are held."""


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
    state is known to the controller, or, with a sensor, what that tells: then in each step the
    estimate takes the reading, the law du = k + K xhat acts, and law and filter are found in turn
    until each is the best for the other (Li 2006, section 5.4; Todorov 2005). The policy is an
    `OutputFeedback`. Bounds hold the mean controls: that feedback is clipped there is not in the
    model.

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

    def law(self, model, damping, box, guess, last):
        """Return the law of the least expected cost on the model, its mean controls in the box."""
        if model.sensing is None:
            return box_or_free_law(model, damping, box, guess, "sequential")
        first = AffineLaw(jnp.zeros_like(damping), last.K)
        if box is None:
            none = jnp.zeros_like(damping)
            priced = _priced(model, first, damping, none, none)
            return box_or_free_law(priced, damping, None, guess, "sequential")
        return _boxed_law(model, first, damping, box, guess)

    def merit(self, problem, xs, us, law, model=None):
        """Return the expected cost under the law's gains, shape ().

        Where the model is not convex, far from a goal, noise would seem to earn something; there it
        counts as free. With a sensor, that of the best filter for the law.
        """
        cost = problem.total_cost(xs, us)
        if problem.noise is None and problem.sensor is None:
            return cost  # the law is ILQR's, however uncertain the start
        model = self.expand(problem, xs, us, False) if model is None else model
        return cost + jnp.maximum(noise_cost(problem, model, law.K), 0.0)


def _priced(model: LocalModel, first: AffineLaw, damping, side, values) -> LocalModel:
    """Return the model of a known state whose law is the best one for what is sensed."""
    found = descend(model, first, damping, side, values)
    return price(model, found.gains, found.errors)


def _boxed_law(model: LocalModel, first: AffineLaw, damping, box, guess) -> tuple[Sweep, Array]:
    """Return the law of a sensed model in a box, as `AbstractShooting.law` does.

    What is held has no gains, on which the price of noise depends: both are found anew until the
    held set stays what it was; where it does not, each step's k is chosen in the box by itself.
    """

    def find(side):
        side = jnp.where(jnp.isnan(side), 0.0, side)
        priced = _priced(model, first, damping, side, jnp.where(side < 0, box[0], box[1]))
        return box_or_free_law(priced, damping, box, side, "sequential")

    def body(carry):
        _, side, _, count = carry
        sweep, found = find(side)
        same = (found == side).all() | ~sweep.ok | ~sweep.settled
        return sweep, found, same, count + 1

    def unfinished(carry):
        _, _, same, count = carry
        return ~same & (count < MOST_SETS)

    none = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), jax.eval_shape(find, guess)[0])
    start = (none, guess, jnp.array(False), jnp.array(0))
    sweep, side, same, _ = jax.lax.while_loop(unfinished, body, start)

    def apart():
        at_side = jnp.where(jnp.isnan(side), 0.0, side)
        at = jnp.where(at_side < 0, box[0], box[1])
        return stagewise_lqr(_priced(model, first, damping, at_side, at), box[0], box[1], damping)

    return jax.lax.cond(same, lambda: (sweep, side), apart)
