"""What acts on a plant: an open-loop sequence, or an affine policy around a trajectory."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._types import Bounds


class AbstractController(eqx.Module):
    """Anything that turns what is sensed into a control; it never sees the true state as such.

    Without a sensor what is sensed, y, is the state itself.
    """

    @abc.abstractmethod
    def init(self, belief: Float[Array, " nx"], key: Array | None) -> Any:
        """Return the memory at the start, given the believed state (nx,)."""

    @abc.abstractmethod
    def step(
        self, memory: Any, y: Float[Array, " ny"], k: ArrayLike, key: Array | None
    ) -> tuple[Any, Float[Array, " nu"]]:
        """Return the new memory and the control (nu,) for step k, having sensed y (ny,)."""


def clip(u: Array, bounds: Bounds | None) -> Array:
    """Return u clipped to (lower, upper), which broadcast against u, or u when there are none."""
    if bounds is None:
        return u
    return jnp.clip(u, bounds[0], bounds[1])


class OpenLoop(AbstractController):
    """A fixed sequence of controls us (T, nu), clipped to the bounds ((T, nu) each) if any."""

    us: Float[Array, "T nu"]
    bounds: Bounds | None = None

    def init(self, belief, key):
        """Return no memory; `belief` (nx,) is not used."""
        return None

    def step(self, memory, y, k, key):
        """Return the control us[k], shape (nu,)."""
        return memory, clip(self.us, self.bounds)[k]


class AffinePolicy(AbstractController):
    """The policy u = u_nominal + k + K (x - x_nominal), clipped to the control bounds.

    Attributes:
        xs: nominal states, shape (T+1, nx).
        us: nominal controls, shape (T, nu).
        k: feed-forward corrections, shape (T, nu); negligible at a converged solution.
        K: feedback gains, shape (T, nu, nx) [control unit per state unit].
        bounds: (lower, upper), each of shape (T, nu), or None.
    """

    xs: Float[Array, "T+1 nx"]
    us: Float[Array, "T nu"]
    k: Float[Array, "T nu"]
    K: Float[Array, "T nu nx"]
    bounds: Bounds | None = None

    def init(self, belief, key):
        """Return no memory; `belief` (nx,) is not used."""
        return None

    def step(self, memory, y, k, key):
        """Return the control for the sensed state y (nx,) at step k, shape (nu,)."""
        bounds = None if self.bounds is None else (self.bounds[0][k], self.bounds[1][k])
        return memory, clip(self.us[k] + self.k[k] + self.K[k] @ (y - self.xs[k]), bounds)
