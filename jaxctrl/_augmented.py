"""A plant with more state or control than the body in it, and what that body costs."""

import abc
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ._plant import AbstractHand, AbstractPlant, nominal_control
from ._terms import AbstractCompound, AbstractCost, At, Events, Term, Terms, check, parts, terms


class AbstractAugmented(AbstractPlant):
    """A plant around another, whose states or controls it adds to, delays or leaves to the optimum.

    Attributes:
        inner: the plant inside.
    """

    inner: eqx.AbstractVar[Any]

    @abc.abstractmethod
    def split(
        self, x: Float[Array, " nx"], u: Float[Array, " nu"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Return the state (n,) and the control (m,) of the plant inside, for x (nx,) and u (nu,).

        Its state does not depend on u.
        """

    @abc.abstractmethod
    def lift(self, x: Float[Array, " n"]) -> Float[Array, " nx"]:
        """Return the state (nx,) in which to start, for a state x (n,) of the plant inside."""


class AbstractAugmentedHand(AbstractAugmented, AbstractHand):
    """An augmented plant whose hand is that of the plant inside."""

    @property
    def dim(self) -> int:
        """That of the hand inside, 2 or 3."""
        return self.inner.dim

    @property
    def longest_reach(self) -> Float[Array, ""]:
        """That of the plant inside [m], shape ()."""
        return self.inner.longest_reach

    def hand(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the position of the hand [m], shape (2,), at a state x (nx,)."""
        return self.inner.hand(_inner_state(self, x))

    def hand_velocity(self, x: Float[Array, " nx"]) -> Float[Array, "2"]:
        """Return the velocity of the hand [m/s], shape (2,), at a state x (nx,)."""
        return self.inner.hand_velocity(_inner_state(self, x))


def innermost(plant: Any, x, u) -> tuple[Any, Array, Array]:
    """Return the body inside all augmented plants, with its state and control, at x and u."""
    while isinstance(plant, AbstractAugmented):
        (x, u), plant = plant.split(x, u), plant.inner
    return plant, x, u


class OfInner(AbstractCompound):
    """A cost of the plant inside an `AbstractAugmented` one: of its state and control alone.

    Arguments:
        cost: any, as it is written for the plant inside.
    """

    cost: AbstractCost

    @property
    def of(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What the cost is of; "other" for a sum of different ones."""
        found = {part.of for part in parts(self.cost)}
        return found.pop() if len(found) == 1 else "other"

    @property
    def parts(self) -> tuple[AbstractCost, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """One for each part of the cost."""
        inside = parts(self.cost)
        if len(inside) == 1:
            return (self,)
        return tuple(OfInner(part) for part in inside)  # pyright: ignore[reportCallIssue]

    @property
    def terms(self) -> Terms:
        """The terms of the cost, called with the plant, states and controls inside."""

        def at_inner(plant: Any, at: At) -> At:
            x, u = plant.split(at.x, at.u)
            after = None if at.after is None else plant.split(at.after, at.u)[0]
            return at._replace(x=x, u=u, after=after)

        def step(term: Term) -> Term:
            return Term(lambda plant, at: term.value(plant.inner, at_inner(plant, at)), term.name)

        def state(value):
            return lambda plant, x, *j: value(plant.inner, _inner_state(plant, x), *j)

        found = terms(self.cost)
        return Terms(
            tuple(step(term) for term in found.rates),
            tuple(step(term) for term in found.residuals),
            tuple(Term(state(term.value), term.name) for term in found.ends),
            tuple(Events(group.times, state(group.value), group.name) for group in found.events),
        )

    @property
    def marks(self) -> Any:
        """Those of the cost, or None."""
        return getattr(self.cost, "marks", None)

    def check(self, plant: Any) -> None:
        """Raise TypeError for a plant with none inside, ValueError where the cost does not fit."""
        if not isinstance(plant, AbstractAugmented):
            raise TypeError(f"cost: OfInner wants an augmented plant, got {type(plant).__name__}")
        check(self.cost, plant.inner)

    def check_start(self, plant: Any, x0: Float[Array, " nx"]) -> None:
        """Raise ValueError for a start x0 (nx,) that the cost cannot allow."""
        for part in parts(self.cost):
            if (check_start := getattr(part, "check_start", None)) is not None:
                check_start(plant.inner, _inner_state(plant, x0))


def _inner_state(plant: AbstractAugmented, x):
    return plant.split(x, nominal_control(plant))[0]
