"""Following a path in time: what it costs, how closely it is followed, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.tasks import HandPath

T, STEPS = 0.6, 30


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(shoulder=0.785, elbow=1.571)


@pytest.fixture(scope="module")
def reach(arm, x0):
    """A minimum-jerk reach as a path."""
    return jc.models.minimum_jerk(arm.hand(x0), [-0.1, 0.53], T, np.linspace(0, T, STEPS + 1))


def test_track_costs_what_its_formula_says(arm):
    rng = np.random.default_rng(0)
    path = 0.1 * rng.normal(size=(4, 2))
    xs, us = rng.normal(size=(STEPS + 1, 4)), rng.normal(size=(STEPS, 2))
    problem = jc.tasks.track(arm, path, T, num_steps=STEPS, path_weight=3.0, effort=0.2)
    ts = np.linspace(0, T, STEPS + 1)
    wanted_path = np.stack([np.interp(ts, np.linspace(0, T, 4), p) for p in path.T], axis=1)
    hands = np.asarray(jax.vmap(arm.hand)(jnp.asarray(xs)))
    squares = np.sum((hands - wanted_path) ** 2, axis=1)
    wanted = T / STEPS * (3.0 * squares.sum() + 0.5 * 0.2 * np.sum(us**2))
    got = problem.total_cost(jnp.asarray(xs), jnp.asarray(us))
    np.testing.assert_allclose(got, wanted, rtol=1e-12)


def test_the_hand_follows_its_path_and_closer_the_more_it_costs_to_leave(arm, x0, reach):
    @jax.jit
    def solve(weight):
        problem = jc.tasks.track(
            arm, reach.position, T, num_steps=STEPS, path_weight=weight, effort=1e-5
        )
        solution = jc.solve(problem, jc.ILQR(), x0)
        return jax.vmap(lambda x: arm.hand(x))(solution.xs), solution.status.ok

    errors = []
    for weight in (1.0, 10.0, 100.0):
        hands, ok = solve(weight)
        assert ok
        errors.append(1e3 * float(np.linalg.norm(hands - reach.position, axis=1).max()))
    print("largest distance from the path [mm]", errors)
    assert errors[0] > errors[1] > errors[2] and errors[1] < 5.0


def test_a_function_of_time_is_sampled_at_the_grid(arm):
    def circle(t):
        return jnp.array([0.05 * jnp.cos(9 * t), 0.4 + 0.05 * jnp.sin(9 * t)])

    def as_list(t):
        return [0.05 * jnp.cos(9 * t), 0.4 + 0.05 * jnp.sin(9 * t)]

    ts = np.arange(STEPS + 1) * T / STEPS
    points = np.stack([0.05 * np.cos(9 * ts), 0.4 + 0.05 * np.sin(9 * ts)], axis=1)
    for path in (circle, as_list):
        problem = jc.tasks.track(arm, path, T, num_steps=STEPS)
        np.testing.assert_allclose(jc.parts(problem.cost)[0].points, points, atol=1e-15)
    short = jc.tasks.track(arm, as_list, 0.1, num_steps=1)
    np.testing.assert_allclose(jc.parts(short.cost)[0].points[0], [0.05, 0.4], atol=1e-15)


def test_the_path_is_linear_between_its_points():
    path = HandPath(jnp.array([[0.0, 1.0], [2.0, 1.0], [2.0, 5.0]]))
    for t, wanted in (
        (0.0, [0.0, 1.0]),
        (0.1, [1.0, 1.0]),
        (0.2, [2.0, 1.0]),
        (0.3, [2.0, 3.0]),
        (0.4, [2.0, 5.0]),
    ):
        np.testing.assert_allclose(path.position(jnp.asarray(t / 0.4)), wanted, atol=1e-12)


def test_a_free_hand_can_track_too(arm, x0, reach):
    task = jc.tasks.track(arm, reach.position, T, num_steps=STEPS)
    model = jc.models.MinimumJerk(1e-10)
    problem = model.problem(task)
    solution = jc.solve(problem, jc.ILQR(), model.start(task, x0))
    assert solution.status.ok and int(solution.num_steps) == 1
    np.testing.assert_allclose(solution.xs[:, :2], reach.position, atol=1e-3)


def test_tracks_are_built_under_jit_and_differentiated_by_their_path(arm, x0, reach):
    us = jnp.full((STEPS, 2), 0.1)

    @jax.jit
    def cost(path, duration):
        problem = jc.tasks.track(arm, path, duration, num_steps=STEPS)
        return problem.total_cost(problem.rollout(x0, us), us)

    path, h = jnp.asarray(reach.position), 1e-5
    slope = jax.grad(cost)(path, T)
    for index in ((3, 0), (STEPS, 1)):
        step = jnp.zeros_like(path).at[index].set(h)
        difference = (cost(path + step, T) - cost(path - step, T)) / (2 * h)
        np.testing.assert_allclose(slope[index], difference, rtol=1e-6)


def test_another_path_does_not_compile_again(arm, x0, reach):
    from jaxctrl import _solve

    def solve(path, duration, weight):
        problem = jc.tasks.track(arm, path, duration, num_steps=STEPS, path_weight=weight)
        jc.solve(problem, jc.ILQR(), x0)

    solve(reach.position, T, 10.0)
    size = _solve.run_iteration._cached._cache_size()
    solve(np.asarray(reach.position) + 0.01, 0.7, 5)
    solve(lambda t: arm.hand(x0) + 0.1 * t, 0.5, jnp.array(20.0))
    assert _solve.run_iteration._cached._cache_size() == size


@pytest.mark.parametrize(
    ("path", "arguments", "error", "match"),
    [
        (
            np.zeros((1, 2)),
            {},
            ValueError,
            r"^path: got shape \(1, 2\), wanted \(m, 2\)",
        ),
        (np.zeros((5, 3)), {}, ValueError, r"^path: got shape \(5, 3\), wanted \(m, 2\)"),
        (np.zeros(2), {}, ValueError, r"^path: got shape \(2,\)"),
        (np.full((5, 2), np.nan), {}, ValueError, "^path: not finite"),
        (lambda t: jnp.stack([t, t, t]), {}, ValueError, r"^path: got shape \(31, 3\)"),
        (np.zeros((5, 2)), {"path_weight": -1.0}, ValueError, "^path_weight: at least 0"),
        (np.zeros((5, 2)), {"effort": -1.0}, ValueError, "^effort: at least 0"),
    ],
)
def test_misuse_is_named(arm, path, arguments, error, match):
    with pytest.raises(error, match=match):
        jc.tasks.track(arm, path, T, num_steps=STEPS, **arguments)


def test_a_plant_without_a_hand_and_a_time_that_is_not_positive_are_refused(arm):
    with pytest.raises(TypeError, match=r"^plant: one with a hand is wanted"):
        jc.tasks.track(jc.FunctionPlant(lambda x, u, t: x, nx=2, nu=2), np.zeros((5, 2)), T)
    with pytest.raises(ValueError, match=r"^duration: a positive time"):
        jc.tasks.track(arm, np.zeros((5, 2)), -1.0)
