"""What every public function asks of its arguments: arrays of a shape, finite where known."""

from collections.abc import Callable

import jax.core
import numpy as np
from jaxtyping import Array, ArrayLike

from ._types import array_leaf


def is_concrete(*arrays) -> bool:
    """Tell whether no array is a tracer, so that its values may be looked at."""
    return not any(isinstance(array, jax.core.Tracer) for array in arrays)


def check_array(name: str, value: ArrayLike, shape: tuple[int, ...], hint: str = "") -> Array:
    """Return `value` as a floating array of `shape`, finite where that can be known.

    Raises ValueError (shape, non-finite) or TypeError (complex), naming the argument.
    """
    if value is None or (isinstance(value, Callable) and not hasattr(value, "shape")):
        kind = "None" if value is None else f"the function {value!r}"
        raise TypeError(f"{name}: an array of shape {shape} is wanted, got {kind}")
    try:
        array = array_leaf(value)
    except TypeError as error:
        raise TypeError(f"{name}: {error}") from None
    if array.shape != shape:
        raise ValueError(
            f"{name}: got shape {array.shape}, wanted {shape}" + (hint and f"; {hint}")
        )
    if is_concrete(array) and not np.isfinite(np.asarray(array)).all():
        bad = np.argwhere(~np.isfinite(np.asarray(array)))[0]
        raise ValueError(f"{name}: not finite at index {tuple(int(i) for i in bad)}")
    return array
