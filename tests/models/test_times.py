"""Optimal durations and passing times, against scans, differences and the closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.models import MinimumJerk, passing_times
from jaxctrl.models._times import with_times

TARGET, POINT = jnp.array([-0.1, 0.53]), jnp.array([[0.02, 0.48]])
TIGHT = jc.DDP(gradient_tolerance=1e-9)
PRICE = 1e-5


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(0.785, 1.571)


@pytest.fixture(scope="module")
def reach(arm):
    return jc.tasks.reach(arm, TARGET, 0.5, num_steps=20)


@pytest.fixture(scope="module")
def via(arm):
    return jc.tasks.via(arm, TARGET, POINT, [0.218], 0.5, num_steps=20)


@eqx.filter_jit
def _cost(problem, x0, us, solver, duration, times):
    solution = jc.solve(with_times(problem, duration, times), solver, x0, us)
    return solution.cost, solution.status.ok


def cost(problem, x0, duration, times=(), us=None):
    """The optimal cost for given times."""
    us = problem.nominal_controls if us is None else us
    times = jnp.asarray(times, float).reshape(-1)
    value, ok = _cost(problem, x0, us, TIGHT, jnp.asarray(duration), times)
    assert ok
    return float(value)


def test_the_duration_is_the_minimum_of_a_scan(reach, x0):
    found = jc.optimise_times(reach, TIGHT, x0, duration=(0.2, 3.0), price=PRICE)
    scan = {T: cost(reach, x0, T) + PRICE * T for T in np.linspace(0.2, 3.0, 57)}
    best = min(scan, key=scan.get)
    around = np.linspace(best - 0.05, best + 0.05, 21)
    least = min(cost(reach, x0, T) + PRICE * T for T in around)
    print(f"{found}\nscan: {best:.3f} s, {least:.10g}; {found.value / least - 1:.2g}")
    assert found.ok and abs(found.duration - best) < 0.05
    assert least * (1 - 1e-5) < found.value <= least * (1 + 1e-9)
    np.testing.assert_allclose(found.value, min(found.history), rtol=1e-9)
    np.testing.assert_allclose(found.problem.duration, found.duration, rtol=1e-12)
    np.testing.assert_allclose(
        found.value, float(found.solution.cost) + PRICE * found.duration, rtol=1e-12
    )
    assert "converged" in str(found) and found.times.size == 0


def test_a_dearer_second_makes_a_shorter_movement(reach, x0):
    prices = (1e-6, 1e-5, 1e-4)
    found = [jc.optimise_times(reach, TIGHT, x0, duration=(0.1, 4.0), price=p) for p in prices]
    durations = [f.duration for f in found]
    assert all(f.ok for f in found) and durations[0] > durations[1] > durations[2]
    # At the optimum the last second saved costs its price.
    for p, f in zip(prices, found, strict=True):
        h = 1e-4 * f.duration
        slope = (cost(reach, x0, f.duration + h) - cost(reach, x0, f.duration - h)) / (2 * h)
        np.testing.assert_allclose(slope, -p, rtol=2e-2)


def test_a_bound_on_the_duration_holds(reach, x0):
    found = jc.optimise_times(reach, TIGHT, x0, duration=(0.3, 0.6), price=PRICE)
    assert found.ok and abs(found.duration - 0.6) < 1e-9


def differences(problem, x0, duration, times, us, step=2e-5):
    """Central differences of the optimal cost in the duration and in each time."""
    variables = np.array([duration, *times])
    slopes = []
    for i in range(variables.size):
        h = np.eye(variables.size)[i] * step
        high, low = variables + h, variables - h
        slopes.append(
            (cost(problem, x0, high[0], high[1:], us) - cost(problem, x0, low[0], low[1:], us))
            / (2 * step)
        )
    return np.array(slopes)


def derivatives(problem, x0, duration, times, us):
    def value(T, times):
        solution = jc.solve(with_times(problem, T, times), TIGHT, x0, us)
        return solution.cost, solution

    (_, solution), slopes = jax.jit(jax.value_and_grad(value, argnums=(0, 1), has_aux=True))(
        jnp.asarray(duration), jnp.asarray(times)
    )
    assert solution.status.ok
    return np.concatenate([slopes[0][None], slopes[1]]), solution


def _check_slopes(problem, x0):
    times = jnp.array([0.153, 0.318])  # off the grid: the cost is smooth between its points
    slopes, solution = derivatives(problem, x0, 0.5, times, problem.nominal_controls)
    wanted = differences(problem, x0, 0.5, np.asarray(times), solution.us)
    print(slopes, wanted, np.abs(slopes / wanted - 1).max())
    np.testing.assert_allclose(slopes, wanted, rtol=1e-4)


def _two_points(arm, x0):
    points = jnp.array([[0.02, 0.48], [-0.05, 0.54]])
    return jc.tasks.via(arm, TARGET, points, [0.153, 0.318], 0.5, num_steps=25)


def test_derivatives_by_duration_and_times_are_differences_of_solves(arm, x0):
    _check_slopes(_two_points(arm, x0), x0)


@pytest.mark.slow
def test_derivatives_by_duration_and_times_are_differences_of_solves_with_muscles():
    arm = jc.plants.MuscleArm()
    x0 = arm.at_rest(0.785, 1.571)
    _check_slopes(_two_points(arm, x0), x0)


def test_a_passing_time_is_a_minimum_within_one_per_cent_of_the_least(via, x0):
    """The path of an Euler step is linear, so that the cost has a kink at each grid point.

    A kink can be a local minimum: the search ends within one per cent of the best on this grid.
    """
    found = jc.optimise_times(via, TIGHT, x0, passing=True)
    beside = found.times[0] + 0.002 * np.linspace(-1, 1, 9)
    near = min(cost(via, x0, 0.5, [t]) for t in beside)
    far = min(cost(via, x0, 0.5, [t]) for t in np.linspace(0.02, 0.48, 93))
    print(f"{found}\n{found.value / near - 1:.2g} near, {found.value / far - 1:.2g} far")
    assert found.ok and found.duration == 0.5
    assert found.value <= near * (1 + 1e-6) and found.value < 1.01 * far
    assert found.value < 0.9 * cost(via, x0, 0.5, [0.218])


def test_both_may_be_free(via, x0):
    one = jc.optimise_times(via, TIGHT, x0, duration=(0.3, 3.0), price=PRICE)
    both = jc.optimise_times(via, TIGHT, x0, duration=(0.3, 3.0), price=PRICE, passing=True)
    assert one.ok and both.ok
    scan = [cost(via, x0, T, [0.218]) + PRICE * T for T in np.linspace(0.8, 1.6, 33)]
    grid = [
        cost(via, x0, T, [s * T]) + PRICE * T
        for T in np.linspace(1.0, 1.6, 7)
        for s in np.linspace(0.2, 0.5, 13)
    ]
    print(one, both, one.value / min(scan) - 1, both.value / min(grid) - 1, sep="\n")
    assert one.value < 1.04 * min(scan) and both.value < 1.01 * min(grid)
    assert both.value < one.value and both.times[0] != 0.218
    for found in (one, both):
        np.testing.assert_allclose(found.value, min(found.history), rtol=1e-12)
        part = jc.parts(found.problem.cost)[2]
        np.testing.assert_allclose(part.times, found.times)
    np.testing.assert_allclose(one.times, [0.218])
    rebuilt = jc.tasks.via(
        via.plant, TARGET, POINT, both.times, both.duration, num_steps=via.num_steps
    )
    again = jc.solve(rebuilt, TIGHT, x0, both.solution.us)
    np.testing.assert_allclose(again.cost + PRICE * both.duration, both.value, rtol=1e-8)


def test_the_first_change_of_a_time_is_small_and_ends_at_the_best_one(arm, x0):
    """From 0.5 to 3 s in one step, it fell into another optimum, a third dearer."""
    task = jc.tasks.via(arm, TARGET, POINT, [0.218], 0.5, num_steps=50)
    found = jc.optimise_times(task, jc.DDP(), x0, duration=(0.35, 3.0), price=PRICE)
    print(found)
    assert found.ok and found.value < 1.92e-5  # 1.911e-5 in a scan, at 1.2 s


@pytest.mark.parametrize("points", [POINT, jnp.array([[0.02, 0.48], [-0.05, 0.54]])], ids=len)
def test_minimum_jerk_passes_when_the_closed_form_does(arm, x0, points):
    begin = [0.3] if len(points) == 1 else [0.12, 0.4]
    task = jc.tasks.via(arm, TARGET, points, begin, 0.5, num_steps=25)
    model = MinimumJerk()
    found = jc.optimise_times(model.problem(task), jc.ILQR(), model.start(task, x0), passing=True)
    wanted = passing_times(arm.hand(x0), TARGET, 0.5, points)
    print(found, wanted)
    assert found.ok
    np.testing.assert_allclose(found.times, wanted, atol=0.01)


def test_a_tracked_path_is_stretched_with_the_duration(arm, x0):
    path = jnp.stack([arm.hand(x0), arm.hand(x0) + jnp.array([-0.05, 0.05])])
    task = jc.tasks.track(arm, path, 0.5, num_steps=20)
    stretched = with_times(task, jnp.asarray(0.8), jnp.zeros(0))
    wanted = jc.tasks.track(arm, path, 0.8, num_steps=20)
    us = jnp.full((20, 2), 0.1)
    a, b = (p.total_cost(p.rollout(x0, us), us) for p in (stretched, wanted))
    # The last state's weight is the path's times dt, which stays what it was.
    hand = arm.hand(wanted.rollout(x0, us)[-1])
    off = 10.0 * (0.025 - 0.04) * jnp.sum((hand - path[-1]) ** 2)
    np.testing.assert_allclose(a, b + off, rtol=1e-10)


def test_times_in_different_parts_keep_their_order(arm, x0):
    one = jc.tasks.via(arm, TARGET, POINT, [0.1], 0.5, num_steps=20)
    more = jc.tasks.ViaPoints(jnp.zeros((2, 2)), jnp.array([0.2, 0.3]))
    problem = jc.Problem(arm, one.cost + more, num_steps=20, dt=0.025)
    changed = with_times(problem, jnp.asarray(1.0), jnp.array([0.4, 0.5, 0.6]))
    times = [part.times for part in jc.parts(changed.cost) if hasattr(part, "times")]
    np.testing.assert_array_equal(np.concatenate(times), [0.4, 0.5, 0.6])
    np.testing.assert_allclose(changed.dt, 0.05)


class _Via(jc.AbstractEvents):
    times: jax.Array
    points: jax.Array

    def event(self, plant, x, j):
        return 100 * jnp.sum((x[:2] - self.points[j]) ** 2)


@pytest.fixture(scope="module")
def mass():
    """A mass in the plane that is to stop at (1, 0)."""
    plant = jc.FunctionPlant(lambda x, u, t: jnp.stack([x[2], x[3], u[0], u[1]]), nx=4, nu=2)
    goal = jnp.array([1.0, 0, 0, 0])
    cost = jc.FunctionCost(
        lambda x, u, t: 0.01 * jnp.sum(u**2), lambda x: 100 * jnp.sum((x - goal) ** 2)
    )
    return jc.Problem(plant, cost, num_steps=20, dt=0.05)


def test_the_order_of_parts_does_not_matter(mass):
    late = _Via(jnp.array([0.7]), jnp.array([[0.7, 0.2]]))
    early = _Via(jnp.array([0.3]), jnp.array([[0.3, -0.2]]))
    found = [
        jc.optimise_times(problem, jc.DDP(), jnp.zeros(4), passing=True)
        for problem in (mass + early + late, mass + late + early)
    ]
    print(*found, sep="\n")
    assert found[0].ok and found[1].ok
    np.testing.assert_allclose(found[1].value, found[0].value, rtol=1e-3)
    np.testing.assert_allclose(found[1].times[::-1], found[0].times, atol=1e-3)
    assert found[1].times[0] > found[1].times[1]


@pytest.mark.parametrize("times", [[0.5, 0.505], [0.505, 0.5], [0.001, 0.999]])
def test_times_given_too_close_are_never_returned(mass, times):
    """The cheapest trial may be one that is not allowed, as the first one is here."""
    points = jnp.array([[0.5, 0.0], [0.5, 0.0]])
    problem = mass + _Via(jnp.array(times), points)
    found = jc.optimise_times(problem, jc.DDP(), jnp.zeros(4), passing=True)
    print(found, found.history)
    ends = np.concatenate([[0.0], np.sort(found.times), [found.duration]])
    assert found.ok and (np.diff(ends) > 0.02 * found.duration - 1e-5).all()
    assert found.value in found.history


def test_other_times_do_not_compile_again(via, x0):
    from jaxctrl.models import _times

    jc.optimise_times(via, TIGHT, x0, passing=True)
    size = _times._value._cached._cache_size()
    other = jc.tasks.via(via.plant, TARGET - 0.01, POINT, [0.31], 0.7, num_steps=20)
    jc.optimise_times(other, TIGHT, x0, duration=(0.5, 1.0), price=PRICE)
    assert _times._value._cached._cache_size() == size


def test_a_solve_that_fails_is_not_ok(reach, x0):
    us = 1e4 * jnp.ones((20, 2))  # overflows on its way
    found = jc.optimise_times(reach, TIGHT, x0, us, duration=(0.2, 3.0), price=PRICE)
    assert not found.ok and not found.solution.status.ok
    assert "NOT converged" in str(found) and found.message in str(found)


@pytest.mark.slow
def test_float32_finds_the_same_to_a_time_step(float32):
    arm = jc.plants.TorqueArm()
    x0 = arm.at_rest(0.785, 1.571)
    task = jc.tasks.via(arm, [-0.1, 0.53], [[0.02, 0.48]], [0.218], 0.5, num_steps=20)
    found = jc.optimise_times(task, jc.DDP(), x0, passing=True)
    assert found.solution.us.dtype == jnp.float32
    assert abs(found.times[0] - 0.175) < 0.026, found


@pytest.mark.parametrize(
    ("arguments", "error", "match"),
    [
        ({}, ValueError, "^duration, passing: at least one is wanted"),
        ({"duration": (0.5, 0.2)}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": (0.0, 0.2)}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": (0.1, np.inf)}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": (np.nan, 1.0)}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": 0.5}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": (0.1, 0.2, 0.3)}, ValueError, "^duration: a pair 0 < low <= high"),
        ({"duration": (0.1, 0.2)}, ValueError, "^duration: a via-point is passed at 0.218 s"),
    ],
)
def test_misuse_is_named(via, x0, arguments, error, match):
    with pytest.raises(error, match=match):
        jc.optimise_times(via, TIGHT, x0, **arguments)


def test_what_has_no_via_points_or_is_no_problem_is_refused(reach, x0):
    with pytest.raises(ValueError, match=r"^passing: the problem has no via-points"):
        jc.optimise_times(reach, TIGHT, x0, passing=True)
    with pytest.raises(TypeError, match=r"^problem: a jc.Problem is wanted"):
        jc.optimise_times("reach", TIGHT, x0, passing=True)
    with pytest.raises(TypeError, match=r"^solver: .*write DDP\(\) with parentheses"):
        jc.optimise_times(reach, jc.DDP, x0, duration=(0.2, 0.6))
    with pytest.raises(ValueError, match=r"^x0: got shape"):
        jc.optimise_times(reach, TIGHT, x0[:2], duration=(0.2, 0.6))
