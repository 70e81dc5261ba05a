"""What a solver is: an iteration, whose loop is `jaxctrl.solve`'s, or a single run."""

import abc
from typing import Any, NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from ._controller import AffinePolicy
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


class AbstractSolver(eqx.Module):
    """An iteration on a state that is a pytree; it holds parameters but no state of its own."""

    @abc.abstractmethod
    def init(self, problem: Problem, x0: Float[Array, " nx"], us: Float[Array, "T nu"]) -> Any:
        """Return the state at the start, from x0 (nx,) under the controls us (T, nu)."""

    @abc.abstractmethod
    def step(self, problem: Problem, state: Any) -> Any:
        """Return the state after one iteration; the first one measures the start."""

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
    def policy(self, problem: Problem, state: Any) -> AffinePolicy:
        """Return the policy around the state's trajectory, xs (T+1, nx) and us (T, nu)."""
