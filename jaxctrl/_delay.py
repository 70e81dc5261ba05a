"""Sensors that tell late: what has to be remembered of the past, and what is told of it.

A delay need not be a whole number of steps. Of the states of the last steps those numbers are kept
that some delayed part depends on; what is told, and how noisy it is, is interpolated between the
two states that lie around the delay. Noise is drawn when it is told: interpolated readings would
have less of it, by up to a half, for no reason but the time step.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._checks import is_concrete
from ._jacobian import dependence
from ._plant import AbstractPlant
from ._sensor import AbstractSensor, DelayedSensor, SumSensor, reading, reading_noise

ROUNDING = 1e-6
"""A delay this much of a step beyond its buffer still lies at its end."""


def delayed(sensor: AbstractSensor | None) -> bool:
    """Tell whether any part of a sensor tells late."""
    return sensor is not None and any(isinstance(p, DelayedSensor) for p in _parts(sensor))


def _parts(sensor: AbstractSensor) -> tuple[AbstractSensor, ...]:
    return sensor.parts if isinstance(sensor, SumSensor) else (sensor,)


def with_buffers(sensor: AbstractSensor | None, dt: Array, num_steps: int) -> AbstractSensor | None:
    """Return the sensor, each delayed part with as many steps of buffer as its delay needs.

    Raises ValueError for a delay beyond the movement or beyond its buffer, where these are known,
    and where the buffer's length would depend on a traced value.
    """
    if not delayed(sensor):
        return sensor
    assert sensor is not None
    whole = tuple(_buffered(part, dt, num_steps) for part in _parts(sensor))
    return SumSensor(whole) if isinstance(sensor, SumSensor) else whole[0]


def _buffered(part: AbstractSensor, dt: Array, num_steps: int) -> AbstractSensor:
    if not isinstance(part, DelayedSensor):
        return part
    if not is_concrete(part.delay, dt):
        if part.steps is None:
            raise ValueError(
                "sensor: its delay or the time step is traced, so that the length of the buffer "
                "is not known: give it, sensor.delayed(delay, steps=...)"
            )
        return part
    delay, each = float(part.delay), float(dt)
    steps = max(1, math.ceil(delay / each - ROUNDING)) if part.steps is None else part.steps
    if delay > steps * each * (1 + ROUNDING):
        raise ValueError(f"sensor: a delay of {delay:g} s is beyond its buffer of {steps} steps")
    if steps > num_steps:
        raise ValueError(
            f"sensor: a buffer of {steps} steps, for a delay of {delay:g} s, is longer than the "
            f"movement of {num_steps} steps"
        )
    return DelayedSensor(part.sensor, part.delay, steps)


def _late(sensor: AbstractSensor) -> list[DelayedSensor]:
    return [part for part in _parts(sensor) if isinstance(part, DelayedSensor)]


def _length(sensor: AbstractSensor) -> int:
    """Return how many steps are remembered."""
    return max((part.steps or 0 for part in _late(sensor)), default=0)


def _seen(sensor: AbstractSensor, plant: AbstractPlant, x, t) -> np.ndarray:
    """Return which entries of a state (nx,) some delayed part depends on, as an index (m,)."""
    seen = np.zeros(x.shape[0], bool)
    for part in _late(sensor):

        def flat(x, t, inner=part.sensor):
            G = reading_noise(inner, plant, x, t).reshape(-1)
            return jnp.concatenate([reading(inner, plant, x, t), G])

        seen |= dependence(flat, x, t).any(axis=0)
    return np.flatnonzero(seen)


def unchanged(sensor: AbstractSensor, plant: AbstractPlant, x, t) -> Float[Array, " m"]:
    """Return what is remembered (m,) of a state x (nx,) that has lasted; t is any time."""
    return jnp.tile(x[_seen(sensor, plant, x, t)], _length(sensor))


def shifted(
    sensor: AbstractSensor, plant: AbstractPlant, past: Float[Array, " m"], x, t
) -> Float[Array, " m"]:
    """Return what is remembered (m,) one step later, of x (nx,) and what was before, (m,)."""
    now = x[_seen(sensor, plant, x, t)]
    return jnp.concatenate([now, past])[: past.size]


def told(
    sensor: AbstractSensor, plant: AbstractPlant, past: Float[Array, " m"], x, t, dt: ArrayLike
) -> tuple[Float[Array, " ny"], Float[Array, "ny nv"]]:
    """Return what is told of x (nx,) and the past (m,), without noise, and its intensities."""
    seen = _seen(sensor, plant, x, t)
    table = jnp.concatenate([x[seen], past]).reshape(-1, max(seen.size, 1))
    ys, Gs = [], []
    for part in _parts(sensor):
        if not isinstance(part, DelayedSensor):
            ys.append(reading(part, plant, x, t))
            Gs.append(reading_noise(part, plant, x, t))
            continue
        inner, (lower, fraction) = part.sensor, _place(part, dt)
        around = []
        for i in (lower, lower + 1):
            then = jnp.sum((jnp.arange(len(table)) == i)[:, None] * table, axis=0)
            before = x.at[seen].set(then[: seen.size])
            when = t - i * dt
            around.append(
                (reading(inner, plant, before, when), reading_noise(inner, plant, before, when))
            )
        (y, G), (y_, G_) = around
        ys.append(y + fraction * (y_ - y))
        Gs.append(G + fraction * (G_ - G))
    return jnp.concatenate(ys), jax.scipy.linalg.block_diag(*Gs)


def _place(part: DelayedSensor, dt: ArrayLike) -> tuple[Array, Array]:
    """Return between which steps before now a delay lies: the later, and the fraction beyond it.

    The fraction is NaN outside the buffer. Derivatives are one-sided at whole steps: from the left
    at the buffer's end, elsewhere from the right.
    """
    assert part.steps is not None
    steps = part.delay / dt
    lower = jnp.clip(jnp.floor(jax.lax.stop_gradient(steps)), 0, part.steps - 1)
    inside = (steps >= 0) & (steps <= part.steps * (1 + ROUNDING))
    return lower, jnp.where(inside, steps - lower, jnp.nan)
