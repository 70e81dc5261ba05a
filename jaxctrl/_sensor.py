"""Sensors: what a controller is told of the state, y = g(x, t) + G(x, t) eta / sqrt(dt)."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from ._checks import check_integer, known
from ._function import as_params, check_function
from ._plant import AbstractArm, AbstractHand, AbstractPlant
from ._types import leaf


class AbstractSensor(eqx.Module):
    """What is sensed of a state, and how noisy it is.

    In each step of length dt the controller is told y = g(x, t) + G(x, t) eta / sqrt(dt), with
    eta ~ N(0, I) independent of all else: intensities G carry s^(1/2), so that what is known after
    a time does not depend on the time step. A sample whose standard deviation is sd at a rate of
    1/interval has the intensity sd sqrt(interval). For a discrete plant y = g + G eta.

    What is sensed is a function of the state alone: the control of a step is chosen after it.
    """

    @abc.abstractmethod
    def __call__(
        self, plant: AbstractPlant, x: Float[Array, " nx"], t: ArrayLike
    ) -> Float[Array, " ny"]:
        """Return what is sensed without noise, g(x, t), shape (ny,)."""

    @abc.abstractmethod
    def noise(
        self, plant: AbstractPlant, x: Float[Array, " nx"], t: ArrayLike
    ) -> Float[Array, "ny nv"]:
        """Return the intensities G(x, t), shape (ny, nv): unit of y times s^(1/2)."""

    def __add__(self, other: "AbstractSensor") -> "AbstractSensor":
        """Return both sensors together, the readings one below the other, their noise apart."""
        if not isinstance(other, AbstractSensor):
            return NotImplemented
        return SumSensor((*_parts(self), *_parts(other)))

    def delayed(self, delay: ArrayLike, *, steps: int | None = None) -> "AbstractSensor":
        """Return this sensor telling late, by `delay` seconds, scalar.

        Each part of a sum may have its own: `JointSensor().delayed(0.05) +
        HandSensor().delayed(0.1)`. Between steps what is told is interpolated. `steps` is the
        length of the buffer, by default what the delay needs; to be given where delay or time step
        are traced when the problem is made, or to be made longer later.

        Raises: as `DelayedSensor` does.
        """
        later = tuple(_later(part, delay, steps) for part in _parts(self))
        return SumSensor(later) if isinstance(self, SumSensor) else later[0]


class SumSensor(AbstractSensor):
    """Several sensors with independent noise, given as a tuple: their readings in a row."""

    parts: tuple[AbstractSensor, ...]

    def __check_init__(self):
        wrong = [part for part in self.parts if not isinstance(part, AbstractSensor)]
        if wrong or not self.parts:
            got = repr(wrong[0]) if wrong else "none"
            raise TypeError(f"SumSensor: a tuple of sensors is wanted, got {got}")

    def __call__(self, plant, x, t):
        """Return the readings of all parts, in order, shape (ny,)."""
        return jnp.concatenate([reading(part, plant, x, t) for part in self.parts])

    def noise(self, plant, x, t):
        """Return the intensities of all parts along the diagonal, shape (ny, nv)."""
        return jax.scipy.linalg.block_diag(
            *(reading_noise(part, plant, x, t) for part in self.parts)
        )


class DelayedSensor(AbstractSensor):
    """A sensor that tells late, y(t) = g(x(t - delay)) + G(x(t - delay)) eta / sqrt(dt).

    Before the start the state is taken to have been what it is there. Solvers that plan with the
    sensor remember for themselves what has been sensed: states, gains on them and predictions stay
    those of the plant.

    Arguments:
        sensor: what is told late, of one part; see `AbstractSensor.delayed`.
        delay: how late [s], scalar.
        steps: length of the buffer, in time steps; static.

    Raises ValueError for a negative delay, TypeError for what is no sensor.
    """

    sensor: AbstractSensor
    delay: Float[Array, ""] = eqx.field(converter=leaf("delay"))
    steps: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if not isinstance(self.sensor, AbstractSensor):
            raise TypeError(f"sensor: jc.JointSensor() or its like is wanted, got {self.sensor!r}")
        if self.delay.shape != ():
            raise ValueError(f"delay: one number is wanted, got shape {self.delay.shape}")
        _check_positive(delay=self.delay)
        if self.steps is not None:
            check_integer("steps", self.steps, 1)

    def __call__(self, plant, x, t):
        """Return what is told of a state that has lasted, shape (ny,)."""
        return self.sensor(plant, x, t)

    def noise(self, plant, x, t):
        """Return the intensities for a state that has lasted, shape (ny, nv)."""
        return self.sensor.noise(plant, x, t)


def _later(part: AbstractSensor, delay: ArrayLike, steps: int | None) -> DelayedSensor:
    """Return a part that tells later, by as much more if it does so already."""
    if isinstance(part, DelayedSensor):
        return DelayedSensor(part.sensor, part.delay + leaf("delay")(delay), steps)
    return DelayedSensor(part, delay, steps)


def _parts(sensor: AbstractSensor) -> tuple[AbstractSensor, ...]:
    return sensor.parts if isinstance(sensor, SumSensor) else (sensor,)


def reading(
    sensor: AbstractSensor, plant: AbstractPlant, x: Float[Array, " nx"], t: ArrayLike
) -> Float[Array, " ny"]:
    """Return g(x, t), shape (ny,); raises ValueError where a sensor returns another shape."""
    y = sensor(plant, x, t)
    if getattr(y, "ndim", None) != 1:
        got = getattr(y, "shape", y)
        raise ValueError(f"{type(sensor).__name__}: returned {got}, wanted (ny,)")
    return y


def reading_noise(
    sensor: AbstractSensor, plant: AbstractPlant, x: Float[Array, " nx"], t: ArrayLike
) -> Float[Array, "ny nv"]:
    """Return G(x, t), shape (ny, nv); raises ValueError where it does not fit what is sensed."""
    G, ny = sensor.noise(plant, x, t), num_readings(sensor, plant, x, jnp.asarray(t))
    if getattr(G, "ndim", None) != 2 or G.shape[0] != ny:
        got = getattr(G, "shape", G)
        raise ValueError(f"{type(sensor).__name__}.noise: returned {got}, wanted ({ny}, nv)")
    return G


def num_readings(sensor: AbstractSensor, plant: AbstractPlant, x, t) -> int:
    """Return ny, the number of readings, by tracing the sensor once."""
    return jax.eval_shape(lambda x, t: reading(sensor, plant, x, t), x, t).shape[0]


def _check_positive(**numbers: Array) -> None:
    """Raise ValueError where a standard deviation, a fraction or an interval is known negative."""
    for name, number in numbers.items():
        values = known(number)
        if values is not None and (values < 0).any():
            raise ValueError(f"{name}: at least 0 is wanted, got {number}")


def _moving(position, velocity, position_sd, velocity_sd, velocity_fraction, interval) -> Array:
    """Return the intensities of a position (n,) and a velocity (n,), shape (2 n, 3 n)."""
    n, scale = position.size, jnp.sqrt(interval)
    zero = jnp.zeros((n, n), position.dtype)

    def diagonal(values):
        return jnp.diag(jnp.broadcast_to(scale * values, (n,)))

    still = (diagonal(position_sd), zero, zero)
    moving = (zero, diagonal(velocity_sd), diagonal(velocity_fraction * velocity))
    return jnp.block([list(still), list(moving)])


class JointSensor(AbstractSensor):
    """Angles and velocities of an arm's joints, y = (q, dq), as muscle spindles tell them.

    The noise of a velocity has a part in proportion to it; that of an angle has none, since an
    angle's zero is arbitrary.

    Arguments:
        angle_sd: standard deviation of one sample of an angle [rad], scalar or (num_joints,).
        velocity_sd: that of a velocity at rest [rad/s].
        velocity_fraction: what is added to it, as a part of the velocity [1].
        interval: time between samples of these standard deviations [s]; over any time step the
            intensities sd sqrt(interval) are the same.

    Raises ValueError for negative numbers, and TypeError at the call for a plant without joints.
    """

    angle_sd: Array = eqx.field(converter=leaf("angle_sd"), default=0.01)
    velocity_sd: Array = eqx.field(converter=leaf("velocity_sd"), default=0.1)
    velocity_fraction: Array = eqx.field(converter=leaf("velocity_fraction"), default=0.1)
    interval: Array = eqx.field(converter=leaf("interval"), default=0.01)

    def __check_init__(self):
        _check_positive(
            angle_sd=self.angle_sd,
            velocity_sd=self.velocity_sd,
            velocity_fraction=self.velocity_fraction,
            interval=self.interval,
        )

    def __call__(self, plant, x, t):
        """Return (q, dq), shape (2 num_joints,)."""
        if not isinstance(plant, AbstractArm):
            raise TypeError(f"JointSensor: an arm is wanted, got {type(plant).__name__}")
        return x[: 2 * plant.num_joints]

    def noise(self, plant, x, t):
        """Return the intensities, shape (2 n, 3 n) for n joints."""
        q, dq = jnp.split(self(plant, x, t), 2)
        return _moving(
            q, dq, self.angle_sd, self.velocity_sd, self.velocity_fraction, self.interval
        )


class HandSensor(AbstractSensor):
    """Position and velocity of the hand, y = (p, dp), as the eyes tell them.

    Arguments:
        position_sd: standard deviation of one sample of a coordinate [m], scalar or (dim,).
        velocity_sd: that of a velocity at rest [m/s].
        velocity_fraction: what is added to it, as a part of the velocity [1].
        interval: as in `JointSensor` [s].

    Raises ValueError for negative numbers, and TypeError at the call for a plant without a hand.
    """

    position_sd: Array = eqx.field(converter=leaf("position_sd"), default=0.005)
    velocity_sd: Array = eqx.field(converter=leaf("velocity_sd"), default=0.05)
    velocity_fraction: Array = eqx.field(converter=leaf("velocity_fraction"), default=0.1)
    interval: Array = eqx.field(converter=leaf("interval"), default=0.01)

    def __check_init__(self):
        _check_positive(
            position_sd=self.position_sd,
            velocity_sd=self.velocity_sd,
            velocity_fraction=self.velocity_fraction,
            interval=self.interval,
        )

    def __call__(self, plant, x, t):
        """Return (p, dp), shape (2 dim,)."""
        if not isinstance(plant, AbstractHand):
            raise TypeError(f"HandSensor: a plant with a hand is wanted, got {type(plant)}")
        return jnp.concatenate([plant.hand(x), plant.hand_velocity(x)])

    def noise(self, plant, x, t):
        """Return the intensities, shape (2 dim, 3 dim)."""
        p, dp = jnp.split(self(plant, x, t), 2)
        return _moving(
            p, dp, self.position_sd, self.velocity_sd, self.velocity_fraction, self.interval
        )


def _constant(intensity: Array, y: Float[Array, " ny"]) -> Float[Array, "ny nv"]:
    """Return constant intensities as a matrix; raises ValueError for another shape."""
    if intensity.ndim < 2 and intensity.shape in ((), y.shape):
        return jnp.diag(jnp.broadcast_to(intensity, y.shape))
    if intensity.ndim != 2 or intensity.shape[0] != y.size:
        raise ValueError(
            f"intensity: shape {intensity.shape}, wanted (), ({y.size},) or ({y.size}, nv)"
        )
    return intensity


class LinearSensor(AbstractSensor):
    """Linear readings with constant noise, y = F x + G eta / sqrt(dt).

    Arguments:
        matrix: F, shape (ny, nx).
        intensity: G [unit of y times s^(1/2)], scalar or (ny,) for independent readings, or a
            matrix (ny, nv).

    Raises ValueError for a negative intensity, and at the call for shapes that do not fit.
    """

    matrix: Float[Array, "ny nx"] = eqx.field(converter=leaf("matrix"))
    intensity: Array = eqx.field(converter=leaf("intensity"))

    def __check_init__(self):
        if self.intensity.ndim < 2:
            _check_positive(intensity=self.intensity)

    def __call__(self, plant, x, t):
        """Return F x, shape (ny,)."""
        if self.matrix.ndim != 2 or self.matrix.shape[1] != plant.nx:
            raise ValueError(f"matrix: shape {self.matrix.shape}, wanted (ny, {plant.nx})")
        return self.matrix @ x

    def noise(self, plant, x, t):
        """Return G, shape (ny, nv)."""
        return _constant(self.intensity, self(plant, x, t))


class FunctionSensor(AbstractSensor):
    """A sensor made of a plain function, with constant noise.

    `function(x, t)`, or `function(x, t, params)` when `params` is given, returns what is sensed,
    shape (ny,). What the function depends on is treated as in `FunctionPlant`.

    Arguments:
        function: the function above.
        intensity: as in `LinearSensor`.
        params: as in `FunctionPlant`.

    Raises ValueError for a negative intensity, and at the call for shapes that do not fit.
    """

    function: Callable
    intensity: Array
    params: Any

    def __init__(self, function: Callable, intensity: ArrayLike, *, params: Any = None):
        self.function = check_function("function", function)
        self.intensity = leaf("intensity")(intensity)
        self.params = as_params(params)

    def __check_init__(self):
        if self.intensity.ndim < 2:
            _check_positive(intensity=self.intensity)

    def __call__(self, plant, x, t):
        """Return function(x, t[, params]), shape (ny,)."""
        if self.params is None:
            return self.function(x, t)
        return self.function(x, t, self.params)

    def noise(self, plant, x, t):
        """Return G, shape (ny, nv)."""
        return _constant(self.intensity, self(plant, x, t))
