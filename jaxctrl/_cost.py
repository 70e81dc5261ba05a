"""What a movement costs: a rate, a terminal value, and events at times between the grid points."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._function import as_params, check_function
from ._plant import AbstractPlant
from ._types import array_leaf, leaf


class Events(NamedTuple):
    """Costs at given times: `value(plant, x, i)` of the state at `times[i]` (m,), in seconds.

    The state between two grid points is interpolated linearly, so that times and dt keep their
    gradients.
    """

    times: Float[Array, " m"]
    value: Callable[[AbstractPlant, Array, Any], Array]


class AbstractCost(eqx.Module):
    """A running rate, a terminal value and events; the plant is handed in at the call.

    J = terminal(x_T) + sum_k dt running(x_k, u_k, t_k) + sum_i event_i(x(t_i)); for a discrete
    plant `running` is a cost per step, without the dt. A cost never keeps a plant, so that each
    physical parameter has one owner. Costs add: `cost_a + cost_b`. A cost may have a method
    `check_start(plant, x0)` that raises ValueError for a start which it cannot allow; `solve` calls
    it where x0 is known.

    Attributes:
        running_is_quadratic: whether the Hessian of `running` in (x, u) is the same everywhere;
            then it is evaluated once and not along the trajectory.
        terminal_is_quadratic: the same for `terminal`.
    """

    running_is_quadratic: eqx.AbstractVar[bool]
    terminal_is_quadratic: eqx.AbstractVar[bool]

    @abc.abstractmethod
    def running(
        self, plant: AbstractPlant, x: Float[Array, " nx"], u: Float[Array, " nu"], t: ArrayLike
    ) -> Float[Array, ""]:
        """Return the cost per second (per step for a discrete plant) at state x and control u."""

    @abc.abstractmethod
    def terminal(self, plant: AbstractPlant, x: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return the cost of the last state x, shape ()."""

    @property
    @abc.abstractmethod
    def events(self) -> tuple[Events, ...]:
        """The groups of events, possibly none; their times have shape (m,) in seconds."""

    def __add__(self, other: "AbstractCost") -> "SumCost":
        """Return the sum of two costs."""
        if not isinstance(other, AbstractCost):
            return NotImplemented
        return SumCost(parts=(self, other))  # pyright: ignore[reportCallIssue]


class SumCost(AbstractCost):
    """The sum of several costs, given as a tuple."""

    parts: tuple[AbstractCost, ...]

    @property
    def running_is_quadratic(self) -> bool:
        """Whether every part's rate is quadratic."""
        return all(part.running_is_quadratic for part in self.parts)

    @property
    def terminal_is_quadratic(self) -> bool:
        """Whether every part's terminal value is quadratic."""
        return all(part.terminal_is_quadratic for part in self.parts)

    def running(self, plant, x, u, t):
        """Return the sum of the rates, shape ()."""
        return sum((part.running(plant, x, u, t) for part in self.parts), jnp.zeros((), x.dtype))

    def terminal(self, plant, x):
        """Return the sum of the terminal values, shape ()."""
        return sum((part.terminal(plant, x) for part in self.parts), jnp.zeros((), x.dtype))

    @property
    def events(self):
        """All parts' groups of events; their times have shape (m,) in seconds."""
        return tuple(group for part in self.parts for group in part.events)


class AbstractStepCost(AbstractCost):
    """A cost of what changes over each step, such as a torque: dt |rho_k|^2/2 for every k.

    rho_k = residual(plant, x_k, u_k, x_{k+1}, dt). A rate of change written as a derivative at x_k
    would miss what happens within the step, and an optimisation finds that: muscles whose force is
    flat at no activation would be switched on and off for nothing. As sums of squares these costs
    have a Gauss-Newton Hessian, which `ILQR` takes; `DDP` and all derivatives take the exact one.
    For a discrete plant the cost of a step is |rho_k|^2/2.
    """

    @abc.abstractmethod
    def residual(
        self,
        plant: AbstractPlant,
        x: Float[Array, " nx"],
        u: Float[Array, " nu"],
        after: Float[Array, " nx"],
        dt: Float[Array, ""],
    ) -> Float[Array, " m"]:
        """Return rho, shape (m,), of a step from x (nx,) under u (nu,) to `after` (nx,)."""


def parts(cost: AbstractCost) -> tuple[AbstractCost, ...]:
    """Return the costs of which a cost is the sum, in order; itself alone if it is none."""
    if not isinstance(cost, SumCost):
        return (cost,)
    return tuple(found for part in cost.parts for found in parts(part))


def step_costs(cost: AbstractCost) -> tuple[AbstractStepCost, ...]:
    """Return the parts of a cost that are costs of steps, in order."""
    return tuple(part for part in parts(cost) if isinstance(part, AbstractStepCost))


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
        running_is_quadratic, terminal_is_quadratic: see `AbstractCost`; a wrong claim makes the
            solver slow or fail, never the cost wrong.
    """

    _running: Callable | None
    _terminal: Callable | None
    _event: Callable | None
    params: Any
    event_times: Float[Array, " m"]
    running_is_quadratic: bool = eqx.field(static=True)
    terminal_is_quadratic: bool = eqx.field(static=True)

    def __init__(
        self,
        running: Callable | None = None,
        terminal: Callable | None = None,
        *,
        event: Callable | None = None,
        event_times: ArrayLike = (),  # pyright: ignore[reportArgumentType]
        params: Any = None,
        running_is_quadratic: bool = False,
        terminal_is_quadratic: bool = False,
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
        self.running_is_quadratic = bool(running_is_quadratic or running is None)
        self.terminal_is_quadratic = bool(terminal_is_quadratic or terminal is None)

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
    running_is_quadratic: bool = eqx.field(static=True, default=True, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

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
