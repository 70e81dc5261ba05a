"""What a movement costs: rates, residuals of steps, the end, and events between grid points."""

import abc
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, Int

from ._fields import check_numbers, check_shapes
from ._plant import AbstractPlant

OF = ("effort", "hand", "joints", "other")


class At(NamedTuple):
    """Hold what a term of the cost may look at in a step.

    Attributes:
        x, u: the state (nx,) and the control (nu,) at the beginning of the step.
        after: the state (nx,) at its end; None for rates, which do not see it.
        t: time [s]. i: number of the step, 0 to T - 1. dt: its length [s].
        s: the part of the movement that is over, i/T; unlike t it has no derivative by dt.
    """

    x: Float[Array, " nx"]
    u: Float[Array, " nu"]
    after: Float[Array, " nx"] | None
    t: Float[Array, ""]
    i: Int[Array, ""]
    dt: Float[Array, ""]
    s: Float[Array, ""]


class Events(NamedTuple):
    """Costs at given times: `value(plant, x, j)` of the state at `times[j]` (m,), in seconds.

    The state between two grid points is interpolated linearly, so that times and dt keep their
    gradients. `name` is what an error calls them.
    """

    times: Float[Array, " m"]
    value: Callable[[AbstractPlant, Array, Any], Array]
    name: str = "events"


class Term(NamedTuple):
    """A function of (plant, at), or of (plant, x) at the end, and what an error calls it."""

    value: Callable[..., Array]
    name: str


class Terms(NamedTuple):
    """Hold what a cost is the sum of.

    J = sum_k (dt rate_k + dt |residual_k|^2/2) + sum_j event_j(x(t_j)) + end(x_T)

    Attributes: rates and residuals of (plant, at), ends of (plant, x), and groups of events.
    """

    rates: tuple[Term, ...] = ()
    residuals: tuple[Term, ...] = ()
    ends: tuple[Term, ...] = ()
    events: tuple[Events, ...] = ()


class AbstractCost(eqx.Module):
    """A cost; they add: `cost_a + cost_b`. The plant is handed in at the call.

    A cost of your own is a subclass of one or several of its kinds, with their method:

    - `AbstractRate`: `rate(plant, at)`, a cost per second,
    - `AbstractResidual`: `residual(plant, at)`, whose half square is a cost per second,
    - `AbstractEnd`: `end(plant, x)`, a cost of the last state,
    - `AbstractEvents`: `times` and `event(plant, x, j)`, costs at times on the way.

        class Slowness(jc.AbstractRate):
            weight: jax.Array
            of = "joints"

            def rate(self, plant, at):
                n = plant.num_joints
                return self.weight * jnp.sum(at.x[n : 2 * n] ** 2)

        problem = task + Slowness(jnp.array(0.01))

    For a discrete plant, what is per second here is per step. A cost never keeps a plant, so that
    each physical parameter has one owner. A direct subclass may instead have `running(plant, x, u,
    t)`, `terminal(plant, x)` and a property `events`, a tuple of `Events`, all three.

    A cost may have besides: `check(plant)` and `check_start(plant, x0)`, which raise ValueError for
    a plant or a start that does not fit; and `marks`, which plots show (`jc.tasks.Marks`).

    Attributes:
        of: what it is a cost of, for optimality models: they put their own in the place of the
            "effort" and keep all else. A model without an arm keeps what is of the "hand", asking
            for nothing else of the plant; drops what is of the "joints", prices that are no goals;
            and refuses all "other".
    """

    of: ClassVar[str] = "other"

    def __check_init__(self):
        if self.of not in OF:
            raise ValueError(f"{type(self).__name__}.of: one of {OF} is wanted, got {self.of!r}")
        check_numbers(self)

    def __add__(self, other: "AbstractCost") -> "SumCost":
        """Return the sum of two costs."""
        if not isinstance(other, AbstractCost):
            return NotImplemented
        return SumCost(parts=(self, other))  # pyright: ignore[reportCallIssue]


class AbstractRate(AbstractCost):
    """A cost per second, sum_k dt rate_k."""

    @abc.abstractmethod
    def rate(self, plant: Any, at: At) -> Float[Array, ""]:
        """Return the cost per second (per step for a discrete plant), shape (); `at.after` is None.

        For `BoundaryValue`, `at.t` may lie between two grid points, and `at.i` is their step.
        """


class AbstractResidual(AbstractCost):
    """A cost of what changes over each step, such as a torque: dt |rho_k|^2/2 for every k.

    A rate of change written as a derivative at x_k would miss what happens within the step, and an
    optimisation finds that: muscles whose force is flat at no activation would be switched on and
    off for nothing. As sums of squares these costs have a Gauss-Newton Hessian, which `ILQR` takes;
    `DDP` and all derivatives take the exact one.
    """

    @abc.abstractmethod
    def residual(self, plant: Any, at: At) -> Float[Array, " m"]:
        """Return rho, shape (m,), of the step from `at.x` under `at.u` to `at.after`."""


class AbstractEnd(AbstractCost):
    """A cost of the last state."""

    @abc.abstractmethod
    def end(self, plant: Any, x: Float[Array, " nx"]) -> Float[Array, ""]:
        """Return the cost of the last state x (nx,), shape ()."""


class AbstractEvents(AbstractCost):
    """Costs of the state at given times, interpolated linearly between the grid points.

    Attributes:
        times: t_j [s], shape (m,); `optimise_times` may change them.
    """

    times: eqx.AbstractVar[Float[Array, " m"]]

    @abc.abstractmethod
    def event(self, plant: Any, x: Float[Array, " nx"], j: Int[Array, ""]) -> Float[Array, ""]:
        """Return the cost of the state x (nx,) at `times[j]`, shape ()."""

    def with_times(self, times: Float[Array, " m"]) -> "AbstractEvents":
        """Return the same cost at other times (m,) [s]."""
        return eqx.tree_at(lambda cost: cost.times, self, times)


class AbstractCompound(AbstractCost):
    """A cost that is made of others, such as their sum.

    Attributes:
        parts: the costs of which it is the sum, each of one thing (`of`); (self,) if of none.
    """

    parts: eqx.AbstractVar[tuple[AbstractCost, ...]]

    @property
    @abc.abstractmethod
    def terms(self) -> Terms:
        """What it is the sum of, made from `jc.terms(cost)` of the others."""


class SumCost(AbstractCompound):
    """The sum of several costs, given as a tuple."""

    parts: tuple[AbstractCost, ...]

    @property
    def terms(self) -> Terms:
        """The terms of all parts, in order."""
        return _join(*(terms(part) for part in self.parts))


def _join(*several: Terms) -> Terms:
    return Terms(*(sum(tuples, ()) for tuples in zip(*several, strict=True)))


def parts(cost: AbstractCost) -> tuple[AbstractCost, ...]:
    """Return the costs of which a cost is the sum, in order; itself alone if it is none."""
    own = cost.parts if isinstance(cost, AbstractCompound) else (cost,)
    if len(own) == 1 and own[0] is cost:
        return own
    return tuple(found for part in own for found in parts(part))


KINDS = {
    "rate": AbstractRate,
    "residual": AbstractResidual,
    "end": AbstractEnd,
    "event": AbstractEvents,
}


def terms(cost: AbstractCost) -> Terms:
    """Return what a cost is the sum of, as functions.

    Raises TypeError for a cost with methods that are not those which `AbstractCost` names.
    """
    if isinstance(cost, AbstractCompound):
        return cost.terms
    name = type(cost).__name__
    for method, kind in KINDS.items():
        if hasattr(cost, method) and not isinstance(cost, kind):
            raise TypeError(f"cost: for {name}.{method} to count, derive from jc.{kind.__name__}")
    old = [method for method in ("running", "terminal", "events") if hasattr(cost, method)]
    if len(old) in (1, 2) or not (old or isinstance(cost, tuple(KINDS.values()))):
        raise TypeError(
            f"cost: {name} wants the methods running, terminal and events, and has "
            f"{' and '.join(old) or 'none'}; or derive it from some of "
            + ", ".join(f"jc.{kind.__name__}" for kind in KINDS.values())
        )
    found = Terms(
        (Term(cost.rate, f"{name}.rate"),) if isinstance(cost, AbstractRate) else (),
        (Term(cost.residual, f"{name}.residual"),) if isinstance(cost, AbstractResidual) else (),
        (Term(cost.end, f"{name}.end"),) if isinstance(cost, AbstractEnd) else (),
        (Events(cost.times, cost.event, f"{name}.event"),)
        if isinstance(cost, AbstractEvents)
        else (),
    )
    return _join(found, _plain(cost, name)) if old else found


def _plain(cost: Any, name: str) -> Terms:
    """Return the terms of a cost that has `running`, `terminal` and `events`."""
    return Terms(
        (Term(lambda plant, at: cost.running(plant, at.x, at.u, at.t), f"{name}.running"),),
        (),
        (Term(cost.terminal, f"{name}.terminal"),),
        tuple(Events(times, value, f"{name}'s event") for times, value, *_ in cost.events),
    )


def check(cost: AbstractCost, plant: AbstractPlant) -> None:
    """Raise ValueError, naming the field, for a number of a cost that does not fit the plant."""
    for part in parts(cost):
        check_shapes(part, plant)
        check_numbers(part)
        if hasattr(part, "check"):
            part.check(plant)  # pyright: ignore[reportAttributeAccessIssue]
