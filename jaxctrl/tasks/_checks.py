"""What every task asks of its arguments."""

import numpy as np
from jaxtyping import Array, ArrayLike

from .._checks import is_concrete
from .._plant import AbstractHand, AbstractPlant
from .._types import array_leaf

STEP = 0.01
"""The time step [s] aimed at when `num_steps` is not given."""


def grid(duration: ArrayLike, num_steps: int | None) -> tuple[int, ArrayLike]:
    """Return the number of steps and the time step [s]."""
    if num_steps is None:
        if not is_concrete(duration):
            raise ValueError(
                "num_steps: wanted when `duration` is traced (under jit, grad or vmap), since "
                "the number of steps is static"
            )
        if np.shape(duration) != ():
            raise ValueError(f"duration: got shape {np.shape(duration)}, wanted ()")
        seconds = float(np.asarray(duration))  # jnp would trace it, under jit
        if not 0 < seconds < np.inf:
            raise ValueError(f"duration: a positive time [s] is wanted, got {duration}")
        num_steps = max(1, round(seconds / STEP))
    elif num_steps < 1:
        raise ValueError(f"num_steps: at least 1 is wanted, got {num_steps}")
    return num_steps, duration / num_steps


def check_hand(plant: AbstractPlant) -> AbstractHand:
    if not isinstance(plant, AbstractHand):
        hint = f"{plant.__name__}: write it with ()" if isinstance(plant, type) else ""
        raise TypeError(f"plant: one with a hand is wanted, got {hint or type(plant).__name__}")
    return plant


def check_reach(plant: AbstractHand, name: str, points: Array) -> None:
    """Raise ValueError, naming the argument, when points (..., 2) are known to be out of reach."""
    longest = plant.longest_reach
    if not is_concrete(points, longest):
        return
    farthest = float(np.linalg.norm(np.asarray(points), axis=-1).max())
    if farthest > float(np.asarray(longest)) * (1 + 1e-6):
        raise ValueError(
            f"{name}: {farthest:.4g} m from the origin, but the hand reaches no further than "
            f"{float(np.asarray(longest)):.4g} m; are these metres?"
        )


def check_weights(**weights: ArrayLike | None) -> None:
    """Raise ValueError or TypeError, naming the argument, for a weight known to be negative."""
    for name, value in weights.items():
        if value is None:
            continue
        try:
            value = array_leaf(value)
        except TypeError as error:
            raise TypeError(f"{name}: {error}") from None
        if is_concrete(value) and not (np.asarray(value) >= 0).all():
            raise ValueError(f"{name}: at least 0 is wanted, got {value}")
