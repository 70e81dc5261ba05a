"""What acts on a plant: an open-loop sequence of controls, or an affine policy."""

import abc
import dataclasses
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from ._checks import is_concrete
from ._linalg import matmul
from ._problem import Problem
from ._types import Bounds, array_leaf, as_bounds, clip

SAME_STEP = 1e-6
"""How much two time steps may differ, relatively, and still be one: more than float32 rounds."""


class AbstractController(eqx.Module):
    """Anything that turns what is sensed into a control; it never sees the true state as such.

    Without a sensor what is sensed, y, is the state (and what `Pulses` add to it). Arrays that the
    controller keeps are fields; what changes from step to step is its memory, any pytree of arrays
    whose shapes and dtypes do not change:

        class PI(jc.AbstractController):
            goal: jax.Array  # (nx,)
            P: jax.Array  # (nu, nx)
            I: jax.Array  # (nu, nx)

            def init(self, problem, belief, key):
                return jnp.zeros_like(belief), problem.dt

            def step(self, memory, y, i, t, key):
                total, dt = memory
                total = total + dt * (self.goal - y)
                return (total, dt), self.P @ (self.goal - y) + self.I @ total

    Its controls act as they are: one that is to keep bounds clips them itself. A method
    `check(problem)`, if it has one, raises ValueError for a problem that it does not fit;
    `simulate` calls it where values can be known.
    """

    @abc.abstractmethod
    def init(self, problem: Problem, belief: Float[Array, " nx"], key: Array | None) -> Any:
        """Return the memory at the start, given the problem and the believed state (nx,)."""

    @abc.abstractmethod
    def step(
        self, memory: Any, y: Float[Array, " ny"], i: ArrayLike, t: ArrayLike, key: Array | None
    ) -> tuple[Any, Float[Array, " nu"]]:
        """Return the new memory and the control (nu,) of step i at time t [s], given y (ny,).

        `key` is one's own at each step, or None where nothing is random.
        """


class OpenLoop(AbstractController):
    """A fixed sequence of controls, clipped to bounds if any.

    Arguments:
        us: controls, shape (T, nu), for a problem of as many steps and controls.
        bounds: (lower, upper), each a scalar or of shape (nu,) or (T, nu), or None.
        dt: the step for which they were made [s], or None for any. In a problem of another step
            the controls are refused, or NaN where the two numbers are traced.

    Raises ValueError for bounds that do not fit us, and at the run for a problem that does not.
    """

    us: Float[Array, "T nu"]
    bounds: Bounds | None
    dt: Float[Array, ""] | None

    def __init__(
        self,
        us: ArrayLike,
        bounds: tuple[ArrayLike, ArrayLike] | None = None,
        dt: ArrayLike | None = None,
    ):
        self.us = array_leaf(us)
        self.bounds = as_bounds(bounds, self.us.shape, "bounds")
        self.dt = None if dt is None else array_leaf(dt)

    def check(self, problem: Problem) -> None:
        """Raise ValueError for a problem of other sizes than us (T, nu), or of another step."""
        _check_shapes(self, problem, us=(problem.num_steps, problem.plant.nu))

    def init(self, problem, belief, key):
        """Return whether the controls were made for the problem's step; raises as `check` does."""
        self.check(problem)
        return same_step(self.dt, problem)

    def step(self, memory, y, i, t, key):
        """Return the control us[i], shape (nu,); NaN for another problem's, or beyond the last."""
        return memory, _act(self, self.us[i], i, memory)


class AffinePolicy(AbstractController):
    """The policy u = u_nominal + k + K (x - x_nominal), clipped to the control bounds.

    It fits problems of its own sizes and time step whose state is known: others are refused, or,
    where dt is traced, give NaN.

    Attributes:
        xs: nominal states, shape (T+1, nx).
        us: nominal controls, shape (T, nu).
        k: feed-forward corrections, shape (T, nu); negligible at a converged solution.
        K: feedback gains, shape (T, nu, nx) [control unit per state unit].
        bounds: (lower, upper), each of shape (T, nu), or None.
        dt: the time step for which it was made [s], shape (), or None for any.
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    bounds: Bounds | None = None
    dt: Float[Array, ""] | None = None

    def check(self, problem: Problem) -> None:
        """Raise ValueError for a problem of other sizes than xs (T+1, nx), us (T, nu), or step."""
        T, nx, nu = problem.num_steps, problem.plant.nx, problem.plant.nu
        _check_shapes(self, problem, us=(T, nu), xs=(T + 1, nx), k=(T, nu), K=(T, nu, nx))
        if problem.sensor is not None:
            raise ValueError(
                "AffinePolicy: it acts on the state, of which the problem's sensor tells only a "
                "part: solve with jc.ILQG(), or take the sensor out of the problem"
            )

    def init(self, problem, belief, key):
        """Return whether the policy was made for the problem's step; raises as `check` does.

        `belief` (nx,) is not used.
        """
        self.check(problem)
        return same_step(self.dt, problem)

    def step(self, memory, y, i, t, key):
        """Return the control for the sensed state y (nx,) at step i, shape (nu,).

        NaN for another problem's step, or beyond the last.
        """
        u = self.us[i] + self.k[i] + matmul(self.K[i], y - self.xs[i])
        return memory, _act(self, u, i, memory)

    def shifted(self, n: int) -> "AffinePolicy":
        """Return the policy from its step n on, for a horizon that recedes by n steps.

        Step i of it is step i + n of this one. Beyond the end the last control, correction, gain
        and bounds are held, around the last state. All shapes stay, so that nothing compiles anew:
        `jc.solve(problem, solver, x, us=policy.shifted(1))`.

        Raises ValueError for an n outside 0 ... T, TypeError for what is no integer.
        """
        try:
            start = operator.index(n)
        except TypeError:
            raise TypeError(f"n: an integer is wanted, got {n!r}") from None
        if self.us.ndim != 2:
            raise ValueError(
                f"us: got shape {self.us.shape}, wanted (T, nu); a batch of policies goes through "
                "jax.vmap"
            )
        if not 0 <= start <= self.us.shape[0]:
            raise ValueError(f"n: 0 to {self.us.shape[0]} steps are wanted, got {start}")
        rows = drop_rows(dataclasses.replace(self, dt=None), np.asarray(start))
        return dataclasses.replace(rows, dt=self.dt)


@eqx.filter_jit
def drop_rows(rows: Any, n: ArrayLike) -> Any:
    """Drop the first n rows of arrays that all lead with time, and hold the last one."""
    return jax.tree.map(lambda a: a[jnp.minimum(jnp.arange(len(a)) + n, len(a) - 1)], rows)


def _check_shapes(controller: Any, problem: Problem, **wanted: tuple[int, ...]) -> None:
    """Raise ValueError when arrays of a controller have other shapes than a problem's, or dt."""
    name = type(controller).__name__
    arrays = {field: getattr(controller, field) for field in wanted}
    if controller.bounds is not None:
        for which, bound in zip(("lower", "upper"), controller.bounds, strict=True):
            arrays[f"{which} bound"], wanted[f"{which} bound"] = bound, wanted["us"]
    for field, array in arrays.items():
        if jnp.shape(array) != wanted[field]:
            batch = jnp.shape(array)[1:] == wanted[field]
            hint = "; a batch goes through jax.vmap" if batch else ""
            raise ValueError(
                f"{name}: its {field} has shape {jnp.shape(array)}, the problem of "
                f"{problem.num_steps} steps, {problem.plant.nx} states and {problem.plant.nu} "
                f"controls wants {wanted[field]}{hint}"
            )
    dt = controller.dt
    if dt is not None and is_concrete(dt, problem.dt):
        own, its = np.asarray(dt), np.asarray(problem.dt)
        if own.shape != () or not abs(own - its) <= SAME_STEP * its:
            raise ValueError(
                f"{name}: made for steps of {own} s, the problem's take {its} s; solve anew, or "
                "resample the controls"
            )


def same_step(dt: Array | None, problem: Problem) -> Bool[Array, ""]:
    """Tell whether dt is the problem's time step, or none at all."""
    if dt is None:
        return jnp.array(True)
    return jnp.abs(dt - problem.dt) <= SAME_STEP * problem.dt


def _act(controller: Any, u: Array, i: ArrayLike, fits: Bool[Array, ""]) -> Array:
    """Return u (nu,) within the bounds of step i; NaN for another problem, or where no step is."""
    bounds = controller.bounds
    u = clip(u, None if bounds is None else (bounds[0][i], bounds[1][i]))
    i = jnp.asarray(i)
    return jnp.where(fits & (i >= 0) & (i < controller.us.shape[0]), u, jnp.nan)
