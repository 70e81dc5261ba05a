"""How much a law is damped, from one step to the next."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

LAM_FIRST, LAM_MIN, LAM_MAX = 1e-6, 1e-9, 1e10
LAM_FACTOR = 1.6
LAM_SURE = 1e-3
LONG, SHORT = 0.5, 0.07


def adapt(
    lam: Float[Array, ""],
    factor: Float[Array, ""],
    fraction: Float[Array, ""],
    wanted: Bool[Array, ""],
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return lambda and its factor, adapted if wanted, faster each time in the same direction.

    A long accepted step lowers it. A rejected one raises it, and so does a short one: there the
    linear model holds only nearby, and a more regular direction goes further (Tassa et al. 2012).

    Arguments: the present two, and the fraction of the step that was accepted, 0 for none.
    """
    good, bad = fraction >= LONG, fraction <= SHORT
    down = jnp.minimum(1 / LAM_FACTOR, factor / LAM_FACTOR)
    up = jnp.maximum(LAM_FACTOR, factor * LAM_FACTOR)
    lower = lam * down
    lower = jnp.where(lower < LAM_MIN, 0.0, lower)
    higher = jnp.maximum(lam * up, LAM_FIRST)
    after = jnp.where(good, lower, jnp.where(bad, higher, lam))
    faster = jnp.where(good, down, jnp.where(bad, up, 1.0))
    return jnp.where(wanted, after, lam), jnp.where(wanted, faster, factor)
