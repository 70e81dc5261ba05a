"""The path of least jerk, against a dense program in a basis of splines and numerical integrals."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from scipy.interpolate import BSpline

import jaxctrl as jc
from jaxctrl.models import jerk_cost, minimum_jerk, passing_times

START, TARGET, T = np.array([-0.02, 0.44]), np.array([-0.1, 0.53]), 0.6
POINTS, TIMES = np.array([[0.02, 0.48], [-0.05, 0.54]]), np.array([0.17, 0.41])
TS = np.linspace(0, T, 121)


def program(points, times, pieces=12):
    """Least squares of the third derivative of a quintic spline, with the ends and points held.

    In the time t/T, with knots at the times of the points too, so that the optimum is a spline.
    """
    times = times / T
    inner = np.unique(np.round(np.concatenate([np.linspace(0, 1, pieces + 1), times]), 12))
    knots = np.concatenate([5 * [0.0], inner, 5 * [1.0]])
    n = len(knots) - 6
    basis = [BSpline(knots, row, 5) for row in np.eye(n)]
    third = [b.derivative(3) for b in basis]
    nodes, weights = np.polynomial.legendre.leggauss(4)
    mid, half = (inner[1:] + inner[:-1]) / 2, np.diff(inner) / 2
    t = (mid[:, None] + half[:, None] * nodes).ravel()
    w = (half[:, None] * weights).ravel()
    jerk = np.stack([b(t) for b in third])
    H = (jerk * w) @ jerk.T
    rows, values = [], []
    for at, position in ((0.0, START), (1.0, TARGET)):
        for order in range(3):
            scale = 10.0**-order
            rows.append([scale * b.derivative(order)(at) if order else b(at) for b in basis])
            values.append(position if order == 0 else np.zeros(2))
    for at, position in zip(times, points, strict=True):
        rows.append([b(at) for b in basis])
        values.append(position)
    A, values = np.array(rows), np.array(values)
    scale = 1 / np.abs(H).max()
    kkt = np.block([[scale * H, A.T], [A, np.zeros((len(A), len(A)))]])
    c = np.linalg.solve(kkt, np.concatenate([np.zeros((n, 2)), values]))[:n]
    return BSpline(knots, c, 5), 0.5 * np.sum(c * (H @ c)) / T**5


@pytest.mark.parametrize("m", [0, 1, 2])
def test_it_is_the_minimum_over_splines_through_the_points(m):
    points, times = POINTS[:m], TIMES[:m]
    spline, cost = program(points, times)
    path = minimum_jerk(START, TARGET, T, TS, points=points, times=times)
    np.testing.assert_allclose(path.position, spline(TS / T), atol=1e-9)
    np.testing.assert_allclose(path.velocity, spline.derivative()(TS / T) / T, atol=1e-7)
    np.testing.assert_allclose(jerk_cost(START, TARGET, T, points, times), cost, rtol=1e-8)


def test_without_points_it_is_the_polynomial_of_flash_and_hogan():
    path = minimum_jerk(START, TARGET, T, TS)
    s = TS[:, None] / T
    wanted = START + (TARGET - START) * (10 * s**3 - 15 * s**4 + 6 * s**5)
    np.testing.assert_allclose(path.position, wanted, atol=1e-12)
    speed = np.linalg.norm(path.velocity, axis=1)
    distance = np.linalg.norm(TARGET - START)
    np.testing.assert_allclose(speed.max(), 1.875 * distance / T, rtol=1e-10)
    assert speed.argmax() == 60
    np.testing.assert_allclose(
        jerk_cost(START, TARGET, T, np.zeros((0, 2)), np.zeros(0)),
        0.5 * 720 * distance**2 / T**5,
        rtol=1e-9,
    )


@pytest.mark.parametrize("m", [1, 2])
def test_it_passes_the_points_smoothly_and_starts_and_ends_at_rest(m):
    points, times, h = POINTS[:m], TIMES[:m], 1e-7
    at = np.concatenate([[0.0, T], times])
    path = minimum_jerk(START, TARGET, T, at, points=points, times=times)
    np.testing.assert_allclose(path.position, [START, TARGET, *points], atol=1e-10)
    np.testing.assert_allclose(path.velocity[:2], 0, atol=1e-10)
    np.testing.assert_allclose(path.acceleration[:2], 0, atol=1e-8)
    before = minimum_jerk(START, TARGET, T, times - h, points=points, times=times)
    after = minimum_jerk(START, TARGET, T, times + h, points=points, times=times)
    np.testing.assert_allclose(before.acceleration, after.acceleration, atol=1e-4)
    np.testing.assert_allclose(before.jerk, after.jerk, atol=1e-2)


def test_velocity_acceleration_and_jerk_are_derivatives_of_the_position():
    path = minimum_jerk(START, TARGET, T, TS, points=POINTS, times=TIMES)
    for value, slope in itertools.pairwise(path):
        integral = scipy.integrate.cumulative_simpson(slope, x=TS, axis=0, initial=0)
        size = np.abs(value).max()
        np.testing.assert_allclose(value - value[0], integral, atol=2e-4 * size)


@pytest.mark.parametrize("m", [1, 2])
def test_the_jerk_cost_is_the_integral_of_the_jerk(m):
    points, times = POINTS[:m], TIMES[:m]
    ends = np.concatenate([[0.0], times, [T]])
    total = 0.0
    for a, b in itertools.pairwise(ends):
        t = np.linspace(a, b, 401)[:-1]  # at its end the next piece begins
        t = np.append(t, b - 1e-12)
        jerk = minimum_jerk(START, TARGET, T, t, points=points, times=times).jerk
        total += scipy.integrate.simpson(0.5 * np.sum(np.asarray(jerk) ** 2, axis=1), x=t)
    np.testing.assert_allclose(jerk_cost(START, TARGET, T, points, times), total, rtol=1e-8)


def test_a_point_in_the_middle_is_passed_at_half_time():
    for aside in (0.0, 0.05):
        across = np.array([-(TARGET - START)[1], (TARGET - START)[0]])
        middle = (START + TARGET) / 2 + aside * across / np.linalg.norm(across)
        np.testing.assert_allclose(passing_times(START, TARGET, T, [middle]), T / 2, atol=1e-6)


def test_passing_times_are_stationary_and_the_least_on_a_grid():
    found = passing_times(START, TARGET, T, POINTS)
    cost = jax.jit(lambda times: jerk_cost(START, TARGET, T, POINTS, times))
    least, slope = cost(found), jax.grad(cost)(jnp.asarray(found))
    scale = float(least) / T
    print("passing times", found, "relative slope", np.abs(slope).max() / scale)
    assert np.abs(slope).max() < 1e-5 * scale
    grid = np.linspace(0.05, T - 0.05, 26)
    others = [cost(jnp.array([a, b])) for a in grid for b in grid if b > a + 0.02]
    assert min(others) >= least * (1 - 1e-9)


def test_times_scale_with_the_duration_and_not_with_the_size():
    found = passing_times(START, TARGET, T, POINTS)
    np.testing.assert_allclose(passing_times(START, TARGET, 2 * T, POINTS), 2 * found, rtol=1e-6)
    larger = passing_times(3 * START, 3 * TARGET, T, 3 * POINTS)
    np.testing.assert_allclose(larger, found, rtol=1e-5)


def test_derivatives_by_times_duration_and_points_are_differences():
    h = 1e-6

    @jax.jit
    def cost(times, duration, points):
        return jerk_cost(START, TARGET, duration, points, times)

    at = (jnp.asarray(TIMES), jnp.asarray(T), jnp.asarray(POINTS))
    slopes = jax.grad(cost, argnums=(0, 1, 2))(*at)
    for i, (value, slope) in enumerate(zip(at, slopes, strict=True)):
        for index in np.ndindex(value.shape):
            moved = [list(at), list(at)]
            for sign, arguments in zip((1, -1), moved, strict=True):
                arguments[i] = value.at[index].add(sign * h)
            difference = (cost(*moved[0]) - cost(*moved[1])) / (2 * h)
            np.testing.assert_allclose(slope[index], difference, rtol=1e-6)


def test_it_works_under_jit_and_vmap():
    def middle(times, duration):
        ts = jnp.array([0.1, 0.3, 0.5])
        return minimum_jerk(START, TARGET, duration, ts, points=POINTS, times=times).position

    batch = jnp.stack([jnp.asarray(TIMES), jnp.array([0.2, 0.3])])
    lanes = jax.jit(jax.vmap(middle, in_axes=(0, None)))(batch, T)
    for times, lane in zip(batch, lanes, strict=True):
        np.testing.assert_allclose(lane, middle(times, T), rtol=1e-10)
    path = jax.jit(lambda ts: minimum_jerk(START, TARGET, T, ts))(jnp.asarray(TS))
    np.testing.assert_allclose(path.jerk, minimum_jerk(START, TARGET, T, TS).jerk, rtol=1e-8)


def test_float32_stays_float32(float32):
    path = minimum_jerk(START, TARGET, T, TS, points=POINTS, times=TIMES)
    assert all(part.dtype == jnp.float32 for part in path)
    assert jerk_cost(START, TARGET, T, POINTS, TIMES).dtype == jnp.float32
    np.testing.assert_allclose(path.position[-1], TARGET, atol=1e-4)
    np.testing.assert_allclose(passing_times(START, TARGET, T, POINTS), [0.21, 0.4], atol=0.1)


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: minimum_jerk(START, TARGET, T, TS, points=POINTS), "^times: wanted together"),
        (
            lambda: minimum_jerk(START, TARGET, T, TS, points=POINTS, times=TIMES[::-1]),
            "^times: increasing times between 0 and 0.6 s are wanted",
        ),
        (lambda: jerk_cost(START, TARGET, T, POINTS, [0.2, 0.7]), "^times: increasing times"),
        (lambda: jerk_cost(START, TARGET, T, POINTS, [0.2]), r"^points: got shape \(2, 2\)"),
        (lambda: minimum_jerk([0.0, 0.1, 0.2], TARGET, T, TS), r"^start: got shape \(3,\)"),
        (lambda: minimum_jerk(START, TARGET, -1.0, TS), "^times: increasing|^duration"),
        (lambda: passing_times(START, TARGET, T, [0.1, 0.2]), r"^points: got shape \(2,\)"),
        (lambda: passing_times([0.0, 0.1, 0.2], TARGET, T, POINTS), r"^start: got shape \(3,\)"),
        (lambda: passing_times(START, [np.nan, 0.1], T, POINTS), "^target: not finite"),
        (lambda: passing_times(START, TARGET, -1.0, POINTS), "^duration: a positive time"),
    ],
)
def test_misuse_is_named(call, match):
    with pytest.raises(ValueError, match=match):
        call()


# The same as an optimal control problem.


@pytest.mark.parametrize("m", [0, 1, 2])
def test_the_model_solves_to_the_closed_form_in_one_step(m):
    arm, steps = jc.plants.TorqueArm(), 60
    x0 = arm.at_rest(0.785, 1.571)
    points, times = POINTS[:m], np.array([0.17, 0.41])[:m]  # on the grid of 10 ms
    if m:
        task = jc.tasks.via(arm, TARGET, points, times, T, num_steps=steps)
    else:
        task = jc.tasks.reach(arm, TARGET, T, num_steps=steps)
    model = jc.models.MinimumJerk()
    problem, begin = model.problem(task), model.start(task, x0)
    solution = jc.solve(problem, jc.ILQR(), begin)
    assert solution.status.ok and int(solution.num_steps) == 1
    via = {"points": points, "times": times} if m else {}
    path = minimum_jerk(arm.hand(x0), TARGET, T, task.ts, **via)
    error = np.abs(np.asarray(solution.xs[:, :2]) - path.position).max()
    speeds = np.linalg.norm(solution.xs[:, 2:4], axis=1)
    wanted = np.linalg.norm(path.velocity, axis=1)
    print(f"{m} points: {1e6 * error:.3f} um, {np.abs(speeds - wanted).max():.2g} m/s")
    assert error < 1e-6
    np.testing.assert_allclose(speeds, wanted, atol=2e-5)
    if m == 0:
        distance = np.linalg.norm(TARGET - np.asarray(arm.hand(x0)))
        np.testing.assert_allclose(speeds.max(), 1.875 * distance / T, atol=1e-6)
