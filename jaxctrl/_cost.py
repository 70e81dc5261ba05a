"""Costs for any plant: plain functions, and quadratic ones."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._function import as_params, check_function
from ._terms import AbstractCost, Events
from ._types import array_leaf, leaf


class FunctionCost(AbstractCost):
    """A cost made of plain functions, without a class.

    `running(x, u, t)` is a rate per second, `terminal(x)` a value, `event(x, i)` the cost of the
    state at `event_times[i]`; x has shape (nx,), u has shape (nu,). With `params`, each function
    takes it as its last argument. What a function depends on is treated as in `FunctionPlant`;
    `event_times` are an array leaf too.

    Arguments:
        running, terminal, event: the functions above, or None.
        event_times: times of the events [s], shape (m,); wanted exactly when `event` is given.
        params: as in `FunctionPlant`.
    """

    _running: Callable | None
    _terminal: Callable | None
    _event: Callable | None
    params: Any = eqx.field(converter=as_params)
    event_times: Float[Array, " m"]

    def __init__(
        self,
        running: Callable | None = None,
        terminal: Callable | None = None,
        *,
        event: Callable | None = None,
        event_times: ArrayLike = (),  # pyright: ignore[reportArgumentType]
        params: Any = None,
    ):
        times = array_leaf(event_times, "event_times")
        if times.ndim != 1 or (times.size > 0) != (event is not None):
            raise ValueError(
                "event_times: an array of shape (m,), m > 0, is wanted together with `event`, got "
                f"shape {times.shape} and event={event!r}"
            )
        self._running = None if running is None else check_function("running", running)
        self._terminal = None if terminal is None else check_function("terminal", terminal)
        self._event = None if event is None else check_function("event", event)
        self.params = as_params(params)
        self.event_times = times

    def _call(self, function, *args):
        if function is None:
            return jnp.zeros((), args[0].dtype)
        return function(*args) if self.params is None else function(*args, self.params)

    def running(self, plant, x, u, t):
        """Return running(x, u, t[, params]), shape ()."""
        return self._call(self._running, x, u, t)

    def terminal(self, plant, x):
        """Return terminal(x[, params]), shape ()."""
        return self._call(self._terminal, x)

    @property
    def events(self):
        """The one group of events, if any; its times have shape (m,) in seconds."""
        if self._event is None:
            return ()
        return (Events(self.event_times, lambda plant, x, i: self._call(self._event, x, i)),)


class QuadraticCost(AbstractCost):
    """Quadratic cost (x-x*)'Q(x-x*)/2 + u'R u/2 per second and (x-x*)'Qf(x-x*)/2 at the end.

    Weights are scalars (times the identity), vectors (a diagonal) or matrices; only their
    symmetric part counts. All are array leaves.

    Arguments:
        Q, Qf: weights of the state, running [1/s] and terminal; scalar, (nx,) or (nx, nx).
        R: weight of the control [1/s]; scalar, (nu,) or (nu, nu).
        target: x*, scalar or shape (nx,).
    """

    Q: Array = eqx.field(converter=leaf("Q"), default=0.0)
    R: Array = eqx.field(converter=leaf("R"), default=0.0)
    Qf: Array = eqx.field(converter=leaf("Qf"), default=0.0)
    target: Array = eqx.field(converter=leaf("target"), default=0.0)

    def running(self, plant, x, u, t):
        """Return (x-x*)'Q(x-x*)/2 + u'R u/2, shape ()."""
        return quadratic_form(self.Q, self._offset(x), "Q") + quadratic_form(self.R, u, "R")

    def terminal(self, plant, x):
        """Return (x-x*)'Qf(x-x*)/2, shape ()."""
        return quadratic_form(self.Qf, self._offset(x), "Qf")

    def _offset(self, x):
        if self.target.shape not in ((), x.shape):
            raise ValueError(f"target: shape {self.target.shape}, wanted () or {x.shape}")
        return x - self.target

    @property
    def events(self):
        """None."""
        return ()


def quadratic_form(weight: Array, v: Float[Array, " n"], name: str = "weight") -> Float[Array, ""]:
    """Return v'Wv/2 for a weight that is a scalar, a diagonal (n,) or a matrix (n, n).

    Raises ValueError, naming the weight, for any other shape.
    """
    n = v.shape[0]
    if weight.shape in ((), (n,)):
        return 0.5 * jnp.sum(weight * v * v)
    if weight.shape == (n, n):
        return 0.5 * v @ weight @ v
    raise ValueError(f"{name}: shape {weight.shape}, wanted (), ({n},) or ({n}, {n})")
