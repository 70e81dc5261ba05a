"""The path of least jerk in closed form, through via-points, at given or at free passing times."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, ArrayLike, Float

from .._checks import check_array, is_concrete

_POWERS = range(6)


class Path(NamedTuple):
    """A path of the hand at given times, each array (n, 2).

    Fields: position [m], velocity [m/s], acceleration [m/s^2], jerk [m/s^3].
    """

    position: Float[Array, "n 2"]
    velocity: Float[Array, "n 2"]
    acceleration: Float[Array, "n 2"]
    jerk: Float[Array, "n 2"]


def minimum_jerk(
    start: Float[ArrayLike, "2"],
    target: Float[ArrayLike, "2"],
    duration: ArrayLike,
    ts: Float[ArrayLike, " n"],
    *,
    points: Float[ArrayLike, "m 2"] | None = None,
    times: Float[ArrayLike, " m"] | None = None,
) -> Path:
    """Return the path of least jerk from rest to rest, through via-points at given times.

    e = e_0 + (e_T - e_0)(10 s^3 - 15 s^4 + 6 s^5), s = t/T, without via-points: straight, with a
    peak speed of 1.875 |e_T - e_0|/T at T/2. Through m points it is a polynomial of fifth degree on
    each of m + 1 pieces, continuous up to its fourth derivative: 6 (m + 1) linear equations for
    each coordinate (Flash & Hogan 1985).

    Arguments:
        start, target: e_0 and e_T [m], each (2,). duration: T [s].
        ts: times [s] at which to evaluate the path, shape (n,), within 0 and T.
        points, times: e_i [m], shape (m, 2), and t_i [s], shape (m,), increasing within the
            duration; `passing_times` finds those of least jerk.

    Returns: `Path`. Works under jit, vmap and grad.

    Raises ValueError or TypeError, naming the argument, for wrong shapes and for times out of
    order where they are known.
    """
    start, target = check_array("start", start, (2,)), check_array("target", target, (2,))
    duration = check_array("duration", duration, ())
    ts = check_array("ts", ts, (np.size(ts),))
    points, times = _check_via(points, times, duration)
    if is_concrete(ts, duration) and ts.size:
        known, last = np.asarray(ts), float(np.asarray(duration))
        if known.min() < -1e-9 * last or known.max() > last * (1 + 1e-6):
            raise ValueError(
                f"ts: times from 0 to {last:g} s are wanted, got up to {known.max():g}"
            )
    return Path(*_evaluate(start, target, duration, ts, points, times))


@jax.jit
def _evaluate(start, target, duration, ts, points, times):
    """Return position, velocity, acceleration and jerk, each (n, 2)."""
    coefficients = _coefficients(start, target, points, times / duration)
    piece = jnp.searchsorted(times, ts, side="right") if times.size else jnp.zeros(ts.shape, int)
    s = ts / duration

    def evaluate(order):
        row = jax.vmap(lambda s: _row(s, order))(s) / duration**order
        return jnp.einsum("np,npc->nc", row, coefficients[piece])

    return [evaluate(order) for order in range(4)]


def _check_via(points, times, duration):
    if (points is None) != (times is None):
        raise ValueError("times: wanted together with `points`, for each of them")
    m = 0 if times is None else np.size(times)
    points = check_array("points", jnp.zeros((0, 2)) if points is None else points, (m, 2))
    times = check_array("times", jnp.zeros((0,)) if times is None else times, (m,))
    if is_concrete(times, duration):
        inner = np.concatenate([[0.0], np.asarray(times), [float(duration)]])
        if not (np.diff(inner) > 0).all():
            raise ValueError(
                f"times: increasing times between 0 and {duration} s are wanted, got {times}"
            )
    return points, times


def _row(s, order):
    """Return the derivatives of 1, s ... s^5 of some order at s, shape (6,)."""
    entries = []
    for power in _POWERS:
        factor = float(np.prod(np.arange(power - order + 1, power + 1))) if power >= order else 0.0
        entries.append(factor * s ** max(power - order, 0))
    return jnp.stack([jnp.asarray(entry, jnp.result_type(s)) for entry in entries])


def _coefficients(start, target, points, passing):
    """Return the coefficients in s = t/T of each piece, shape (m + 1, 6, 2)."""
    m = passing.size
    size = 6 * (m + 1)
    dtype = jnp.result_type(start, passing)
    zero = jnp.zeros((2,), dtype)
    rows, values = [], []

    def add(piece, row, value):
        line = jnp.zeros((size,), dtype)
        for i, part in zip(piece, row, strict=True):
            line = line.at[6 * i : 6 * i + 6].add(part)
        rows.append(line)
        values.append(value)

    for piece, s, position in ((0, 0.0, start), (m, 1.0, target)):
        for order in range(3):
            add([piece], [_row(jnp.asarray(s, dtype), order)], position if order == 0 else zero)
    for i in range(m):
        here = _row(passing[i], 0)
        add([i], [here], points[i])
        add([i + 1], [here], points[i])
        for order in range(1, 5):
            row = _row(passing[i], order)
            add([i, i + 1], [row, -row], zero)
    solved = jnp.linalg.solve(jnp.stack(rows), jnp.stack(values))
    return solved.reshape(m + 1, 6, 2)


def jerk_cost(
    start: Float[ArrayLike, "2"],
    target: Float[ArrayLike, "2"],
    duration: ArrayLike,
    points: Float[ArrayLike, "m 2"],
    times: Float[ArrayLike, " m"],
) -> Float[Array, ""]:
    """Return int |d^3 e/dt^3|^2 dt/2 [m^2/s^5] of the path of least jerk, shape ().

    Arguments as in `minimum_jerk`: start, target (2,), duration (), points (m, 2), times (m,).
    Works under jit, vmap and grad, which gives its derivatives by the passing times. Raises as
    `minimum_jerk` does.
    """
    start, target = check_array("start", start, (2,)), check_array("target", target, (2,))
    duration = check_array("duration", duration, ())
    points, times = _check_via(points, times, duration)
    return _jerk_cost(start, target, duration, points, times)


@jax.jit
def _jerk_cost(start, target, duration, points, times):
    passing = times / duration
    coefficients = _coefficients(start, target, points, passing)
    ends = jnp.concatenate([jnp.zeros((1,)), passing, jnp.ones((1,))]).astype(passing.dtype)
    # The jerk is quadratic in s, its square of fourth degree: Gauss's three points are exact.
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = jnp.diff(ends) / 2
    s = ends[:-1, None] + half[:, None] * (1 + nodes)
    jerk = jnp.einsum("mgp,mpc->mgc", jax.vmap(jax.vmap(lambda s: _row(s, 3)))(s), coefficients)
    return 0.5 * jnp.sum(half[:, None] * weights * jnp.sum(jerk**2, axis=-1)) / duration**5


def passing_times(
    start: Float[ArrayLike, "2"],
    target: Float[ArrayLike, "2"],
    duration: float,
    points: Float[ArrayLike, "m 2"],
) -> np.ndarray:
    """Return the times [s], shape (m,), at which the path of least jerk passes its via-points.

    With the times free the jerk cost is least over them (Flash & Hogan 1985): minimised by SciPy's
    SLSQP from times in proportion to the distances, with the exact gradient.

    Arguments as in `minimum_jerk`: start, target (2,), duration (), points (m, 2).

    Raises ValueError as `minimum_jerk` does, and when the minimisation fails.
    """
    m = np.shape(points)[0] if np.ndim(points) == 2 else 1
    points = check_array("points", points, (m, 2), "one row for each via-point")
    start, target = check_array("start", start, (2,)), check_array("target", target, (2,))
    if not float(check_array("duration", duration, ())) > 0:
        raise ValueError(f"duration: a positive time [s] is wanted, got {duration}")
    corners = np.concatenate([start[None], points, target[None]], dtype=float)
    lengths = np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))
    guess = np.clip(lengths[:-1] / max(lengths[-1], 1e-12), 0.05, 0.95)
    scale = float(jerk_cost(start, target, 1.0, points, _spread(guess)))

    @jax.jit
    def cost(passing):
        return jax.value_and_grad(lambda p: jerk_cost(start, target, 1.0, points, p))(passing)

    def scaled(passing):
        value, slope = cost(jnp.asarray(passing))
        return float(value) / scale, np.asarray(slope, float) / scale

    gaps = np.eye(m + 1, m) - np.eye(m + 1, m, -1)
    offset = np.append(np.zeros(m), 1.0)
    found = scipy.optimize.minimize(
        scaled,
        _spread(guess),
        jac=True,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda p: gaps @ p + offset - 0.01,
            "jac": lambda p: gaps,
        },
        options={"ftol": 1e-14, "maxiter": 200},
    )
    if not found.success:
        raise ValueError(f"points: no passing times of least jerk were found: {found.message}")
    return float(duration) * found.x


def _spread(guess: np.ndarray) -> np.ndarray:
    """Return increasing times at least 0.02 apart, and from 0 and 1, near a guess (m,)."""
    m = guess.size
    even = np.arange(1, m + 1) / (m + 1)
    gaps = np.diff(np.concatenate([[0.0], guess, [1.0]]))
    return guess if (gaps > 0.02).all() else even
