"""Process noise: the diffusion F of dx = f dt + F dw, with w a standard Wiener process."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._checks import known
from ._function import as_params, check_function
from ._jacobian import dependence, jacobian
from ._plant import AbstractPlant
from ._types import leaf


class AbstractNoise(eqx.Module):
    """A diffusion matrix F(x, u, t); simulated by Euler-Maruyama in the sense of Ito.

    Intensities carry s^(1/2), so that results do not depend on the time step: one step adds
    sqrt(dt) F xi, xi ~ N(0, I). For a discrete plant F is per step and one step adds F xi.
    """

    @abc.abstractmethod
    def __call__(
        self, plant: AbstractPlant, x: Float[Array, " nx"], u: Float[Array, " nu"], t: ArrayLike
    ) -> Float[Array, "nx nw"]:
        """Return F(x, u, t), shape (nx, nw): state units per s^(1/2)."""

    def __add__(self, other: "AbstractNoise") -> "AbstractNoise":
        """Return both noises together, independent of one another."""
        if not isinstance(other, AbstractNoise):
            return NotImplemented
        return SumNoise((*_parts(self), *_parts(other)))


class SumNoise(AbstractNoise):
    """Several independent noises, given as a tuple: their columns side by side."""

    parts: tuple[AbstractNoise, ...]

    def __check_init__(self):
        wrong = [part for part in self.parts if not isinstance(part, AbstractNoise)]
        if wrong or not self.parts:
            got = repr(wrong[0]) if wrong else "none"
            raise TypeError(f"SumNoise: a tuple of noises is wanted, got {got}")

    def __call__(self, plant, x, u, t):
        """Return the columns of all parts, in order, shape (nx, nw)."""
        return jnp.concatenate([diffusion(part, plant, x, u, t) for part in self.parts], axis=1)


def _parts(noise: AbstractNoise) -> tuple[AbstractNoise, ...]:
    return noise.parts if isinstance(noise, SumNoise) else (noise,)


def diffusion(
    noise: AbstractNoise, plant: AbstractPlant, x: Float[Array, " nx"], u: Float[Array, " nu"], t
) -> Float[Array, "nx nw"]:
    """Return F(x, u, t), shape (nx, nw); raises ValueError where a noise returns another shape."""
    F = noise(plant, x, u, t)
    if getattr(F, "ndim", None) != 2 or F.shape[0] != plant.nx:
        got = getattr(F, "shape", F)
        raise ValueError(f"{type(noise).__name__}: returned {got}, wanted ({plant.nx}, nw)")
    return F


def _check_intensity(intensity: Array) -> None:
    """Raise ValueError where a standard deviation is known to be negative."""
    numbers = known(intensity)
    if numbers is not None and (numbers < 0).any():
        raise ValueError(f"intensity: at least 0 is wanted, got {intensity}")


def _each(intensity: Array, u: Float[Array, " nu"], further: str = "") -> Float[Array, " nu"]:
    """Return one intensity for each control; raises ValueError when these are of another number."""
    if intensity.shape not in ((), u.shape):
        raise ValueError(f"intensity: shape {intensity.shape}, wanted () or {u.shape}{further}")
    return jnp.broadcast_to(intensity, u.shape)


def _through_controls(plant, x, u, t, size: Float[Array, " nu"]) -> Float[Array, "nx nu"]:
    """Return df/du diag(size), with zeros that can be seen where a state knows no control."""

    def motion(u, x, t):
        return plant(x, u, t)

    slope = jacobian(motion)(u, x, jnp.asarray(t))
    touched = dependence(motion, u, x, jnp.asarray(t))
    return jnp.where(touched, slope * size, 0.0)


class SignalDependentNoise(AbstractNoise):
    """Noise on each control whose standard deviation is proportional to that control.

    F = df/du diag(sigma u)  (Li 2006, eq. 5.2; Harris & Wolpert 1998): the control u_i, held over
    a step dt, is disturbed by a fraction sigma / sqrt(dt) of itself. A fraction quoted per 10 ms
    step, c, is therefore sigma = 0.1 c; see `from_fraction`.

    Arguments:
        intensity: sigma [s^(1/2)] (per step and without unit for a discrete plant), scalar or
            shape (nu,).

    Raises ValueError for a negative intensity, and at the call for one of another shape.
    """

    intensity: Array = eqx.field(converter=leaf("intensity"))

    def __check_init__(self):
        _check_intensity(self.intensity)

    @classmethod
    def from_fraction(cls, fraction: ArrayLike, interval: ArrayLike) -> "SignalDependentNoise":
        """Return the noise whose SD is `fraction` of the control when held for `interval` [s].

        sigma = fraction sqrt(interval): 20 % over 10 ms is 0.02 s^(1/2), as
        `from_fraction(0.2, interval=0.01)`. Scalars or shape (nu,).

        Raises ValueError for an interval that is not above zero, or above 1 s, and for a fraction
        above 10, which is likely per cent.
        """
        for name, number, most in (("fraction", fraction, 10.0), ("interval", interval, 1.0)):
            values = known(number)
            if values is not None and (values > most).any():
                raise ValueError(
                    f"{name}: at most {most:g} is wanted, got {number}; 20 % over "
                    "10 ms is from_fraction(0.2, interval=0.01)"
                )
        seconds = known(interval)
        if seconds is not None and not (seconds > 0).all():
            raise ValueError(f"interval: a time above 0 s is wanted, got {interval}")
        return cls(jnp.asarray(fraction) * jnp.sqrt(interval))

    def __call__(self, plant, x, u, t):
        """Return df/du diag(sigma u), shape (nx, nu)."""
        return _through_controls(plant, x, u, t, _each(self.intensity, u) * u)


class AdditiveNoise(AbstractNoise):
    """Noise of constant intensity, on the controls or on the state.

    F = df/du diag(sigma) for a scalar or a vector sigma (nu,) [control unit s^(1/2)], F = sigma
    itself for a matrix (nx, nw) [state unit s^(-1/2)]; per step for a discrete plant.

    Arguments:
        intensity: sigma, of shape (), (nu,) or (nx, nw).

    Raises ValueError for a negative standard deviation, and at the call for another shape.
    """

    intensity: Array = eqx.field(converter=leaf("intensity"))

    def __check_init__(self):
        if self.intensity.ndim < 2:
            _check_intensity(self.intensity)

    def __call__(self, plant, x, u, t):
        """Return F, shape (nx, nu) or (nx, nw)."""
        if self.intensity.ndim < 2:
            further = f", or ({plant.nx}, nw)"
            return _through_controls(plant, x, u, t, _each(self.intensity, u, further))
        if self.intensity.ndim > 2 or self.intensity.shape[0] != plant.nx:
            raise ValueError(
                f"intensity: shape {self.intensity.shape}, wanted (), {u.shape} or ({plant.nx}, nw)"
            )
        return self.intensity


class StateDependentNoise(AbstractNoise):
    """Noise whose standard deviation is proportional to the state: column i of F is C_i x.

    The zero of each state counts: noise proportional to a joint angle depends on where that angle
    is zero, which is arbitrary; velocities, forces and activations have a zero of their own.

    Arguments:
        slopes: C [s^(-1/2)] (per step for a discrete plant), shape (nw, nx, nx); or sigma, (nx,),
            for one column sigma_i x_i on each state.

    Raises ValueError at the call for slopes of another shape.
    """

    slopes: Array = eqx.field(converter=leaf("slopes"))

    def __call__(self, plant, x, u, t):
        """Return the columns C_i x, shape (nx, nw)."""
        nx = plant.nx
        if self.slopes.shape == (nx,):
            return jnp.diag(self.slopes * x)
        if self.slopes.ndim != 3 or self.slopes.shape[1:] != (nx, nx):
            raise ValueError(
                f"slopes: shape {self.slopes.shape}, wanted ({nx},) or (nw, {nx}, {nx})"
            )
        return (self.slopes @ x).T


class FunctionNoise(AbstractNoise):
    """A noise made of a plain function.

    `function(x, u, t)`, or `function(x, u, t, params)` when `params` is given, returns F, shape
    (nx, nw). What the function depends on is treated as in `FunctionPlant`.

    Arguments:
        function: the function above.
        params: as in `FunctionPlant`.

    Raises ValueError at the call when it returns another shape.
    """

    function: Callable
    params: Any = eqx.field(converter=as_params)

    def __init__(self, function: Callable, *, params: Any = None):
        self.function = check_function("function", function)
        self.params = as_params(params)

    def __call__(self, plant, x, u, t):
        """Return function(x, u, t[, params]), shape (nx, nw)."""
        if self.params is None:
            return self.function(x, u, t)
        return self.function(x, u, t, self.params)
