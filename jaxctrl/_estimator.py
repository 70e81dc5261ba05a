"""Estimators: what a controller makes of its senses, and a controller that acts on that."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._controller import AbstractController, AffinePolicy, drop_rows, same_step
from ._lifted import lifted
from ._linalg import matmul
from ._problem import Problem
from ._sensor import reading
from ._types import Bounds, LocalModel
from .linear._sensed import Forecast


class AbstractEstimator(eqx.Module):
    """An estimate of the state, made of what is sensed and what is done.

    In each step it is told the reading, `sense`, and then the control, `move`. What it believes is
    any pytree of arrays whose shapes and dtypes do not change.
    """

    @abc.abstractmethod
    def init(self, problem: Problem, mean: Float[Array, " nx"]) -> Any:
        """Return the belief before the first reading, of the given mean (nx,).

        How certain it is follows from the problem's `x0_cov`. Raises ValueError for a problem that
        does not fit.
        """

    @abc.abstractmethod
    def expect(
        self, belief: Any, i: ArrayLike, t: ArrayLike
    ) -> tuple[Float[Array, " ny"], Float[Array, "ny ny"]]:
        """Return mean (ny,) and covariance (ny, ny) of the reading that is expected in step i."""

    @abc.abstractmethod
    def sense(self, belief: Any, y: Float[Array, " ny"], i: ArrayLike, t: ArrayLike) -> Any:
        """Return the belief after the reading y (ny,) of step i at time t [s]."""

    @abc.abstractmethod
    def move(self, belief: Any, u: Float[Array, " nu"], i: ArrayLike, t: ArrayLike) -> Any:
        """Return the belief one step later, before its reading, under the control u (nu,)."""

    @abc.abstractmethod
    def mean(self, belief: Any) -> Float[Array, " nx"]:
        """Return the estimate of the state, (nx,)."""


class LinearFilter(AbstractEstimator):
    """A filter of fixed gains around a trajectory, such as `ILQG` finds beside its law.

        sense   xhat <- xhat + G (y - ys - F (xhat - xs))
        move    xhat <- xs' + fx (xhat - xs) + fu (u - us)

    The gains are the best on average over all that may happen under the law that they were made
    for: under noise that depends on state and control too (Todorov 2005).

    Attributes:
        xs, us, ys: nominal states (T+1, nx), controls (T, nu) and readings (T, ny).
        fx, fu: dynamics of deviations, (T, nx, nx) and (T, nx, nu).
        F: what is sensed of them, (T, ny, nx).
        G: gains, (T, nx, ny).
        S: covariances of y less what was expected, (T, ny, ny).
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    ys: Float[Array, "T ny"]
    fx: Float[Array, "T nx nx"]
    fu: Float[Array, "T nx nu"]
    F: Float[Array, "T ny nx"]
    G: Float[Array, "T nx ny"]
    S: Float[Array, "T ny ny"]

    def check(self, problem: Problem) -> None:
        """Raise ValueError for a problem of other sizes than those that it was made for."""
        T, plant = problem.num_steps, problem.plant
        for name, wanted in (
            ("states", (T + 1, plant.nx)),
            ("controls", (T, plant.nu)),
            ("readings", (T, problem.num_readings)),
        ):
            got = {"states": self.xs, "controls": self.us, "readings": self.ys}[name].shape
            if got != wanted:
                raise ValueError(f"LinearFilter: made for {name} {got}, the problem's are {wanted}")

    def init(self, problem, mean):
        """Return the mean (nx,) itself; raises as `check` does."""
        self.check(problem)
        return mean

    def expect(self, belief, i, t):
        """Return ys + F (xhat - xs) and S of step i."""
        return self.ys[i] + matmul(self.F[i], belief - self.xs[i]), self.S[i]

    def sense(self, belief, y, i, t):
        """Return the estimate (nx,) corrected by a reading."""
        return belief + matmul(self.G[i], y - self.expect(belief, i, t)[0])

    def move(self, belief, u, i, t):
        """Return the estimate (nx,) of the next state."""
        dx, du = belief - self.xs[i], u - self.us[i]
        return self.xs[i + 1] + matmul(self.fx[i], dx) + matmul(self.fu[i], du)

    def mean(self, belief):
        """Return the estimate itself, (nx,)."""
        return belief


def filter_around(
    problem: Problem, model: LocalModel, xs: Array, us: Array, found: Forecast
) -> LinearFilter:
    """Return the filter of a problem's model around xs (T+1, nx), us (T, nu)."""
    sensor, sensing = problem.sensor, model.sensing
    assert sensor is not None and sensing is not None
    ys = jax.vmap(lambda x, t: reading(sensor, problem.plant, x, t))(xs[:-1], problem.ts[:-1])
    gains, S = found.gains, found.innovation
    return LinearFilter(xs, us, ys, model.fx, model.fu, sensing.F, gains, S)


class OutputFeedback(AbstractController):
    """An affine policy that acts on an estimate of the state.

    In each step the estimator is told the reading; the policy acts on the estimate, and the
    estimator is told the control as it was clipped. With delayed sensors both work on
    `problem.lift(x)`, what has been sensed included.

    Attributes:
        policy: u = u_nominal + k + K (xhat - x_nominal), clipped to the bounds.
        estimator: what makes xhat of the readings.

    Its law's `us`, `k`, `K` and `bounds` are the policy's.
    """

    policy: AffinePolicy
    estimator: AbstractEstimator

    def __check_init__(self):
        for name, wanted in (("policy", AffinePolicy), ("estimator", AbstractEstimator)):
            got = getattr(self, name)
            if not isinstance(got, wanted):
                hint = ", such as solution.policy.policy" if name == "policy" else ""
                raise TypeError(
                    f"OutputFeedback: {name}: a jc.{wanted.__name__}{hint} is wanted, "
                    f"got {type(got).__name__}"
                )

    @property
    def us(self) -> Float[Array, "T nu"]:
        """Nominal controls, shape (T, nu)."""
        return self.policy.us

    @property
    def xs(self) -> Float[Array, "T+1 nx"]:
        """Nominal states, shape (T+1, nx)."""
        return self.policy.xs

    @property
    def k(self) -> Float[Array, "T nu"]:
        """Feed-forward corrections, shape (T, nu)."""
        return self.policy.k

    @property
    def K(self) -> Float[Array, "T nu nx"]:
        """Gains on the estimate, shape (T, nu, nx)."""
        return self.policy.K

    @property
    def bounds(self) -> Bounds | None:
        """(lower, upper), each of shape (T, nu), or None."""
        return self.policy.bounds

    @property
    def dt(self) -> Float[Array, ""] | None:
        """The time step for which it was made [s]."""
        return self.policy.dt

    def shifted(self, n: int) -> "OutputFeedback":
        """Return the same from its step n on, as `AffinePolicy.shifted` does.

        Raises TypeError for an estimator that is not made for each step, as `LinearFilter` is.
        """
        if not isinstance(self.estimator, LinearFilter):
            raise TypeError(f"estimator: a LinearFilter is wanted, got {type(self.estimator)}")
        return OutputFeedback(self.policy.shifted(n), drop_rows(self.estimator, np.asarray(n)))

    def check(self, problem: Problem) -> None:
        """Raise ValueError for a problem of other sizes, readings or another step."""
        whole = lifted(problem, jnp.zeros(problem.plant.nx, problem.dt.dtype))
        self.policy.check(_unsensed(whole))
        if (check := getattr(self.estimator, "check", None)) is not None:
            check(whole)

    def init(self, problem, belief, key):
        """Return whether it was made for the problem's step, and the estimator's belief."""
        self.check(problem)
        mean = problem.lift(belief)
        fits = same_step(self.policy.dt, problem)
        return fits, self.estimator.init(lifted(problem, belief), mean)

    def step(self, memory, y, i, t, key):
        """Return the control for the estimate after the reading y (ny,), shape (nu,)."""
        fits, belief = memory
        belief = self.estimator.sense(belief, y, i, t)
        _, u = self.policy.step(fits, self.estimator.mean(belief), i, t, key)
        return (fits, self.estimator.move(belief, u, i, t)), u


def _unsensed(problem: Problem) -> Problem:
    return eqx.tree_at(lambda p: p.sensor, problem, None, is_leaf=lambda leaf: leaf is None)
