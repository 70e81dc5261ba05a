"""Physical parameters: arrays with a gradient, checked wherever their values can be known."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._types import array_leaf


def parameter(
    name: str, value: ArrayLike, shape: tuple[int, ...] = (), *, minimum: float | None = None
) -> Array:
    """Return `value` as a floating array broadcast to `shape`.

    Raises ValueError, naming the argument, for another shape than () or `shape`, and for a known
    value that is not finite or below `minimum`. The value of a tracer is not known.
    """
    array = array_leaf(value)
    if array.shape not in ((), shape):
        raise ValueError(f"{name}: shape {array.shape}, wanted {wanted(shape)}")
    numbers = known(value)
    if numbers is not None:
        if not np.isfinite(numbers).all():
            raise ValueError(f"{name}: finite numbers are wanted, got {value}")
        if minimum is not None and (numbers < minimum).any():
            raise ValueError(f"{name}: at least {minimum:g} is wanted, got {value}")
    return jnp.broadcast_to(array, shape)


def positive(name: str, value: ArrayLike, shape: tuple[int, ...] = ()) -> Array:
    """Return `value` as `parameter` does.

    Raises ValueError, naming the argument, where a known value is not above zero.
    """
    numbers = known(value)
    if numbers is not None and not (numbers > 0).all():
        raise ValueError(f"{name}: positive numbers are wanted, got {value}")
    return parameter(name, value, shape)


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
    part, numbers = state_part(name, value, leaf, shape), known(value)
    if numbers is not None and (np.abs(numbers) > 4 * np.pi).any():
        raise ValueError(f"{name}: {value} is more than two turns; are these radians?")
    return part


def wanted(shape: tuple[int, ...]) -> str:
    """Write the shapes that `parameter` accepts."""
    return "()" if shape == () else f"() or {shape}"


def known(*values: ArrayLike) -> np.ndarray | None:
    """Return the values as one NumPy array, or None when one of them is a tracer or no number."""
    try:
        return np.asarray(values[0] if len(values) == 1 else values, dtype=float)
    except (TypeError, ValueError):  # what JAX raises for tracers; what is no number fails later
        return None


def like(value: ArrayLike, leaf: Float[Array, "..."]) -> Array:
    """Return `value` as an array whose dtype is that of a plant's leaf, or wider if it is wider.

    Python numbers, alone or in lists, take the leaf's dtype.
    """
    dtype = getattr(value, "dtype", leaf.dtype)
    return jnp.asarray(value, jnp.result_type(dtype, leaf.dtype))
