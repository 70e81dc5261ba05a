"""The roll-out of a law on the true dynamics."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._controller import clip
from .._linalg import matmul
from .._problem import Problem
from .._types import Bounds


def rollout_law(
    problem: Problem,
    xs: Float[Array, "T+1 nx"],
    us: Float[Array, "T nu"],
    k: Float[Array, "T nu"],
    K: Float[Array, "T nu nx"],
    bounds: Bounds | None,
    side: Float[Array, "T nu"] | None = None,
) -> tuple[Float[Array, "T+1 nx"], Float[Array, "T nu"]]:
    """Roll out u = clip(u_nominal + k + K (x - x_nominal)) on the true dynamics.

    Where `side` (T, nu) is -1 or 1 the control is the bound itself, to the last digit.

    Returns: states (T+1, nx) and controls (T, nu).
    """

    def body(x, inputs):
        x_nominal, u_nominal, k, K, t, bound, side = inputs
        u = clip(u_nominal + k + matmul(K, x - x_nominal), bound)
        if side is not None:
            u = jnp.where(side < 0, bound[0], jnp.where(side > 0, bound[1], u))
        after = problem.step(x, u, t)
        return after, (after, u)

    inputs = (xs[:-1], us, k, K, problem.ts[:-1], bounds, None if bounds is None else side)
    _, (new_xs, new_us) = jax.lax.scan(body, xs[0], inputs)
    return jnp.concatenate([xs[:1], new_xs]), new_us
