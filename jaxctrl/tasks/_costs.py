"""The parts of which the costs of movements are made; they add with `+`."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import is_concrete
from .._cost import AbstractCost, Events, quadratic_form
from .._types import array_leaf
from ..plants import RateControlled


class Effort(AbstractCost):
    """Rate c'R c/2 of the controls c that move the plant: the energy of Li (2006), eq. 3.20.

    Of a `RateControlled` plant these are its torques, not their rates.

    Arguments:
        weight: R, scalar, (nu,) or (nu, nu); symmetric part only.
    """

    weight: Float[Array, "..."] = eqx.field(converter=array_leaf, default=1e-4)
    running_is_quadratic: bool = eqx.field(static=True, default=True, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

    def running(self, plant: Any, x, u, t):
        """Return c'R c/2, shape ()."""
        command = plant.command(x) if isinstance(plant, RateControlled) else u
        return quadratic_form(self.weight, command, "effort")

    def terminal(self, plant: Any, x):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    @property
    def events(self):
        """None."""
        return ()


class HandTarget(AbstractCost):
    """Cost w1 |e(T) - e*|^2 + w2 |de(T)/dt - v*|^2 of the hand at the end.

    Li (2006), eq. 3.20 (with v* = 0) and 3.22.

    Arguments:
        position: e* [m], shape (2,).
        velocity: v* [m/s], shape (2,) or scalar.
        position_weight: w1 [1/m^2]. velocity_weight: w2 [s^2/m^2].
    """

    position: Float[Array, "2"] = eqx.field(converter=array_leaf)
    velocity: Float[Array, "..."] = eqx.field(converter=array_leaf, default=0.0)
    position_weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1.0)
    velocity_weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=0.01)
    running_is_quadratic: bool = eqx.field(static=True, default=True, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=False, init=False)

    def running(self, plant: Any, x, u, t):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    def terminal(self, plant: Any, x):
        """Return the cost of the last state, shape ()."""
        position = jnp.sum((plant.hand(x) - self.position) ** 2)
        velocity = jnp.sum((plant.hand_velocity(x) - self.velocity) ** 2)
        return self.position_weight * position + self.velocity_weight * velocity

    @property
    def events(self):
        """None."""
        return ()


class PostureTarget(AbstractCost):
    """Cost w |theta(T) - theta*|^2 / 2 + w_v |dtheta(T)/dt|^2 / 2 of the joints at the end.

    Li (2006), eq. 4.20, to which the text, though not the formula, adds that the movement stops;
    w_v = 0 gives the formula as printed.

    Arguments:
        angles: theta* [rad], shape (num_joints,).
        weight: w [1/rad^2]. velocity_weight: w_v [s^2/rad^2].
    """

    angles: Float[Array, " num_joints"] = eqx.field(converter=array_leaf)
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1.0)
    velocity_weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1.0)
    running_is_quadratic: bool = eqx.field(static=True, default=True, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

    def running(self, plant: Any, x, u, t):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    def terminal(self, plant: Any, x):
        """Return the cost of the last state, shape ()."""
        n = plant.num_joints
        angles = jnp.sum((x[:n] - self.angles) ** 2)
        return 0.5 * (self.weight * angles + self.velocity_weight * jnp.sum(x[n : 2 * n] ** 2))

    @property
    def events(self):
        """None."""
        return ()


class JointLimits(AbstractCost):
    """Rate w sum_j max(0, lower_j - q_j, q_j - upper_j)^2 of joints beyond their limits.

    Arguments:
        lower, upper: limits [rad], (num_joints,). weight: w [1/(rad^2 s)].
    """

    lower: Float[Array, " num_joints"] = eqx.field(converter=array_leaf)
    upper: Float[Array, " num_joints"] = eqx.field(converter=array_leaf)
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1.0)
    running_is_quadratic: bool = eqx.field(static=True, default=False, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

    def running(self, plant: Any, x, u, t):
        """Return the rate, shape ()."""
        q = x[: plant.num_joints]
        beyond = jnp.maximum(self.lower - q, 0.0) + jnp.maximum(q - self.upper, 0.0)
        return self.weight * jnp.sum(beyond**2)

    def terminal(self, plant: Any, x):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    @property
    def events(self):
        """None."""
        return ()


class Obstacle(AbstractCost):
    """Rate k1 (|e - e_ob| - r_ob)^-2 outside a disc that the hand must not enter, inf inside.

    Li (2006), eq. 3.21. An infinite cost rejects a step of the line search, so that a solve which
    starts outside stays outside, at the grid points.

    Arguments:
        centre: e_ob [m], shape (2,). radius: r_ob [m]. weight: k1 [m^2/s].
    """

    centre: Float[Array, "2"] = eqx.field(converter=array_leaf)
    radius: Float[Array, ""] = eqx.field(converter=array_leaf)
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1e-8)
    running_is_quadratic: bool = eqx.field(static=True, default=False, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

    def clearance(self, hand: Float[Array, "2"]) -> Float[Array, ""]:
        """Return the distance [m] of a hand position (2,) from the rim, negative inside."""
        offset = hand - self.centre
        squared = jnp.sum(offset**2)
        # The root's slope is infinite at the centre, where the cost is infinite anyway.
        distance = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
        return jnp.where(squared > 0, distance, 0.0) - self.radius

    def check_start(self, plant: Any, x0) -> None:
        """Raise ValueError when the hand is known to start inside the disc, from x0 (nx,)."""
        if is_concrete(x0, self.centre, self.radius):
            gap = self.clearance(plant.hand(x0))
            if is_concrete(gap) and not gap > 0:
                raise ValueError(
                    f"x0: the hand starts inside the obstacle, {float(gap + self.radius):.4g} m "
                    f"from its centre; its radius is {float(self.radius):.4g} m"
                )

    def running(self, plant: Any, x, u, t):
        """Return the rate, shape (); inf inside the disc."""
        gap = self.clearance(plant.hand(x))
        outside = gap > 0
        return jnp.where(outside, self.weight / jnp.where(outside, gap, 1.0) ** 2, jnp.inf)

    def terminal(self, plant: Any, x):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    @property
    def events(self):
        """None."""
        return ()


class HandPath(AbstractCost):
    """Rate w |e(t) - e*(t)|^2 of leaving a path in time, and w_T |e(T) - e*(T)|^2 at the end.

    Between its points, evenly spaced in time, the path is linear.

    Arguments:
        points: e* [m], shape (m, 2), the first at time 0 and the last at `duration` [s].
        weight: w [1/(m^2 s)]. terminal_weight: w_T [1/m^2].
    """

    points: Float[Array, "m 2"] = eqx.field(converter=array_leaf)
    duration: Float[Array, ""] = eqx.field(converter=array_leaf)
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=1.0)
    terminal_weight: Float[Array, ""] = eqx.field(converter=array_leaf, default=0.0)
    running_is_quadratic: bool = eqx.field(static=True, default=False, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=False, init=False)

    def at(self, t) -> Float[Array, "2"]:
        """Return e*(t) [m], shape (2,), at a time t [s]."""
        last = self.points.shape[0] - 1
        position = t / self.duration * last
        k = jnp.clip(jnp.floor(jax.lax.stop_gradient(position)), 0, max(last - 1, 0)).astype(int)
        before, after = self.points[k], self.points[jnp.minimum(k + 1, last)]
        return before + (position - k) * (after - before)

    def running(self, plant: Any, x, u, t):
        """Return w |e - e*(t)|^2, shape ()."""
        return self.weight * jnp.sum((plant.hand(x) - self.at(t)) ** 2)

    def terminal(self, plant: Any, x):
        """Return w_T |e - e*(T)|^2, shape ()."""
        return self.terminal_weight * jnp.sum((plant.hand(x) - self.points[-1]) ** 2)

    @property
    def events(self):
        """None."""
        return ()


class ViaPoints(AbstractCost):
    """Cost w sum_i |e(t_i) - e_i|^2 of passing points at times (Li 2006, eq. 3.23).

    Arguments:
        points: e_i [m], shape (m, 2). times: t_i [s], shape (m,).
        weight: w [1/m^2], scalar or shape (m,).
    """

    points: Float[Array, "m 2"] = eqx.field(converter=array_leaf)
    times: Float[Array, " m"] = eqx.field(converter=array_leaf)
    weight: Float[Array, "..."] = eqx.field(converter=array_leaf, default=1.0)
    running_is_quadratic: bool = eqx.field(static=True, default=True, init=False)
    terminal_is_quadratic: bool = eqx.field(static=True, default=True, init=False)

    def running(self, plant: Any, x, u, t):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    def terminal(self, plant: Any, x):
        """Return zero, shape ()."""
        return jnp.zeros((), x.dtype)

    @property
    def events(self):
        """One event for each point; times of shape (m,)."""

        def value(plant: Any, x, i):
            weight = jnp.broadcast_to(self.weight, self.times.shape)[i]
            return weight * jnp.sum((plant.hand(x) - self.points[i]) ** 2)

        return (Events(self.times, value),)
