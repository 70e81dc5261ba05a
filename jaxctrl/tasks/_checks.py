"""What every task asks of its arguments."""

import numpy as np
from jaxtyping import Array, ArrayLike

from .._checks import check_integer, is_concrete
from .._plant import AbstractHand, AbstractPlant
from .._types import array_leaf

STEP = 0.01
"""The time step [s] aimed at when `num_steps` is not given."""
LONGEST = 100.0
"""The longest duration of one movement [s]: what is longer can only be milliseconds."""


def grid(
    duration: ArrayLike, num_steps: int | None, longest: float = LONGEST
) -> tuple[int, ArrayLike]:
    """Return the number of steps and the time step [s].

    Raises ValueError or TypeError naming `duration` or `num_steps`; a known duration above
    `longest` [s] is refused.
    """
    shape = array_leaf(duration, "duration").shape
    if shape != ():
        raise ValueError(f"duration: got shape {shape}, wanted ()")
    concrete = is_concrete(duration)
    seconds = float(np.asarray(duration)) if concrete else STEP  # jnp would trace it, under jit
    if not 0 < seconds < np.inf:
        raise ValueError(f"duration: a positive time [s] is wanted, got {duration}")
    if seconds > longest:
        raise ValueError(
            f"duration: {seconds:g} s, longer than the {longest:g} s that such a movement may "
            "last; are these seconds, or milliseconds?"
        )
    if num_steps is not None:
        num_steps = check_integer("num_steps", num_steps, 1)
    elif concrete:
        num_steps = max(1, round(seconds / STEP))
    else:
        raise ValueError(
            "num_steps: wanted when `duration` is traced (under jit, grad or vmap), since "
            "the number of steps is static"
        )
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
