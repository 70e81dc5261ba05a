"""The ways to sweep a local model, by name."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array

from .._types import LocalModel
from . import _parallel, _riccati
from ._riccati import Held, Sweep


class Engine(NamedTuple):
    """The three computations that run along time, each with the signature of `_riccati`'s."""

    costates: Callable[[LocalModel], tuple[Array, Array]]
    lqr: Callable[..., Sweep]
    held_lqr: Callable[..., Held]


ENGINES = {
    "sequential": Engine(_riccati.costates, _riccati.lqr, _riccati.held_lqr),
    "parallel": Engine(_parallel.costates, _parallel.lqr, _parallel.held_lqr),
}
"""Results agree to round-off. "sequential" is one step after another, in O(T) time. "parallel"
has a depth of O(log T), for accelerators and long horizons; see `_parallel`."""


def find_engine(name: str) -> Engine:
    """Return the engine of that name; ValueError names the choices."""
    if name not in ENGINES:
        raise ValueError(f"sweep: one of {', '.join(map(repr, ENGINES))} is wanted, got {name!r}")
    return ENGINES[name]
