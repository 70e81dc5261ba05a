"""The parts of which the costs of movements are made; they add with `+`."""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._augmented import innermost
from .._checks import is_concrete
from .._cost import quadratic_form
from .._fields import WEIGHT, fits
from .._terms import AbstractEnd, AbstractEvents, AbstractRate
from .._types import array_leaf


class Marks(NamedTuple):
    """What a cost shows in a plot of the hand's paths: the property `marks` of a cost.

    Attributes:
        targets, points: where the hand is to end and to pass [m], each (n, 2).
        obstacles: discs (x, y, radius) [m], (n, 3).
        path: where it is to be in time [m], (m, 2), evenly from beginning to end; or None.
    """

    targets: Any = np.zeros((0, 2))
    points: Any = np.zeros((0, 2))
    obstacles: Any = np.zeros((0, 3))
    path: Any = None


class Effort(AbstractRate):
    """Rate c'R c/2 of the controls c that move the body: the energy of Li (2006), eq. 3.20.

    Of an augmented plant these are the controls of what is inside it: of a `RateControlled` one its
    torques, not their rates.

    Arguments:
        weight: R, scalar, (nu,) or (nu, nu); symmetric part only.
    """

    weight: Float[Array, "..."] = eqx.field(
        converter=array_leaf, metadata=fits((), ("n",), ("n", "n"), least=0.0), default=1e-4
    )
    of: ClassVar[str] = "effort"

    def rate(self, plant: Any, at):
        """Return c'R c/2, shape ()."""
        _, _, command = innermost(plant, at.x, at.u)
        return quadratic_form(self.weight, command, "effort")


class HandTarget(AbstractEnd):
    """Cost w1 |e(T) - e*|^2 + w2 |de(T)/dt - v*|^2 of the hand at the end.

    Li (2006), eq. 3.20 (with v* = 0) and 3.22.

    Arguments:
        position: e* [m], shape (dim,).
        velocity: v* [m/s], shape (dim,) or scalar.
        position_weight: w1 [1/m^2]. velocity_weight: w2 [s^2/m^2].
    """

    position: Float[Array, "2"] = eqx.field(converter=array_leaf, metadata=fits(("dim",)))
    velocity: Float[Array, "..."] = eqx.field(
        converter=array_leaf, metadata=fits((), ("dim",)), default=0.0
    )
    position_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=1.0
    )
    velocity_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=0.01
    )
    of: ClassVar[str] = "hand"

    def end(self, plant: Any, x):
        """Return the cost of the last state, shape ()."""
        position = jnp.sum((plant.hand(x) - self.position) ** 2)
        velocity = jnp.sum((plant.hand_velocity(x) - self.velocity) ** 2)
        return self.position_weight * position + self.velocity_weight * velocity

    @property
    def marks(self) -> Marks:
        """The target."""
        return Marks(targets=self.position[None])


class PostureTarget(AbstractEnd):
    """Cost w |theta(T) - theta*|^2 / 2 + w_v |dtheta(T)/dt|^2 / 2 of the joints at the end.

    Li (2006), eq. 4.20, to which the text, though not the formula, adds that the movement stops;
    w_v = 0 gives the formula as printed.

    Arguments:
        angles: theta* [rad], shape (num_joints,).
        weight: w [1/rad^2]. velocity_weight: w_v [s^2/rad^2].
    """

    angles: Float[Array, " num_joints"] = eqx.field(
        converter=array_leaf, metadata=fits(("num_joints",))
    )
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1.0)
    velocity_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=1.0
    )

    def end(self, plant: Any, x):
        """Return the cost of the last state, shape ()."""
        n = plant.num_joints
        angles = jnp.sum((x[:n] - self.angles) ** 2)
        return 0.5 * (self.weight * angles + self.velocity_weight * jnp.sum(x[n : 2 * n] ** 2))


class JointLimits(AbstractRate):
    """Rate w sum_j max(0, lower_j - q_j, q_j - upper_j)^2 of joints beyond their limits.

    Arguments:
        lower, upper: limits [rad], (num_joints,). weight: w [1/(rad^2 s)].
    """

    lower: Float[Array, " num_joints"] = eqx.field(
        converter=array_leaf, metadata=fits(("num_joints",))
    )
    upper: Float[Array, " num_joints"] = eqx.field(
        converter=array_leaf, metadata=fits(("num_joints",))
    )
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1.0)
    of: ClassVar[str] = "joints"

    def rate(self, plant: Any, at):
        """Return the rate, shape ()."""
        q = at.x[: plant.num_joints]
        beyond = jnp.maximum(self.lower - q, 0.0) + jnp.maximum(q - self.upper, 0.0)
        return self.weight * jnp.sum(beyond**2)


class Obstacle(AbstractRate):
    """Rate k1 (|e - e_ob| - r_ob)^-2 outside a disc that the hand must not enter, inf inside.

    Li (2006), eq. 3.21. An infinite cost rejects a step of the line search, so that a solve which
    starts outside stays outside, at the grid points. Several discs are several costs, added.

    Arguments:
        centre: e_ob [m], shape (dim,). radius: r_ob [m]. weight: k1 [m^2/s].
    """

    centre: Float[Array, "2"] = eqx.field(converter=array_leaf, metadata=fits(("dim",)))
    radius: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT)
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1e-8)
    of: ClassVar[str] = "hand"

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

    def rate(self, plant: Any, at):
        """Return the rate, shape (); inf inside the disc."""
        gap = self.clearance(plant.hand(at.x))
        outside = gap > 0
        return jnp.where(outside, self.weight / jnp.where(outside, gap, 1.0) ** 2, jnp.inf)

    @property
    def marks(self) -> Marks:
        """The disc."""
        return Marks(obstacles=jnp.append(self.centre, self.radius)[None])


class HandPath(AbstractRate, AbstractEnd):
    """Rate w |e(t) - e*(t)|^2 of leaving a path in time, and w_T |e(T) - e*(T)|^2 at the end.

    Between its points, evenly spaced in time, the path is linear. It lasts as long as the problem.

    Arguments:
        points: e* [m], shape (m, 2), the first at the start and the last at the end.
        weight: w [1/(m^2 s)]. terminal_weight: w_T [1/m^2].
    """

    points: Float[Array, "m 2"] = eqx.field(converter=array_leaf, metadata=fits(("m", "dim")))
    weight: Float[Array, ""] = eqx.field(converter=array_leaf, metadata=WEIGHT, default=1.0)
    terminal_weight: Float[Array, ""] = eqx.field(
        converter=array_leaf, metadata=WEIGHT, default=0.0
    )
    of: ClassVar[str] = "hand"

    def position(self, s) -> Float[Array, "2"]:
        """Return e* [m], shape (2,), when a part s of the movement is over, from 0 to 1."""
        last = self.points.shape[0] - 1
        position = s * last
        k = jnp.clip(jnp.floor(jax.lax.stop_gradient(position)), 0, max(last - 1, 0)).astype(int)
        before, after = self.points[k], self.points[jnp.minimum(k + 1, last)]
        return before + (position - k) * (after - before)

    def rate(self, plant: Any, at):
        """Return w |e - e*(t)|^2, shape ()."""
        return self.weight * jnp.sum((plant.hand(at.x) - self.position(at.s)) ** 2)

    def end(self, plant: Any, x):
        """Return w_T |e - e*(T)|^2, shape ()."""
        return self.terminal_weight * jnp.sum((plant.hand(x) - self.points[-1]) ** 2)

    @property
    def marks(self) -> Marks:
        """The path."""
        return Marks(path=self.points)


class ViaPoints(AbstractEvents):
    """Cost w sum_i |e(t_i) - e_i|^2 of passing points at times (Li 2006, eq. 3.23).

    Arguments:
        points: e_i [m], shape (m, dim). times: t_i [s], shape (m,).
        weight: w [1/m^2], scalar or shape (m,).
    """

    points: Float[Array, "m 2"] = eqx.field(converter=array_leaf, metadata=fits(("m", "dim")))
    times: Float[Array, " m"] = eqx.field(converter=array_leaf, metadata=fits(("m",)))
    weight: Float[Array, "..."] = eqx.field(
        converter=array_leaf, metadata=fits((), ("m",), least=0.0), default=1.0
    )
    of: ClassVar[str] = "hand"

    def event(self, plant: Any, x, j):
        """Return w_j |e - e_j|^2, shape ()."""
        weight = jnp.broadcast_to(self.weight, self.times.shape)[j]
        return weight * jnp.sum((plant.hand(x) - self.points[j]) ** 2)

    @property
    def marks(self) -> Marks:
        """The points."""
        return Marks(points=self.points)
