"""The models: what they keep of a task, what they cost, and what they find."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxctrl as jc
from jaxctrl.models import MinimumEnergy, MinimumJerk, MinimumTorqueChange, WeightedSum
from jaxctrl.plants import FreeHand, MuscleArm, RateControlled, TorqueArm

TARGET, POINT = jnp.array([-0.1, 0.53]), jnp.array([[0.02, 0.48]])
STEPS = 20
TIGHT = jc.DDP(gradient_tolerance=1e-9)


@pytest.fixture(scope="module")
def arm():
    return TorqueArm()


@pytest.fixture(scope="module")
def x0(arm):
    return arm.at_rest(0.785, 1.571)


@pytest.fixture(scope="module")
def reach(arm):
    return jc.tasks.reach(arm, TARGET, 0.5, num_steps=STEPS)


@pytest.fixture(scope="module")
def torque_change(reach, x0):
    model = MinimumTorqueChange()
    return model.problem(reach), jc.solve(model.problem(reach), TIGHT, model.start(reach, x0))


def hands(problem, solution):
    return np.asarray(jax.vmap(lambda x: problem.plant.hand(x))(solution.xs))


# What they keep and what they cost.


def forward(q, lengths=(0.30, 0.33)):
    """Hand of a two-link arm, in NumPy."""
    l1, l2 = lengths
    return np.array(
        [
            l1 * np.cos(q[0]) + l2 * np.cos(q[0] + q[1]),
            l1 * np.sin(q[0]) + l2 * np.sin(q[0] + q[1]),
        ]
    )


def hand_speed(q, dq, h=1e-6):
    return (forward(q + h * dq) - forward(q - h * dq)) / (2 * h)


def goal_cost(xs, dt, time):
    """w1 |e - e*|^2 + w2 |de/dt|^2 at the end, and |e(t) - p|^2 on the way."""
    q, dq = xs[-1, :2], xs[-1, 2:4]
    k = int(time / dt)
    f = time / dt - k
    passing = (1 - f) * xs[k, :2] + f * xs[k + 1, :2]
    return (
        np.sum((forward(q) - np.asarray(TARGET)) ** 2)
        + 0.01 * np.sum(hand_speed(q, dq) ** 2)
        + np.sum((forward(passing) - np.asarray(POINT[0])) ** 2)
    )


@pytest.fixture(scope="module")
def via(arm):
    return jc.tasks.via(
        arm, TARGET, POINT, [0.213], 0.5, num_steps=STEPS, effort=3.0, motor_noise=0.02
    )


@eqx.filter_jit
def total_cost(problem, xs, us):
    return problem.total_cost(jnp.asarray(xs), jnp.asarray(us))


def random_trajectory(nx, nu, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(STEPS + 1, nx)), rng.normal(size=(STEPS, nu))


def test_a_model_keeps_goals_and_grid_and_drops_effort_and_noise(via):
    for model in (MinimumEnergy(), MinimumTorqueChange(), MinimumJerk()):
        problem = model.problem(via)
        assert problem.num_steps == STEPS and problem.noise is None
        np.testing.assert_array_equal(problem.dt, via.dt)
        goals = jc.parts(problem.cost)[:2]
        if isinstance(problem.plant, RateControlled):
            goals = [goal.cost for goal in goals]
        assert [type(goal).__name__ for goal in goals] == ["HandTarget", "ViaPoints"]
        assert goals[0] is jc.parts(via.cost)[0]
        assert goals[1] is jc.parts(via.cost)[2]


def test_minimum_energy_costs_the_goals_and_its_own_effort_once(via):
    xs, us = random_trajectory(4, 2)
    got = total_cost(MinimumEnergy(0.7).problem(via), xs, us)
    wanted = goal_cost(xs, 0.025, 0.213) + 0.025 * 0.5 * 0.7 * np.sum(us**2)
    np.testing.assert_allclose(got, wanted, rtol=1e-8)


def test_minimum_torque_change_costs_the_goals_the_change_and_the_balance(via, arm):
    xs, us = random_trajectory(6, 2)
    got = total_cost(MinimumTorqueChange(0.7, balance=0.3).problem(via), xs, us)
    x, torque = jnp.asarray(xs[-1, :4]), xs[-1, 4:]
    # M ddq = tau - C - B dq, at the end.
    net = torque - arm.coriolis(x[:2], x[2:]) - arm.skeleton.friction @ x[2:]
    wanted = goal_cost(xs, 0.025, 0.213) + 0.3 * np.sum(np.asarray(net) ** 2)
    wanted += 0.5 * 0.7 * np.sum(np.diff(xs[:, 4:], axis=0) ** 2) / 0.025
    np.testing.assert_allclose(got, wanted, rtol=1e-8)


def test_minimum_jerk_costs_the_goals_the_jerk_and_the_last_acceleration(via):
    xs, us = random_trajectory(6, 6)
    got = total_cost(MinimumJerk(0.7, 0.3).problem(via), xs, us)
    k, f = 8, 0.213 / 0.025 - 8
    wanted = np.sum((xs[-1, :2] - np.asarray(TARGET)) ** 2) + 0.01 * np.sum(xs[-1, 2:4] ** 2)
    wanted += np.sum(((1 - f) * xs[k, :2] + f * xs[k + 1, :2] - np.asarray(POINT[0])) ** 2)
    wanted += 0.3 * np.sum(xs[-1, 4:] ** 2)
    s, w = np.polynomial.legendre.leggauss(5)
    s = (1 + s) / 2
    for u in us:
        jerk = u[:2] + np.outer(2 * s - 1, u[2:4]) + np.outer(6 * s**2 - 6 * s + 1, u[4:])
        wanted += 0.5 * 0.7 * 0.025 * np.sum(w / 2 @ jerk**2)
    np.testing.assert_allclose(got, wanted, rtol=1e-10)


def test_muscles_are_moved_as_they_are_with_a_small_effort():
    arm = MuscleArm()
    task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=STEPS)
    problem = MinimumTorqueChange(1.0, effort=2.0, balance=0.0).problem(task)
    x0 = arm.at_rest(0.785, 1.571)
    assert problem.plant is arm
    np.testing.assert_array_equal(MinimumTorqueChange().start(task, x0), x0)
    us = jnp.full((STEPS, 6), 0.1)
    xs = jax.jit(lambda us: problem.rollout(x0, us))(us)
    torques = np.asarray(jax.vmap(lambda x: arm.muscle_torque(x))(xs))
    q, dq = np.asarray(xs[-1, :2]), np.asarray(xs[-1, 2:4])
    wanted = np.sum((forward(q) - np.asarray(TARGET)) ** 2)
    wanted += 0.01 * np.sum(hand_speed(q, dq) ** 2) + 0.025 * np.sum(np.asarray(us) ** 2)
    wanted += 0.5 * np.sum(np.diff(torques, axis=0) ** 2) / 0.025
    np.testing.assert_allclose(total_cost(problem, xs, us), wanted, rtol=1e-8)


def test_plants_and_starts_are_those_of_the_model(reach, x0, arm):
    assert MinimumEnergy().problem(reach).plant is arm
    assert isinstance(MinimumTorqueChange().problem(reach).plant, RateControlled)
    assert isinstance(MinimumJerk().problem(reach).plant, FreeHand)
    moving = x0.at[2:].set(jnp.array([0.3, -0.2]))
    np.testing.assert_array_equal(MinimumEnergy().start(reach, moving), moving)
    np.testing.assert_array_equal(MinimumTorqueChange().start(reach, moving), [*moving, 0, 0])
    begin = MinimumJerk().start(reach, moving)
    np.testing.assert_allclose(begin[:2], forward(np.asarray(moving[:2])), rtol=1e-12)
    np.testing.assert_allclose(
        begin[2:4], hand_speed(np.asarray(moving[:2]), np.asarray(moving[2:])), rtol=1e-7
    )
    np.testing.assert_array_equal(begin[4:], 0)


def test_bounds_and_integrators_of_a_task_stay(arm):
    task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=STEPS)
    bounded = jc.Problem(
        arm, task.cost, num_steps=STEPS, dt=task.dt, control_bounds=(-0.4, 0.3), integrator=jc.RK4()
    )
    problem = MinimumEnergy().problem(bounded)
    np.testing.assert_array_equal(problem.bounds[1], 0.3)
    assert isinstance(problem.integrator, jc.RK4)


def test_a_model_of_a_model_is_that_model(reach):
    once = MinimumEnergy(0.3).problem(reach)
    twice = MinimumEnergy(0.5).problem(once)
    efforts = [p.weight for p in jc.parts(twice.cost) if isinstance(p, jc.tasks.Effort)]
    assert [float(w) for w in efforts] == [0.5]


# Weighted sums.


def test_a_sum_of_one_model_is_that_model(reach, x0, torque_change):
    _, solution = torque_change
    model = WeightedSum([MinimumTorqueChange()], [1.0])
    got = jc.solve(model.problem(reach), TIGHT, model.start(reach, x0))
    np.testing.assert_allclose(got.cost, solution.cost, rtol=1e-12)
    np.testing.assert_allclose(got.us, solution.us, rtol=1e-9, atol=1e-10)


def test_a_sum_costs_the_models_costs_times_their_weights(reach, arm):
    parts = (MinimumEnergy(0.3), MinimumTorqueChange(0.2, balance=0.0), MinimumJerk(0.1))
    xs, us = random_trajectory(6, 2)
    xs, us = jnp.asarray(xs), jnp.asarray(us)

    def cost(weights):
        return float(total_cost(WeightedSum(parts, weights).problem(reach), xs, us))

    goals = cost([0.0, 0.0, 0.0])
    np.testing.assert_allclose(
        cost([2.0, 0, 0]) - goals, 0.5 * 0.025 * 0.6 * np.sum(xs[:-1, 4:] ** 2), rtol=1e-9
    )
    np.testing.assert_allclose(
        cost([0, 2.0, 0]) - goals, 0.5 * 0.4 * np.sum(np.diff(xs[:, 4:], axis=0) ** 2) / 0.025
    )
    plant = RateControlled(arm)

    def acceleration(x, h=1e-5):
        rate = np.asarray(plant(x, us[0], 0.0))
        move = lambda s: hand_speed(*np.split(np.asarray(x[:4]) + s * h * rate[:4], 2))  # noqa: E731
        return (move(1) - move(-1)) / (2 * h)

    jerks = np.diff([acceleration(x) for x in xs], axis=0) / 0.025
    np.testing.assert_allclose(
        cost([0, 0, 2.0]) - goals, 0.5 * 0.025 * 0.2 * np.sum(jerks**2), rtol=1e-4
    )


@pytest.mark.slow
def test_the_hand_of_an_arm_of_least_jerk_tends_to_the_closed_form_with_the_time_step(arm, x0):
    model = WeightedSum([MinimumJerk()], [1.0])
    apart = []
    for steps in (25, 50):
        task = jc.tasks.reach(arm, TARGET, 0.5, num_steps=steps)
        problem = model.problem(task)
        solution = jc.solve(problem, jc.DDP(), model.start(task, x0))
        assert solution.status.ok
        wanted = jc.models.minimum_jerk(arm.hand(x0), TARGET, 0.5, task.ts).position
        apart.append(1e3 * np.linalg.norm(hands(problem, solution) - wanted, axis=1).max())
    print("hand jerk on an arm and closed form [mm]", apart)
    assert apart[1] < 5.0 and 1.8 < apart[0] / apart[1] < 2.2


@pytest.mark.slow
def test_a_sums_optimal_cost_has_derivatives_by_weights_that_are_zero(reach, x0):
    models = (MinimumTorqueChange(balance=0.0), MinimumEnergy())

    @jax.jit
    def cost(weights):
        model = WeightedSum(models, weights)
        return jc.solve(model.problem(reach), TIGHT, model.start(reach, x0)).cost

    for weights in ([1.0, 0.0], [0.0, 1.0]):
        weights = jnp.array(weights)
        slope = jax.jit(jax.grad(cost))(weights)
        assert jnp.isfinite(slope).all(), slope
        h = 1e-4 * (weights == 0)
        ahead = (-3 * cost(weights) + 4 * cost(weights + h) - cost(weights + 2 * h)) / 2e-4
        got = slope[int(jnp.argmin(weights))]
        np.testing.assert_allclose(got, ahead, rtol=2e-3)


# What they find.


def test_minimum_torque_change_is_the_minimum_found_by_scipy(torque_change, x0):
    """The same discretisation as a nonlinear program in the torques, written in NumPy."""
    _, solution = torque_change
    dt, w = 0.025, 1e-7
    I1, I2, m2, l1, s2 = 0.025, 0.045, 1.1, 0.30, 0.16
    d1, d2, d3 = I1 + I2 + m2 * l1**2, m2 * l1 * s2, I2
    B = jnp.array([[0.05, 0.025], [0.025, 0.05]])

    def force(q, dq, torque):
        s = d2 * jnp.sin(q[1])
        coriolis = s * jnp.array([-dq[1] * (2 * dq[0] + dq[1]), dq[0] ** 2])
        return torque - coriolis - B @ dq

    def cost(flat):
        torques = jnp.concatenate([jnp.zeros((1, 2)), flat.reshape(STEPS, 2)])

        def body(x, torque):
            q, dq = x[:2], x[2:]
            c = d2 * jnp.cos(q[1])
            M = jnp.array([[d1 + 2 * c, d3 + c], [d3 + c, d3]])
            return x + dt * jnp.concatenate([dq, jnp.linalg.solve(M, force(q, dq, torque))]), None

        x, _ = jax.lax.scan(body, x0, torques[:-1])
        q, dq = x[:2], x[2:]

        def hand(q):
            a, b = q[0], q[0] + q[1]
            return jnp.array(
                [0.30 * jnp.cos(a) + 0.33 * jnp.cos(b), 0.30 * jnp.sin(a) + 0.33 * jnp.sin(b)]
            )

        speed = jax.jvp(hand, (q,), (dq,))[1]
        end = jnp.sum((hand(q) - TARGET) ** 2) + 0.01 * jnp.sum(speed**2)
        end += 1e-4 * jnp.sum(force(q, dq, torques[-1]) ** 2)
        return 1e6 * (end + 0.5 * w * jnp.sum(jnp.diff(torques, axis=0) ** 2) / dt)

    value, hessian = jax.jit(jax.value_and_grad(cost)), jax.jit(jax.hessian(cost))
    found = scipy.optimize.minimize(
        lambda u: tuple(np.asarray(part, float) for part in value(u)),
        np.zeros(2 * STEPS),
        jac=True,
        hess=lambda u: np.asarray(hessian(u)),
        method="trust-exact",
        options={"gtol": 1e-8, "maxiter": 500},
    )
    error = abs(found.fun / 1e6 / float(solution.cost) - 1)
    print(f"SciPy {found.fun / 1e6:.12g}, jaxctrl {float(solution.cost):.12g}: {error:.1e} apart")
    assert error < 1e-6
    np.testing.assert_allclose(found.x.reshape(STEPS, 2), solution.xs[1:, 4:], atol=1e-4)


def test_torques_vanish_at_the_end_and_are_smooth_on_the_way(torque_change, x0, reach):
    _, solution = torque_change
    torques = np.asarray(solution.xs[:, 4:])
    energy = jc.solve(MinimumEnergy().problem(reach), TIGHT, x0)
    print("last torque", torques[-1], "peak", np.abs(torques).max(axis=0))
    assert np.abs(torques[-1]).max() < 0.02 * np.abs(torques).max()
    np.testing.assert_array_equal(torques[0], 0)
    change = np.abs(np.diff(torques, axis=0)).max()
    assert change < 0.5 * np.abs(np.asarray(energy.us)).max()  # energy's torque begins at its peak


def test_the_path_does_not_depend_on_the_weight_of_torque_change(reach, x0, torque_change):
    problem, solution = torque_change
    moved = {}
    for factor in (0.5, 2.0):
        model = MinimumTorqueChange(factor * 1e-7)
        other = jc.solve(model.problem(reach), TIGHT, model.start(reach, x0))
        distance = np.linalg.norm(hands(problem, other) - hands(problem, solution), axis=1)
        moved[factor] = 1e3 * distance.max()
    print("path moved by", moved, "mm")
    assert max(moved.values()) < 1.0


def test_minimum_energy_is_the_task_itself(reach, x0):
    solution = jc.solve(MinimumEnergy(1e-4).problem(reach), TIGHT, x0)
    np.testing.assert_allclose(solution.us, jc.solve(reach, TIGHT, x0).us, rtol=1e-8, atol=1e-9)


def test_a_hand_that_is_pushed_is_moved_by_every_model_of_its_arm(arm, x0):
    plant = jc.plants.InField(arm, jc.plants.ConstantForce([1.0, 0.0]))
    task = jc.tasks.reach(plant, TARGET, 0.5, num_steps=STEPS)
    model = MinimumTorqueChange()
    problem = model.problem(task)
    solution = jc.solve(problem, TIGHT, model.start(task, x0))
    assert solution.status.ok
    # At the end the torques hold the hand against the force: tau = -J'F.
    x, h = np.asarray(solution.xs[-1]), 1e-6
    J = np.stack([(forward(x[:2] + h * e) - forward(x[:2] - h * e)) / (2 * h) for e in np.eye(2)])
    np.testing.assert_allclose(x[4:], -J @ [1.0, 0.0], atol=0.03)


def test_another_number_does_not_compile_again(arm, x0):
    from jaxctrl import _solve

    def solve(weight, target, time, duration):
        task = jc.tasks.via(arm, target, POINT, [time], duration, num_steps=STEPS)
        for model in (MinimumTorqueChange(weight), MinimumJerk(weight)):
            jc.solve(model.problem(task), jc.ILQR(), model.start(task, x0))

    solve(1e-7, TARGET, 0.2, 0.5)
    size = _solve.run_iteration._cached._cache_size()
    solve(2e-7, TARGET + 0.01, 0.21, 0.6)
    solve(jnp.array(1e-7), np.array([-0.11, 0.5]), 0.3, 1)
    assert _solve.run_iteration._cached._cache_size() == size


def test_models_are_built_under_jit_and_are_differentiated_by_their_weights(reach):
    xs, us = random_trajectory(6, 2)

    @jax.jit
    def cost(weight):
        model = WeightedSum([MinimumTorqueChange(weight)], jnp.array([2.0]))
        return model.problem(reach).total_cost(jnp.asarray(xs), jnp.asarray(us))

    slope = jax.grad(cost)(1e-7)
    change = np.sum(np.diff(xs[:, 4:], axis=0) ** 2) / 0.025
    np.testing.assert_allclose(slope, change, rtol=1e-9)


def test_float32_stays_float32(float32):
    arm = TorqueArm()
    x0 = arm.at_rest(0.785, 1.571)
    task = jc.tasks.reach(arm, [-0.1, 0.53], 0.5, num_steps=STEPS)
    for model in (MinimumEnergy(), MinimumTorqueChange(), MinimumJerk()):
        problem, begin = model.problem(task), model.start(task, x0)
        leaves = jax.tree.leaves(eqx.filter((problem, begin), eqx.is_inexact_array))
        assert {leaf.dtype for leaf in leaves} == {jnp.dtype("float32")}


# Time steps.


def _directions(arm, integrator=None):
    """Solve 8 reaches on a grid of 50 and of 100 steps, the fine ones from the coarse controls."""
    x0 = arm.at_rest(0.785, 1.571)
    found = {}
    for steps in (50, 100):
        problems = jc.tasks.centre_out(arm, x0, num_steps=steps)

        @jax.jit
        def solve(problem, us):
            solution = jc.solve(problem, jc.ILQR(), x0, us)
            return jax.vmap(lambda x: arm.hand(x))(solution.xs), solution.us, solution.status.ok

        one = lambda i: jax.tree.map(lambda leaf: leaf[i], problems)  # noqa: B023, E731
        results = []
        for i in range(8):
            if steps == 50:
                us = jnp.tile(one(0).plant.nominal_control, (50, 1))
            else:
                us = jnp.repeat(found[50][i][1], 2, axis=0)
            results.append(solve(one(i), us))
        found[steps] = results
    assert all(bool(ok) for results in found.values() for _, _, ok in results)
    return [
        1e3 * float(np.linalg.norm(np.asarray(fine[::2] - coarse), axis=1).max())
        for (coarse, _, _), (fine, _, _) in zip(found[50], found[100], strict=True)
    ]


@pytest.mark.slow
@pytest.mark.parametrize("arm", [TorqueArm(), MuscleArm()], ids=["torques", "muscles"])
def test_half_the_time_step_moves_no_reach_by_more_than_two_millimetres(arm):
    moved = _directions(arm)
    print("moved by [mm]", np.round(moved, 3))
    assert max(moved) < 2.0


# Misuse.


def test_a_bounded_torque_arm_is_refused_where_torques_become_states(reach):
    bounded = jc.tasks.reach(TorqueArm(control_bounds=(-1.0, 1.0)), TARGET, num_steps=STEPS)
    with pytest.raises(ValueError, match=r"^arm: its controls have bounds"):
        MinimumTorqueChange().problem(bounded)
    own = jc.Problem(
        reach.plant, reach.cost, num_steps=STEPS, dt=reach.dt, control_bounds=(-1.0, 1.0)
    )
    with pytest.raises(ValueError, match=r"^task: minimum torque change makes the torques states"):
        MinimumTorqueChange().problem(own)


@pytest.mark.parametrize(
    ("build", "error", "match"),
    [
        (lambda task: MinimumEnergy().problem("reach"), TypeError, "^task: a problem such as"),
        (
            lambda task: MinimumJerk().problem(task + jc.QuadraticCost(R=1.0)),
            TypeError,
            '^task: minimum jerk moves the hand alone and has no QuadraticCost; .*`of = "hand"`',
        ),
        (
            lambda task: MinimumJerk().problem(
                jc.tasks.posture(task.plant, jnp.ones(2), num_steps=5)
            ),
            TypeError,
            "^task: minimum jerk moves the hand alone and has no PostureTarget",
        ),
        (
            lambda task: MinimumTorqueChange().problem(MinimumJerk().problem(task)),
            TypeError,
            "^task: minimum torque change wants a plant with joints",
        ),
        (
            lambda task: MinimumJerk().start(task, jnp.zeros(6)),
            ValueError,
            r"^x0: got shape \(6,\)",
        ),
        (lambda task: WeightedSum([], []), ValueError, "^models: at least one"),
        (lambda task: WeightedSum([MinimumJerk], [1.0]), TypeError, "^models: models such as"),
        (lambda task: WeightedSum(MinimumJerk, [1.0]), TypeError, "^models: models such as"),
        (
            lambda task: WeightedSum([MinimumJerk(), MinimumEnergy()], [1.0]),
            ValueError,
            r"^weights: got shape \(1,\), wanted \(2,\)",
        ),
        (lambda task: WeightedSum([MinimumJerk()], [-1.0]), ValueError, "^weights: at least 0"),
        (lambda task: MinimumTorqueChange(effort=-1e-5), ValueError, "^effort: at least 0"),
        (
            lambda task: WeightedSum([WeightedSum([MinimumJerk()], [1.0])], [1.0]),
            TypeError,
            "^models: models such as",
        ),
    ],
)
def test_misuse_is_named(reach, build, error, match):
    with pytest.raises(error, match=match):
        build(reach)


def test_a_models_numbers_are_fields_that_can_be_replaced():
    assert float(dataclasses.replace(MinimumJerk(), weight=1e-9).weight) == 1e-9
