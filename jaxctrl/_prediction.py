"""What a policy is expected to cost, and how its movement varies, by a problem's local model."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._problem import Problem
from ._types import LocalModel
from .linear._covariance import covariances
from .linear._moments import AffineLaw
from .linear._riccati import evaluate
from .linear._sensed import Forecast, forecast


class Prediction(eqx.Module):
    """Means and covariances of a movement under a policy, by the model around its nominal one.

    Exact for a linear plant with quadratic costs and no bounds; elsewhere to first order in the
    noise's variance. That controls are clipped at their bounds is not in the model: where feedback
    would often leave them, trials cost and scatter more than predicted (`jc.evaluate` tells).

    Attributes:
        xs, us: means, shapes (T+1, nx) and (T, nu): the nominal movement.
        x_cov: covariances of the states, shape (T+1, nx, nx).
        u_cov: covariances of the controls, shape (T, nu, nu).
        error_cov: with a sensor those of the estimate's errors, shape (T+1, nx, nx); or None.

    Under vmap all have a leading batch axis.
    """

    xs: Float[Array, "*batch T+1 nx"]
    us: Float[Array, "*batch T nu"]
    x_cov: Float[Array, "*batch T+1 nx nx"]
    u_cov: Float[Array, "*batch T nu nu"]
    error_cov: Float[Array, "*batch T+1 nx nx"] | None = None


def noise_cost(problem: Problem, model: LocalModel, K: Float[Array, "T nu nx"]) -> Float[Array, ""]:
    """Return what noise and an uncertain start add to the expected cost under gains K, shape ().

    With a sensor the gains act on the estimate of the best filter for them.

    Arguments: the problem, its model with noise, and the gains (T, nu, nx).
    """
    still = jnp.zeros_like(model.lu)
    if model.sensing is not None:
        return forecast(model, AffineLaw(still, K)).cost
    value = evaluate(model, still, K)
    if problem.x0_cov is None:
        return value.v
    return value.v + 0.5 * jnp.sum(value.vxx * problem.x0_cov)


def predict(
    problem: Problem,
    model: LocalModel,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
) -> Prediction:
    """Return the moments of a movement xs (T+1, nx), us (T, nu) under gains K (T, nu, nx)."""
    nx = xs.shape[1]
    start = jnp.zeros((nx, nx), xs.dtype) if problem.x0_cov is None else problem.x0_cov
    return Prediction(xs, us, *covariances(model, K, start))


def foresee(
    model: LocalModel,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
) -> tuple[Prediction, Forecast]:
    """Return the same with a sensor, the gains acting on a filter's estimate, and that filter."""
    found = forecast(model, AffineLaw(jnp.zeros_like(us), K))
    return Prediction(xs, us, found.x_cov, found.u_cov, found.error), found
