"""A closed path for the hand with its timing left to the optimum: plant, step and costs.

The phase along the path is one more state, and its rate one more control. Only the number of turns
 is prescribed, at the end: how fast each part is passed follows from what the movement costs.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

import jaxctrl as jc


class ClosedPath(eqx.Module):
    """A closed curve, p(s) = centre + sum_k (a_k cos k s + b_k sin k s).

    Arguments:
        centre: [m], (2,). coefficients: a_k and b_k [m], (harmonics, 2, 2): k, then a and b, then
            x and y.
    """

    centre: Float[Array, "2"]
    coefficients: Float[Array, "harmonics 2 2"]

    def __call__(self, s: Float[Array, ""]) -> Float[Array, "2"]:
        """Return the position [m], shape (2,), at a phase s [rad]."""
        angles = s * jnp.arange(1, len(self.coefficients) + 1)
        waves = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
        return self.centre + jnp.sum(self.coefficients * waves[..., None], axis=(0, 1))

    def slope(self, s: Float[Array, ""]) -> Float[Array, "2"]:
        """Return dp/ds [m], shape (2,), at a phase s [rad]."""
        k = jnp.arange(1, len(self.coefficients) + 1)
        waves = jnp.stack([-k * jnp.sin(k * s), k * jnp.cos(k * s)], axis=1)
        return jnp.sum(self.coefficients * waves[..., None], axis=(0, 1))


class OnPath(jc.AbstractAugmentedHand):
    """Let a plant with a hand trace a closed path, d(x, s)/dt = (f(x, u, t), r).

    State (x, s), shape (nx + 1,), with the phase s of the path in rad; control (u, r), shape
    (nu + 1,), with r in rad/s. The rate is kept between zero and a bound, so that the phase cannot
    leap over a whole turn between two grid points, where nothing would be seen of it.

    Arguments:
        body: the plant whose hand moves, continuous.
        path: p. turns: how often it is to be traced.
        rate: r from which an optimisation starts [rad/s]. fastest: its upper bound [rad/s].
    """

    nx: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    inner: jc.AbstractHand
    path: ClosedPath
    turns: Float[Array, ""]
    control_bounds: tuple[Array, Array]
    nominal_control: Float[Array, " nu"]

    def __init__(
        self,
        body: jc.AbstractHand,
        path: ClosedPath,
        *,
        turns: ArrayLike,
        rate: ArrayLike,
        fastest: ArrayLike,
    ):
        self.nx, self.nu, self.discrete = body.nx + 1, body.nu + 1, False
        self.inner, self.path, self.turns = body, path, jc.array_leaf(turns)
        free = jnp.full(body.nu, jnp.inf)
        lower, upper = (-free, free) if body.control_bounds is None else body.control_bounds
        self.control_bounds = jnp.append(lower, 0.0), jnp.append(upper, fastest)
        self.nominal_control = jnp.append(body.nominal_control, rate)

    def __call__(self, x, u, t):
        """Return (f(x, u, t), r), shape (nx + 1,)."""
        return jnp.append(self.inner(x[:-1], u[:-1], t), u[-1])

    def split(self, x, u):
        """Return the body's state (nx,) and control (nu,)."""
        return x[:-1], u[:-1]

    def lift(self, x):
        """Return the state (nx + 1,) at the beginning of the path, for a body's state x (nx,)."""
        return jnp.append(x, 0.0)


class StepOnPath(jc.AbstractIntegrator):
    """Take the body of an `OnPath` a step further by its own rule, and the phase by r dt.

    Arguments:
        rule: of the body, such as `RK4()`.
    """

    rule: jc.AbstractIntegrator

    def __call__(self, plant: Any, x, u, t, dt):
        """Return (x', s + r dt), shape (nx + 1,)."""
        return jnp.append(self.rule(plant.inner, x[:-1], u[:-1], t, dt), x[-1] + dt * u[-1])


class PathCost(jc.AbstractRate, jc.AbstractEnd):
    """Cost of leaving an `OnPath`'s path, w |e - p(s)|^2 per second, and of not completing it.

    At the end w_T |e - p(s)|^2 + w_s (s - 2 pi turns)^2. The pace along the path costs
    v |dp/ds r|^2/2 per second, so little that it only settles the phase where the hand rests.

    Arguments:
        weight: w [1/(m^2 s)]. terminal_weight: w_T [1/m^2]. phase_weight: w_s [1/rad^2].
        pace_weight: v [s/m^2].
    """

    weight: Float[Array, ""] = eqx.field(converter=jc.array_leaf)
    terminal_weight: Float[Array, ""] = eqx.field(converter=jc.array_leaf, default=100.0)
    phase_weight: Float[Array, ""] = eqx.field(converter=jc.array_leaf, default=1.0)
    pace_weight: Float[Array, ""] = eqx.field(converter=jc.array_leaf, default=1e-9)

    def rate(self, plant: Any, at):
        """Return the rate, shape ()."""
        x, u = at.x, at.u
        pace = jnp.sum(plant.path.slope(x[-1]) ** 2) * u[-1] ** 2
        return self.weight * _miss(plant, x) + 0.5 * self.pace_weight * pace

    def end(self, plant: Any, x):
        """Return the cost of the last state, shape ()."""
        missing = x[-1] - 2 * jnp.pi * plant.turns
        return self.terminal_weight * _miss(plant, x) + self.phase_weight * missing**2


def _miss(plant: Any, x):
    return jnp.sum((plant.hand(x) - plant.path(x[-1])) ** 2)
