"""A problem with delayed sensors as one without: what has been sensed is part of its state."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._augmented import AbstractAugmented, OfInner
from ._delay import delayed, shifted, told, unchanged
from ._integrate import AbstractIntegrator, NextState
from ._jacobian import jacobian
from ._noise import AbstractNoise, diffusion
from ._plant import nominal_control
from ._problem import Problem
from ._sensor import AbstractSensor


def lifted(problem: Problem, x0: Float[Array, " nx"]) -> Problem:
    """Return a problem in the state `problem.lift(x)`, whose sensor tells at once.

    What is remembered at the start is as uncertain as the start x0 (nx,), which has lasted.
    A problem without delays comes back as it is.
    """
    sensor = problem.sensor
    if sensor is None or not delayed(sensor):
        return problem
    cov = problem.x0_cov
    if cov is not None:
        J = jacobian(problem.lift)(x0)
        cov = J @ cov @ J.T
    return Problem(
        _Remembering(problem, x0),
        OfInner(problem.cost),  # pyright: ignore[reportCallIssue]
        num_steps=problem.num_steps,
        dt=problem.dt,
        noise=None if problem.noise is None else _OfInnerNoise(problem.noise),
        sensor=_Recalling(sensor, problem.dt),
        x0_cov=cov,
        control_bounds=problem.bounds,
        integrator=None if problem.plant.discrete else _Shifting(problem.integrator),
    )


class _Remembering(AbstractAugmented):
    """A plant and what has been sensed of it, in the state (x, past)."""

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    inner: Any
    sensor: AbstractSensor
    control_bounds: None
    nominal_control: Array

    def __init__(self, problem: Problem, x0):
        plant, sensor = problem.plant, problem.sensor
        assert sensor is not None
        self.nx, self.nu = problem.lift(x0).size, plant.nu
        self.discrete, self.inner, self.sensor = plant.discrete, plant, sensor
        self.control_bounds, self.nominal_control = None, nominal_control(plant)

    @property
    def takes_dt(self) -> bool:
        """Whether it is discrete: the plant inside may want the step."""
        return self.discrete

    def __call__(self, x, u, t, dt=None):
        """Return (f(x, u, t), 0), or the next state of a discrete plant."""
        n = self.inner.nx
        if self.discrete:
            return _Shifting(NextState())(self, x, u, t, dt)
        return jnp.concatenate([self.inner(x[:n], u, t), jnp.zeros_like(x[n:])])

    def split(self, x, u):
        """Return the plant's state (n,) and the control itself."""
        return x[: self.inner.nx], u

    def lift(self, x):
        """Return the state (nx,) for a state x (n,) that has lasted."""
        t = jnp.zeros((), x.dtype)
        return jnp.concatenate([x, unchanged(self.sensor, self.inner, x, t)])


class _Shifting(AbstractIntegrator):
    """An integrator of the plant inside; what is remembered moves on."""

    inner: AbstractIntegrator

    def __call__(self, plant: Any, x, u, t, dt: Any):
        n = plant.inner.nx
        after = self.inner(plant.inner, x[:n], u, t, dt)
        return jnp.concatenate([after, shifted(plant.sensor, plant.inner, x[n:], x[:n], t)])


class _OfInnerNoise(AbstractNoise):
    """A noise on the plant inside."""

    noise: AbstractNoise

    def __call__(self, plant: Any, x, u, t):
        F = diffusion(self.noise, plant.inner, x[: plant.inner.nx], u, t)
        return jnp.pad(F, ((0, x.size - F.shape[0]), (0, 0)))


class _Recalling(AbstractSensor):
    """A sensor that tells of what is remembered."""

    sensor: AbstractSensor
    dt: Array

    def __call__(self, plant: Any, x, t):
        n = plant.inner.nx
        return told(self.sensor, plant.inner, x[n:], x[:n], t, self.dt)[0]

    def noise(self, plant: Any, x, t):
        n = plant.inner.nx
        return told(self.sensor, plant.inner, x[n:], x[:n], t, self.dt)[1]
