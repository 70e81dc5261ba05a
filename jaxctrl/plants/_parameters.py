"""Physical parameters: arrays with a gradient, checked wherever their values can be known."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._checks import (
    check_radians,
    known as known,
    parameter as parameter,
    positive as positive,
)


def state_part(
    name: str, value: ArrayLike, leaf: Float[Array, "..."], shape: tuple[int, ...] = ()
) -> Array:
    """Return a part of a state, broadcast to `shape`, in the dtype that `like` gives it.

    Raises ValueError, naming the argument, for a wrong shape or a known value that is not finite.
    """
    parameter(name, value, shape)
    return jnp.broadcast_to(like(value, leaf), shape)


def radians(
    name: str, value: ArrayLike, leaf: Float[Array, "..."], shape: tuple[int, ...] = ()
) -> Array:
    """Return angles of a state at rest [rad] as `state_part` does.

    Raises ValueError, naming the argument, where one is known to be beyond two turns.
    """
    part = state_part(name, value, leaf, shape)
    check_radians(name, value)
    return part


def like(value: ArrayLike, leaf: Float[Array, "..."]) -> Array:
    """Return `value` as an array whose dtype is that of a plant's leaf, or wider if it is wider.

    Python numbers, alone or in lists, take the leaf's dtype.
    """
    dtype = getattr(value, "dtype", leaf.dtype)
    return jnp.asarray(value, jnp.result_type(dtype, leaf.dtype))
