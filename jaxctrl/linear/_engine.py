"""The ways to sweep a local model, by name."""

from collections.abc import Callable
from typing import NamedTuple

from jaxtyping import Array, ArrayLike, Float

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


def lqr(
    model: LocalModel,
    damping: ArrayLike | Float[Array, "T nu"] = 0.0,
    *,
    engine: str = "sequential",
) -> Sweep:
    """Minimise a local model's cost by a Riccati sweep.

        V_k(dx) = min_du l_k + V_{k+1}(fx dx + fu du),    du = k + K dx

    Damping d >= 0 adds sum_ki d_ki du_ki^2 / 2 to the model (Levenberg and Marquardt).

    Arguments:
        model: local expansion; every array but the last two leads with time.
        damping: d, scalar or (T, nu) [cost per control unit squared].
        engine: "sequential", or "parallel" in time (Sarkka & Garcia-Fernandez 2023), which gives
            the same result, is made for accelerators and has no reverse-mode derivative.

    Returns: `Sweep`.

    Raises: ValueError for an unknown engine.
    """
    return find_engine(engine).lqr(model, damping)
