"""The tasks: what they cost, what they refuse, and that their numbers are leaves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc

TARGET = jnp.array([-0.1, 0.53])


@pytest.fixture(scope="module")
def arm():
    return jc.plants.TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(shoulder=0.785, elbow=1.571)


def test_reach_costs_what_equation_3_20_says(arm):
    problem = jc.tasks.reach(arm, TARGET, 0.5, velocity_weight=0.3, effort=2e-3)
    rng = np.random.default_rng(0)
    xs, us = jnp.asarray(rng.normal(size=(51, 4))), jnp.asarray(rng.normal(size=(50, 2)))
    jacobian = jax.jacfwd(arm.hand)(xs[-1])[:, :2]
    wanted = (
        jnp.sum((arm.hand(xs[-1]) - TARGET) ** 2)
        + 0.3 * jnp.sum((jacobian @ xs[-1, 2:4]) ** 2)
        + 0.5 * 0.01 * 2e-3 * jnp.sum(us**2)
    )
    np.testing.assert_allclose(problem.total_cost(xs, us), wanted, rtol=1e-12)


def test_posture_has_its_stopping_term_unless_told_otherwise(arm):
    xs, us = jnp.ones((51, 4)), jnp.zeros((50, 2))
    angles = jnp.array([1.5, 0.5])
    with_stop = jc.tasks.posture(arm, angles, 0.5).total_cost(xs, us)
    as_printed = jc.tasks.posture(arm, angles, 0.5, stop=False).total_cost(xs, us)
    np.testing.assert_allclose(as_printed, 0.5 * (0.25 + 0.25), rtol=1e-12)
    np.testing.assert_allclose(with_stop - as_printed, 0.5 * 2.0, rtol=1e-12)


def test_hit_arrives_with_the_velocity_asked_for(arm, x0):
    velocity = jnp.array([0.0, 0.5])
    problem = jc.tasks.hit(arm, TARGET, velocity, 0.5)
    solution = jc.solve(problem, jc.ILQR(), x0)
    assert solution.status.ok
    assert jnp.linalg.norm(arm.hand(solution.xs[-1]) - TARGET) < 1e-3
    assert jnp.linalg.norm(arm.hand_velocity(solution.xs[-1]) - velocity) < 0.02


def test_via_points_are_passed_at_their_times(arm, x0):
    points, times = jnp.array([[0.02, 0.48], [-0.05, 0.54]]), jnp.array([0.153, 0.327])
    problem = jc.tasks.via(arm, TARGET, points, times, 0.5)
    solution = jc.solve(problem, jc.ILQR(), x0)
    assert solution.status.ok
    for point, time in zip(points, times, strict=True):
        q = [jnp.interp(time, problem.ts, solution.xs[:, j]) for j in range(2)]
        assert jnp.linalg.norm(arm.hand_of_joints(jnp.stack(q)) - point) < 2e-3


def test_obstacle_is_cleared_and_its_clearance_grows_with_its_weight(arm, x0):
    centre, clearances = jnp.array([-0.067, 0.4945]), []
    for weight in (1e-11, 1e-9, 1e-7):
        problem = jc.tasks.obstacle(
            arm, TARGET, centre, 0.02, 0.7, obstacle_weight=weight, num_steps=70
        )
        solution = jc.solve(problem, jc.ILQR(), x0)
        assert solution.status.ok, str(solution)
        hands = jax.vmap(arm.hand)(solution.xs)
        clearances.append(jnp.linalg.norm(hands - centre, axis=1).min() - 0.02)
    assert 0 < clearances[0] < clearances[1] < clearances[2]


def test_obstacle_cost_is_infinite_inside_with_finite_derivatives_outside(arm):
    disc = jc.tasks.Obstacle(jnp.array([0.0, 0.4]), 0.02, 1e-8)
    alone = jc.Problem(arm, disc, num_steps=1)

    def rate(hand):
        x = jnp.concatenate([arm.inverse_kinematics(hand), jnp.zeros(2)])
        return alone.running(x, jnp.zeros(2), 0.0)

    assert rate(jnp.array([0.01, 0.4])) == jnp.inf
    np.testing.assert_allclose(rate(jnp.array([0.03, 0.4])), 1e-8 / 0.01**2, rtol=1e-6)
    assert jnp.isfinite(jax.hessian(rate)(jnp.array([0.021, 0.4]))).all()


def test_obstacle_that_holds_the_target_or_the_start_is_refused_or_a_status(arm, x0):
    with pytest.raises(ValueError, match="target: lies inside the obstacle"):
        jc.tasks.obstacle(arm, TARGET, TARGET + 0.01, 0.02)
    problem = jc.tasks.obstacle(arm, TARGET, arm.hand(x0) + 0.001, 0.02)
    with pytest.raises(ValueError, match=r"^x0: the hand starts inside the obstacle, 0.001414 m"):
        jc.solve(problem, jc.ILQR(), x0)
    status = jax.jit(lambda x0: jc.solve(problem, jc.ILQR(), x0).status)(x0)
    assert status.name == "NONFINITE_COST" and int(status.index) == 0


def test_a_start_inside_an_obstacle_is_found_in_any_part_of_a_cost_and_beside_it_is_allowed(
    arm, x0
):
    def problem(centre):
        disc = jc.tasks.Obstacle(centre, 0.02)
        cost = jc.QuadraticCost(R=1.0) + (disc + jc.QuadraticCost(Qf=1.0))
        return jc.Problem(arm, cost, num_steps=5)

    with pytest.raises(ValueError, match=r"^x0: the hand starts inside"):
        jc.solve(problem(arm.hand(x0)), jc.ILQR(), x0)
    jc.tasks.Obstacle(arm.hand(x0) + 0.02, 0.02).check_start(arm, x0)
    jc.solve(problem(arm.hand(x0) + 0.1), jc.ILQR(), x0)


@pytest.mark.parametrize("of_states", [False, True])
def test_effort_is_of_the_controls_or_of_the_torques_that_are_states(arm, of_states):
    plant = jc.plants.RateControlled(arm) if of_states else arm
    rng = np.random.default_rng(0)
    x, u = jnp.asarray(rng.normal(size=plant.nx)), jnp.asarray(rng.normal(size=2))
    c = x[4:] if of_states else u
    W = np.array([[2.0, 0.3], [0.3, 1.0]])
    for weight, wanted in (
        (0.7, 0.35 * np.sum(c**2)),
        (np.array([0.7, 0.1]), 0.5 * (0.7 * c[0] ** 2 + 0.1 * c[1] ** 2)),
        (W, 0.5 * c @ W @ c),
    ):
        alone = jc.Problem(plant, jc.tasks.Effort(weight), num_steps=1)
        np.testing.assert_allclose(alone.running(x, u, 0.0), wanted, rtol=1e-12)
        assert alone.end(x) == 0 and alone.terms.events == ()
    with pytest.raises(ValueError, match=r"^effort: shape \(3,\)"):
        jc.Problem(plant, jc.tasks.Effort(np.ones(3)), num_steps=1).running(x, u, 0.0)


def test_tasks_with_known_numbers_may_be_built_under_jit(arm):
    """A concrete array is traced by what is computed from it there."""
    centre = jnp.array([0.1, 0.5])

    @jax.jit
    def build(effort):
        obstacle = jc.tasks.obstacle(arm, TARGET, centre, 0.02, num_steps=10, effort=effort)
        via = jc.tasks.via(arm, TARGET, centre[None], jnp.array([0.2]), num_steps=10)
        again = jc.Problem(arm, via.cost, num_steps=10, dt=jnp.array(0.05))
        return obstacle.dt + via.dt + again.dt

    np.testing.assert_allclose(build(1e-4), 0.15)


def test_tasks_hand_their_integrator_on(arm, x0):
    path, step = jnp.tile(TARGET, (3, 1)), jc.RK4()
    for problem in (
        jc.tasks.reach(arm, TARGET, integrator=step),
        jc.tasks.hit(arm, TARGET, jnp.zeros(2), integrator=step),
        jc.tasks.posture(arm, [1.5, 0.5], integrator=step),
        jc.tasks.swing_up(jc.plants.Pendulum(), integrator=step),
        jc.tasks.obstacle(arm, TARGET, (1.0, 1.0), 0.1, integrator=step),
        jc.tasks.via(arm, TARGET, TARGET[None], [0.2], integrator=step),
        jc.tasks.track(arm, path, 0.5, integrator=step),
        jc.tasks.centre_out(arm, x0, integrator=step),
    ):
        assert isinstance(problem.integrator, jc.RK4)
    with pytest.raises(ValueError, match="integrator: NextState"):
        jc.tasks.reach(arm, TARGET, integrator=jc.NextState())


def test_centre_out_is_a_batch_that_equals_single_reaches(arm, x0):
    problems = jc.tasks.centre_out(arm, x0, n=4, radius=0.1, duration=0.5)
    batch = jax.vmap(lambda p: jc.solve(p, jc.ILQR(), x0))(problems)
    assert batch.status.ok.all()
    for i, offset in enumerate([(0.1, 0), (0, 0.1), (-0.1, 0), (0, -0.1)]):
        single = jc.solve(jc.tasks.reach(arm, arm.hand(x0) + jnp.array(offset)), jc.ILQR(), x0)
        np.testing.assert_allclose(batch.us[i], single.us, rtol=1e-6, atol=1e-8)


def test_tasks_may_be_built_under_jit_and_differentiated(arm, x0):
    @jax.jit
    def cost(target, duration):
        problem = jc.tasks.reach(arm, target, duration, num_steps=50)
        return jc.solve(problem, jc.ILQR(), x0).cost

    h = 1e-4
    slope = jax.grad(cost, argnums=1)(TARGET, 0.5)
    difference = (cost(TARGET, 0.5 + h) - cost(TARGET, 0.5 - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-4)


def test_changing_a_task_does_not_compile_again(arm, x0):
    def solve(target, point, time, weight, duration):
        problem = jc.tasks.via(
            arm, target, point, time, duration, num_steps=30, via_weight=weight, effort=weight
        )
        return jc.solve(problem, jc.ILQR(), x0)

    from jaxctrl import _solve

    solve(TARGET, [[0.0, 0.5]], [0.2], 1e-4, 0.5)
    size = _solve.run_iteration._cached._cache_size()
    solve(TARGET + 0.01, jnp.array([[0.01, 0.5]]), jnp.array([0.21]), 2e-4, 0.6)
    solve(np.array([-0.11, 0.5]), np.array([[0.01, 0.5]]), np.array([0.21]), 1, 1)
    assert _solve.run_iteration._cached._cache_size() == size


@pytest.mark.parametrize(
    ("build", "error", "match"),
    [
        (lambda arm: jc.tasks.reach(arm, [0.1, 0.2, 0.3]), ValueError, r"target: got shape \(3,\)"),
        (lambda arm: jc.tasks.reach(arm, [0.1, jnp.nan]), ValueError, "target: not finite"),
        (lambda arm: jc.tasks.reach(arm, TARGET, -1.0), ValueError, "duration: a positive time"),
        (
            lambda arm: jc.tasks.reach(arm, TARGET, 0.5, num_steps=0),
            ValueError,
            "num_steps: at least",
        ),
        (lambda arm: jc.tasks.posture(arm, [1.0]), ValueError, r"angles: got shape \(1,\)"),
        (lambda arm: jc.tasks.posture(arm, [45.0, 90.0]), ValueError, r"^angles: .* radians\?"),
        (
            lambda arm: jc.tasks.via(arm, TARGET, [0.1, 0.2], [0.1]),
            ValueError,
            r"points: got shape \(2,\), wanted \(1, 2\); one row",
        ),
        (
            lambda arm: jc.tasks.via(arm, TARGET, [[0.1, 0.2]], [0.9]),
            ValueError,
            "^times: between 0 and 0.5 s are wanted",
        ),
        (
            lambda arm: jc.tasks.reach(jc.FunctionPlant(lambda x, u, t: x, nx=2, nu=2), TARGET),
            TypeError,
            "plant: one with a hand is wanted",
        ),
        (lambda arm: jc.tasks.centre_out(arm, jnp.zeros(3)), ValueError, r"x0: got shape \(3,\)"),
        (lambda arm: jc.tasks.centre_out(arm, jnp.zeros(4), n=0), ValueError, "n: at least 1"),
        (
            lambda arm: jc.tasks.centre_out(arm, arm.at_rest(0.7, 1.5), radius=-0.1),
            ValueError,
            "radius: above 0",
        ),
    ],
)
def test_misuse_is_named(arm, build, error, match):
    with pytest.raises(error, match=match):
        build(arm)


def test_traced_duration_asks_for_the_number_of_steps(arm, x0):
    with pytest.raises(ValueError, match="num_steps: wanted when `duration` is traced"):
        jax.jit(lambda d: jc.tasks.reach(arm, TARGET, d).dt)(0.5)


@pytest.mark.parametrize(
    "arguments", [{"effort": -1.0}, {"motor_noise": -0.1}, {"position_weight": -1.0}]
)
def test_negative_weights_are_refused_by_name(arguments):
    (name,) = arguments
    with pytest.raises(ValueError, match=f"{name}: at least 0 is wanted, got -"):
        jc.tasks.reach(jc.plants.TorqueArm(), jnp.array([-0.1, 0.5]), **arguments)
    with pytest.raises((TypeError, ValueError), match=name):
        jc.tasks.reach(jc.plants.TorqueArm(), jnp.array([-0.1, 0.5]), **{name: "much"})


def test_a_trajectory_handed_to_the_hand_is_refused_with_a_hint():
    arm = jc.plants.TorqueArm()
    xs = jnp.zeros((51, 4))
    for method in (arm.hand, arm.hand_velocity):
        with pytest.raises(ValueError, match=r"x: got shape \(51, 4\), wanted \(4,\); .*jax.vmap"):
            method(xs)
    assert jax.vmap(arm.hand)(xs).shape == (51, 2)


def test_a_task_with_the_default_duration_may_be_built_under_jit():
    arm = jc.plants.TorqueArm()
    build = jax.jit(lambda target: jc.tasks.reach(arm, target).dt)
    np.testing.assert_allclose(build(jnp.array([-0.1, 0.5])), 0.01)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda arm: jc.tasks.reach(arm, [2.0, 2.0]), "target"),
        (lambda arm: jc.tasks.via(arm, TARGET, [[20.0, 30.0]], [0.2]), "points"),
        (lambda arm: jc.tasks.track(arm, [[0.0, 0.5], [0.0, 0.64]], 1.0), "path"),
        (lambda arm: jc.tasks.centre_out(arm, arm.at_rest(0.8, 0.5), radius=0.3), "radius"),
        (lambda arm: jc.tasks.reach(jc.plants.InField(arm, jc.plants.Curl()), [0.7, 0]), "target"),
        (lambda arm: jc.tasks.reach(jc.plants.RateControlled(arm), [0.7, 0.0]), "target"),
        (lambda arm: jc.tasks.reach(jc.plants.Chain(3), [0.7, 0.0]), "target"),
    ],
)
def test_goals_out_of_reach_are_refused(arm, build, name):
    with pytest.raises(ValueError, match=rf"^{name}: .* the hand reaches no further than 0.63 m"):
        build(arm)


def test_a_free_hand_reaches_anywhere():
    assert jc.tasks.reach(jc.plants.FreeHand(), [20.0, 30.0]).plant.nx == 6


def test_costs_are_added_to_a_task_and_checked(arm, x0):
    task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=10)
    disc = jc.tasks.Obstacle(jnp.array([0.2, 0.2]), 0.02, 1e-9)
    both, us = task + disc, jnp.zeros((10, 2))
    xs = both.rollout(x0, us)
    alone = jc.Problem(arm, disc, num_steps=10, dt=0.05)
    wanted = task.total_cost(xs, us) + alone.total_cost(xs, us)
    np.testing.assert_allclose(both.total_cost(xs, us), wanted, rtol=1e-12)
    with pytest.raises(ValueError, match=r"event at 0\.9 s lies outside"):
        task + jc.tasks.ViaPoints(jnp.zeros((1, 2)), jnp.array([0.9]))
    with pytest.raises(TypeError):
        task + 1.0


@pytest.mark.parametrize("task", ["obstacle", "via", "centre_out"])
def test_a_misspelt_argument_is_one_of_the_task_that_was_called(task):
    arm = jc.plants.TorqueArm()
    first = {
        "obstacle": ([0.1, 0.5], [0.2, 0.5]),
        "via": ([0.1, 0.5], [[0.0, 0.5]], [0.2]),
        "centre_out": (arm.at_rest(0.8, 1.5),),
    }[task]
    with pytest.raises(TypeError, match=rf"^{task}\(\) got an unexpected .* 'effrt'"):
        getattr(jc.tasks, task)(arm, *first, effrt=0.5)


def test_a_sensor_is_given_to_a_task_or_added_to_it(arm):
    sensor, cov = jc.JointSensor(), 1e-4 * jnp.eye(4)
    given = jc.tasks.reach(arm, TARGET, 0.1, sensor=sensor, x0_cov=cov)
    added = jc.tasks.reach(arm, TARGET, 0.1) + sensor
    assert isinstance(given.sensor, jc.JointSensor) and isinstance(added.sensor, jc.JointSensor)
    assert (given.num_readings, added.num_readings) == (4, 4)
    np.testing.assert_array_equal(given.x0_cov, cov)
    assert added.x0_cov is None
    both = added + jc.HandSensor().delayed(0.035)
    assert both.num_readings == 8 and both.sensor.parts[1].steps == 4
    with pytest.raises(ValueError, match="sensor: a buffer of 20 steps"):
        added + jc.HandSensor().delayed(0.2)
    with pytest.raises(TypeError, match="sensor: "):
        jc.tasks.reach(arm, TARGET, sensor=jc.AdditiveNoise(1.0))


def test_every_task_takes_a_sensor(arm, x0):
    kept = {"sensor": jc.JointSensor(), "x0_cov": 1e-4 * jnp.eye(4), "num_steps": 4}
    tasks = jc.tasks
    for made in (
        tasks.hit(arm, TARGET, [0.1, 0.0], 0.1, **kept),
        tasks.posture(arm, [1.0, 1.0], 0.1, **kept),
        tasks.obstacle(arm, TARGET, [0.1, 0.4], 0.02, 0.1, **kept),
        tasks.via(arm, TARGET, [[0.0, 0.5]], [0.05], 0.1, **kept),
        tasks.track(arm, [[0.0, 0.5], [-0.1, 0.5]], 0.1, **kept),
    ):
        assert isinstance(made.sensor, jc.JointSensor) and made.x0_cov.shape == (4, 4)
    batch = tasks.centre_out(arm, x0, n=3, duration=0.1, **kept)
    assert batch.sensor.angle_sd.shape == (3,) and batch.x0_cov.shape == (3, 4, 4)
    with pytest.raises(ValueError, match="a batch"):
        batch + jc.HandSensor()
    swing = tasks.swing_up(
        jc.plants.Pendulum(), num_steps=4, sensor=jc.LinearSensor(jnp.eye(2), 0.1)
    )
    assert swing.num_readings == 2 and swing.x0_cov is None
