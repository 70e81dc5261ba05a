"""Process noise: the diffusion F of dx = f dt + F dw, with w a standard Wiener process."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

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


def _each(intensity: Array, u: Float[Array, " nu"], further: str = "") -> Float[Array, " nu"]:
    """Return one intensity for each control; raises ValueError when these are of another number."""
    if intensity.shape not in ((), u.shape):
        raise ValueError(f"intensity: shape {intensity.shape}, wanted () or {u.shape}{further}")
    return jnp.broadcast_to(intensity, u.shape)


def _control_jacobian(plant, x, u, t):
    return jax.jacfwd(lambda u: plant(x, u, t))(u)


class SignalDependentNoise(AbstractNoise):
    """Noise on each control whose standard deviation is proportional to that control.

    F = df/du diag(sigma u)  (Li 2006, eq. 5.2; Harris & Wolpert 1998): the control u_i, held over
    a step dt, is disturbed by a fraction sigma / sqrt(dt) of itself. A fraction quoted per 10 ms
    step, c, is therefore sigma = 0.1 c; see `from_fraction`.

    Arguments:
        intensity: sigma [s^(1/2)] (per step and without unit for a discrete plant), scalar or
            shape (nu,).

    Raises ValueError at the call for an intensity of another shape.
    """

    intensity: Array = eqx.field(converter=leaf("intensity"))

    @classmethod
    def from_fraction(cls, fraction: ArrayLike, interval: ArrayLike) -> "SignalDependentNoise":
        """Return the noise whose SD is `fraction` of the control when held for `interval` [s].

        sigma = fraction sqrt(interval): 20 % over 10 ms is 0.02 s^(1/2). Scalars or shape (nu,).
        """
        return cls(jnp.asarray(fraction) * jnp.sqrt(interval))

    def __call__(self, plant, x, u, t):
        """Return df/du diag(sigma u), shape (nx, nu)."""
        return _control_jacobian(plant, x, u, t) * (_each(self.intensity, u) * u)


class AdditiveNoise(AbstractNoise):
    """Noise of constant intensity, on the controls or on the state.

    F = df/du diag(sigma) for a scalar or a vector sigma (nu,) [control unit s^(1/2)], F = sigma
    itself for a matrix (nx, nw) [state unit s^(-1/2)]; per step for a discrete plant.

    Arguments:
        intensity: sigma, of shape (), (nu,) or (nx, nw).

    Raises ValueError at the call for an intensity of another shape.
    """

    intensity: Array = eqx.field(converter=leaf("intensity"))

    def __call__(self, plant, x, u, t):
        """Return F, shape (nx, nu) or (nx, nw)."""
        if self.intensity.ndim < 2:
            further = f", or ({plant.nx}, nw)"
            return _control_jacobian(plant, x, u, t) * _each(self.intensity, u, further)
        if self.intensity.ndim > 2 or self.intensity.shape[0] != plant.nx:
            raise ValueError(
                f"intensity: shape {self.intensity.shape}, wanted (), {u.shape} or ({plant.nx}, nw)"
            )
        return self.intensity
