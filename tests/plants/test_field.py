"""Force fields: what they do to an arm, by energy balance, finite differences and paths."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxctrl as jc
from jaxctrl.plants import Chain, Channel, ConstantForce, Curl, InField, MuscleArm, TorqueArm

ARMS = {
    "torque arm": lambda: TorqueArm(friction=np.zeros((2, 2))),
    "chain of 3": lambda: Chain(3, friction=0.0),
}
TARGET = jnp.array([-0.1, 0.53])


class Mixed(jc.plants.AbstractField):
    """A force of position, velocity and time that conserves nothing."""

    def __call__(self, position, velocity, t):
        turned = jnp.stack([velocity[1], 0.3 * velocity[0]])
        return -20 * (position - 0.2) + 4 * turned + jnp.stack([jnp.cos(9 * t), 0.5 + t])


def start(arm):
    n = arm.num_joints
    rng = np.random.default_rng(n)
    return jnp.asarray(np.r_[rng.uniform(0.2, 1.2, n), rng.uniform(-1, 1, n)])


def hand_path(plant, x0, us, dt=0.01):
    problem = jc.Problem(plant, jc.QuadraticCost(), num_steps=len(us), dt=dt, integrator=jc.RK4())
    return np.asarray(jax.vmap(plant.hand)(problem.rollout(x0, us)))


@pytest.fixture(scope="module")
def free_reach():
    arm = TorqueArm()
    x0 = arm.at_rest(0.785, 1.571)
    return arm, x0, jc.solve(jc.tasks.reach(arm, TARGET), jc.ILQR(), x0)


@pytest.mark.parametrize("name", ARMS)
def test_the_power_of_a_field_is_the_change_of_energy_of_a_frictionless_arm(rk4, name):
    arm = ARMS[name]()
    field, n = Mixed(), arm.num_joints
    plant, u = InField(arm, field), jnp.zeros(arm.nu)

    def dynamics(y):  # state, work, time
        x, t = y[: 2 * n], y[-1]
        velocity = jax.jvp(arm.hand_of_joints, (x[:n],), (x[n:],))[1]
        power = field(arm.hand_of_joints(x[:n]), velocity, t) @ velocity
        return jnp.concatenate([plant(x, u, t), jnp.stack([power, 1.0])])

    x0 = start(arm)
    ys = rk4(dynamics, jnp.concatenate([x0, jnp.zeros(2)]), 5e-4, 800)
    gain = jax.vmap(arm.kinetic_energy)(ys[:, : 2 * n]) - arm.kinetic_energy(x0)
    assert jnp.abs(gain).max() > 0.1
    np.testing.assert_allclose(ys[:, -2], gain, atol=1e-8 * float(jnp.abs(gain).max()))


def test_a_curl_field_bends_the_path_and_does_no_work(rk4):
    arm = ARMS["torque arm"]()
    plant, x0 = InField(arm, Curl(13.0)), start(arm)
    xs = rk4(lambda x: plant(x, jnp.zeros(arm.nu), 0.0), x0, 5e-4, 800)
    free = rk4(lambda x: arm(x, jnp.zeros(arm.nu), 0.0), x0, 5e-4, 800)
    energy = jax.vmap(arm.kinetic_energy)(xs)
    np.testing.assert_allclose(energy, arm.kinetic_energy(x0), rtol=1e-8)
    assert jnp.linalg.norm(plant.hand(xs[-1]) - arm.hand(free[-1])) > 0.05


def test_a_positive_curl_pushes_to_the_right_of_the_movement():
    force = Curl(13.0)(jnp.zeros(2), jnp.array([0.0, 0.5]), 0.0)
    np.testing.assert_allclose(force, [6.5, 0.0], atol=1e-15)


def test_feedback_of_muscles_brings_the_hand_nearer_than_their_controls_alone():
    """Forward by 10 cm, in a curl field that was not planned for."""
    arm = MuscleArm()
    x0 = arm.at_rest(np.pi / 4, np.pi / 2)
    target = arm.hand(x0) + jnp.array([0.0, 0.1])
    task = jc.tasks.reach(arm, target, 0.5, num_steps=25, velocity_weight=1e-3)
    found = jc.solve(task, jc.ILQR(), x0)
    assert found.status.ok
    field = InField(arm, Curl(13.0))

    def miss(controller):
        end = jc.simulate(task, controller, x0, plant=field).xs[-1]
        return float(jnp.linalg.norm(arm.hand(end) - target))

    assert miss(found.policy) < 0.9 * miss(jc.OpenLoop(found.us))


@pytest.mark.parametrize("arm", [TorqueArm(), Chain(3), MuscleArm()], ids=lambda arm: str(arm.nx))
def test_a_constant_force_adds_its_torque_by_finite_differences_of_the_hand(arm):
    n, force, h = arm.num_joints, np.array([1.5, -0.7]), 1e-6
    rng = np.random.default_rng(0)
    x, u = jnp.asarray(rng.uniform(0.1, 0.9, arm.nx)), jnp.asarray(rng.uniform(0, 0.5, arm.nu))
    plant = InField(arm, ConstantForce(force))
    change = jax.jit(lambda x, u: plant(x, u, 0.0) - arm(x, u, 0.0))(x, u)
    hand = jax.jit(lambda x: arm.hand(x))
    steps = np.concatenate([h * np.eye(n), np.zeros((n, arm.nx - n))], axis=1)
    jacobian = np.stack([(hand(x + d) - hand(x - d)) / (2 * h) for d in steps], axis=1)
    np.testing.assert_allclose(
        arm.mass_matrix(x[:n]) @ change[n : 2 * n], jacobian.T @ force, rtol=1e-8, atol=1e-9
    )
    np.testing.assert_array_equal(change[:n], 0)
    np.testing.assert_array_equal(change[2 * n :], 0)


def test_two_fields_add_up():
    arm, x, u = TorqueArm(), jnp.array([0.5, 1.2, -0.7, 1.1]), jnp.array([0.1, -0.3])
    one, two = ConstantForce([1.0, 2.0]), Curl(9.0)
    both = InField(InField(arm, one), two)(x, u, 0.0) - arm(x, u, 0.0)
    parts = sum(InField(arm, field)(x, u, 0.0) - arm(x, u, 0.0) for field in (one, two))
    np.testing.assert_allclose(both, parts, rtol=1e-12)


def test_a_channel_keeps_a_bent_reach_within_a_millimetre_of_its_line(free_reach):
    arm, x0, solution = free_reach
    begin = arm.hand(x0)
    free = hand_path(arm, x0, solution.us)
    walled = hand_path(InField(arm, Channel(begin, TARGET)), x0, solution.us)
    along = np.asarray(TARGET - begin)
    across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    bent, held = (np.abs((path - np.asarray(begin)) @ across).max() for path in (free, walled))
    print(f"free {1e3 * bent:.2f} mm, in the channel {1e3 * held:.3f} mm")
    assert bent > 5e-3 and held < 1e-3
    assert np.linalg.norm(walled[-1] - np.asarray(begin)) > 0.08  # it moves along all the same


def test_a_channel_pulls_back_to_its_line_and_damps_across_it():
    wall = Channel([0.1, 0.2], [0.1, 0.6], stiffness=2000.0, damping=50.0)
    beside, moving = jnp.array([0.101, 0.7]), jnp.array([0.02, 0.4])
    np.testing.assert_allclose(wall(beside, moving, 0.0), [-2.0 - 1.0, 0.0], atol=1e-12)


def test_an_adapted_reach_ends_on_target_where_an_unadapted_one_is_carried_off(free_reach):
    arm, x0, solution = free_reach
    problem = jc.tasks.reach(InField(arm, Curl(13.0)), TARGET)
    adapted = jc.solve(problem, jc.ILQR(), x0)
    carried = problem.rollout(x0, solution.us)
    assert adapted.status.ok
    errors = [jnp.linalg.norm(arm.hand(xs[-1]) - TARGET) for xs in (adapted.xs, carried)]
    print(f"adapted {1e3 * errors[0]:.3f} mm, unadapted {1e3 * errors[1]:.1f} mm")
    assert errors[0] < 1e-3 and errors[1] > 0.02


def test_a_fields_parameter_goes_through_jit_vmap_and_grad():
    arm, us = TorqueArm(), jnp.full((20, 2), 0.3)
    x0 = arm.at_rest(0.785, 1.571)

    @jax.jit
    def end(gain):
        problem = jc.tasks.reach(InField(arm, Curl(gain)), TARGET, num_steps=20)
        return arm.hand(problem.rollout(x0, us)[-1])

    gains, h = jnp.array([-13.0, 0.0, 5.0]), 1e-4
    lanes = jax.vmap(end)(gains)
    np.testing.assert_allclose(lanes, jnp.stack([end(gain) for gain in gains]), rtol=1e-12)
    slope = jax.jacfwd(end)(5.0)
    difference = (end(5.0 + h) - end(5.0 - h)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)
    wanted = jax.vmap(
        lambda _: arm.hand(jc.tasks.reach(arm, TARGET, num_steps=20).rollout(x0, us)[-1])
    )
    np.testing.assert_allclose(lanes[1], wanted(gains)[1], rtol=1e-12)


def test_another_gain_does_not_compile_again():
    from jaxctrl import _solve

    arm = TorqueArm()
    x0 = arm.at_rest(0.785, 1.571)

    def solve(field):
        return jc.solve(jc.tasks.reach(InField(arm, field), TARGET, num_steps=20), jc.ILQR(), x0)

    solve(Curl(13.0))
    size = _solve.run_iteration._cached._cache_size()
    solve(Curl(-5))
    solve(Curl(jnp.array(2.0)))
    assert _solve.run_iteration._cached._cache_size() == size


def test_float32_stays_float32(float32):
    arm = TorqueArm()
    for field in (Curl(), ConstantForce([1.0, 2.0]), Channel([0.0, 0.4], [0.1, 0.5])):
        out = jax.eval_shape(InField(arm, field), jnp.ones(4), jnp.ones(2), jnp.zeros(()))
        assert out.dtype == jnp.float32


def test_an_arm_in_a_field_is_otherwise_that_arm():
    arm = MuscleArm()
    plant, x, u = InField(arm, Curl()), arm.at_rest(0.7, 1.5, 0.2), jnp.full(6, 0.3)
    assert (plant.nx, plant.nu, plant.num_joints) == (10, 6, 2)
    for got, wanted in (
        (plant.joint_torque(x, u), arm.joint_torque(x, u)),
        (plant.mass_matrix(x[:2]), arm.mass_matrix(x[:2])),
        (plant.hand(x), arm.hand(x)),
        (plant.nominal_control, arm.nominal_control),
        (plant.control_bounds[1], arm.control_bounds[1]),
        (plant(x, u, 0.0), arm(x, u, 0.0)),  # at rest the curl field pushes nothing
    ):
        np.testing.assert_allclose(got, wanted, rtol=1e-14)


@pytest.mark.parametrize(
    ("build", "error", "match"),
    [
        (lambda: Curl([1.0, 2.0]), ValueError, r"^gain: shape \(2,\), wanted \(\)"),
        (lambda: Curl(np.nan), ValueError, "^gain: finite numbers"),
        (lambda: ConstantForce(np.ones(4)), ValueError, r"^force: shape \(4,\), wanted \(2,\), or"),
        (lambda: ConstantForce([1.0, np.inf]), ValueError, "^force: finite numbers"),
        (lambda: Channel([0.0, 0.1], [0.0, 0.1]), ValueError, "^target: the same as start"),
        (lambda: Channel([0.0, 0.1, 0.2], [0.0, 0.1]), ValueError, r"^target: shape \(2,\)"),
        (
            lambda: InField(TorqueArm(), ConstantForce([1.0, 2.0, 3.0])),
            ValueError,
            r"^field: a force of shape \(3,\), wanted \(2,\)",
        ),
        (
            lambda: Channel([0.0, 0.1], [0.0, 0.2], stiffness=-1.0),
            ValueError,
            "^stiffness: at least 0",
        ),
        (
            lambda: Channel([0.0, 0.1], [0.0, 0.2], damping=-1.0),
            ValueError,
            "^damping: at least 0",
        ),
        (lambda: InField(TorqueArm(), Curl), TypeError, r"^field: a force field such as Curl\(\)"),
        (lambda: InField(TorqueArm, Curl()), TypeError, "^arm: a plant with joints is wanted"),
        (
            lambda: InField(jc.plants.RateControlled(TorqueArm()), Curl()),
            TypeError,
            "^arm: put the field inside",
        ),
        (
            lambda: InField(jc.FunctionPlant(lambda x, u, t: x, nx=2, nu=2), Curl()),
            TypeError,
            "^arm: a plant with joints is wanted, got FunctionPlant",
        ),
    ],
)
def test_misuse_is_named(build, error, match):
    with pytest.raises(error, match=match):
        build()
