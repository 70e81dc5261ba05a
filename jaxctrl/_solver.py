"""What a solver is: an iteration, whose loop is `jaxctrl.solve`'s, or a single run."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, ArrayLike, Bool, Float

from ._problem import Problem
from ._status import Status


class Record(NamedTuple):
    """What is kept of each iteration: scalars, or arrays padded with NaN once stacked.

    Attributes:
        cost: the solver's cost of the iterate.
        gradient: its projected gradient, in the solver's relative measure (see `Tolerances`).
        step: the fraction of the search direction by which the iterate was reached; 0 when
            nothing was accepted.
        lam: the relative regularisation with which the next direction was computed.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, ""]
    step: Float[Array, ""]
    lam: Float[Array, ""]


class AbstractDirectSolver(eqx.Module):
    """A solver with a single `run` on the host instead of an iteration that can be traced."""

    @abc.abstractmethod
    def run(self, problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> Any:
        """Return the `Solution` from x0 (nx,), started from the controls us (T, nu).

        Raises TypeError when an argument is traced.
        """


class Found(NamedTuple):
    """Where an iteration has led.

    Attributes:
        xs, us: the trajectory, (T+1, nx) and (T, nu).
        K: the gains around it (T, nu, nx), those of the solver's `gains`.
        side: which controls are held at a bound, (T, nu): -1 the lower, 1 the upper, 0 neither,
            NaN where that is not known. Derivatives follow the bounds that are held.
        gradient: the projected gradient there, in the solver's relative measure.
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    side: Float[Array, "T nu"]
    gradient: Float[Array, ""]


class AbstractSolver(eqx.Module):
    """An iteration on a state that is a pytree; it holds parameters but no state of its own."""

    @property
    @abc.abstractmethod
    def stochastic(self) -> bool:
        """Whether it minimises the expected cost under the problem's noise, or the nominal one."""

    @abc.abstractmethod
    def init(self, problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> Any:
        """Return the state at the start, from x0 (nx,) under the controls us (T, nu)."""

    @abc.abstractmethod
    def step(self, problem: Problem, state: Any, last: Bool[ArrayLike, ""] = False) -> Any:
        """Return the state after one iteration; the first one measures the start.

        With `last` the iteration has ended: no step is taken, but the gains are made final.
        """

    @abc.abstractmethod
    def status(self, state: Any) -> Status:
        """Return `RUNNING`, or why the iteration ends."""

    @abc.abstractmethod
    def record(self, state: Any) -> Record:
        """Return the scalars to keep of this iteration, each of shape ()."""

    @abc.abstractmethod
    def near(self, state: Any) -> Array:
        """Tell whether the state is nearly converged; a boolean of shape ()."""

    @abc.abstractmethod
    def final(self, state: Any) -> Array:
        """Tell whether the gains are final as they are; a boolean of shape ()."""

    @abc.abstractmethod
    def found(self, problem: Problem, state: Any) -> Found:
        """Return the state's trajectory, xs (T+1, nx) and us (T, nu), and the gains around it."""

    @abc.abstractmethod
    def gains(
        self,
        problem: Problem,
        xs: Float[Array, "T+1 nx"],
        us: Float[Array, "T nu"],
        side: Float[Array, "T nu"],
    ) -> Float[Array, "T nu nx"]:
        """Return the gains (T, nu, nx) around xs (T+1, nx), us (T, nu), a function of these alone.

        `side` (T, nu) tells which controls are held at a bound, as in `Found`; their gains are
        zero. It is what derivatives of the policy are derivatives of.
        """
